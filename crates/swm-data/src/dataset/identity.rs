//! The identity of a dataset whose format knows none: see [`Reader::identity`].

use super::reader::{Reader, StepRange};
use swm_core::columns::{EPISODE_IDX, STEP_IDX};
use swm_core::{ColumnSpec, Result};

/// The columns of a dataset and their values in the first and the last row of the first `episodes` episodes; images only if there
/// is nothing else.
pub(super) fn first_and_last_row(reader: &(impl Reader + ?Sized), episodes: usize) -> Result<String> {
    let data = || reader.schema().columns().iter().filter(|column| ![EPISODE_IDX, STEP_IDX].contains(&&*column.name));
    let numeric: Vec<&ColumnSpec> = data().filter(|column| !column.is_image()).collect();
    let compared = if numeric.is_empty() { data().collect() } else { numeric };
    let names: Vec<&str> = compared.iter().map(|column| column.name.as_str()).collect();
    let episodes = &reader.episodes()[..episodes];
    let has_rows = |&index: &usize| episodes[index].length > 0;
    let first = (0..episodes.len()).find(has_rows).map(|index| StepRange::new(index, 0, 1));
    let last = (0..episodes.len()).rfind(has_rows).map(|index| StepRange::new(index, episodes[index].length - 1, 1));
    let values = reader.read(&names, &first.into_iter().chain(last).collect::<Vec<_>>())?;
    let mut hasher = blake3::Hasher::new();
    for (index, spec) in compared.iter().enumerate() {
        hasher.update(format!("{} {:?} {:?}", spec.name, spec.dtype, spec.shape).as_bytes());
        hasher.update(values.bytes(index));
    }
    Ok(hasher.finalize().to_hex().to_string())
}
