//! Views: readers that combine or restrict other readers without copying data.
//!
//! - [`concat`](fn@concat): the episodes of several datasets, one after another.
//! - [`merge`](fn@merge): additional columns from another dataset of the same episodes.
//! - [`subset`] and [`select`]: some of the episodes, some of the columns.
//!
//! For example, `subset(reader, split.episodes(&*reader, Part::Validation)?)` holds the validation episodes.

mod concat;
mod merge;
mod subset;

pub use concat::concat;
pub use merge::merge;
pub use subset::{select, subset};

/// The hash of a view, computed from the name of the view and the hashes and names that define it.
fn view_hash(view: &str, parts: impl IntoIterator<Item = String>) -> String {
    let mut hasher = blake3::Hasher::new();
    for part in std::iter::once(view.to_owned()).chain(parts) {
        hasher.update(&(part.len() as u64).to_le_bytes());
        hasher.update(part.as_bytes());
    }
    hasher.finalize().to_hex().to_string()
}
