//! Datasets made of datasets: readers over readers, which compose and copy nothing.
//!
//! - [`concat`](fn@concat): the episodes of several datasets, one after another.
//! - [`merge`](fn@merge): columns of another dataset beside those of one with the same episodes.
//! - [`subset`] and [`select`]: some of the episodes, some of the columns.
//!
//! A part held out for validation is `subset(reader, split.episodes(&*reader, Part::Validation)?)`.

mod concat;
mod merge;
mod subset;

pub use concat::concat;
pub use merge::merge;
pub use subset::{select, subset};

/// A hash of a view: of what it does and of what it looks at.
fn view_hash(view: &str, parts: impl IntoIterator<Item = String>) -> String {
    let mut hasher = blake3::Hasher::new();
    for part in std::iter::once(view.to_owned()).chain(parts) {
        hasher.update(&(part.len() as u64).to_le_bytes());
        hasher.update(part.as_bytes());
    }
    hasher.finalize().to_hex().to_string()
}
