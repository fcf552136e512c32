//! The identity of a dataset whose format knows none: see [`Reader::identity`].

use super::reader::{Reader, StepRange};
use swm_core::columns::{EPISODE_IDX, STEP_IDX};
use swm_core::{ColumnSpec, Result};

/// The most episodes of which a row is compared.
const SAMPLED: usize = 16;

/// The columns of a dataset and their values in some rows of the first `episodes` episodes: the first and the last one, and the
/// middle ones of episodes at equal distances. Images only if there is nothing else.
pub(super) fn sampled_rows(reader: &(impl Reader + ?Sized), episodes: usize) -> Result<String> {
    let data = || reader.schema().columns().iter().filter(|column| ![EPISODE_IDX, STEP_IDX].contains(&&*column.name));
    let numeric: Vec<&ColumnSpec> = data().filter(|column| !column.is_image()).collect();
    let compared = if numeric.is_empty() { data().collect() } else { numeric };
    let names: Vec<&str> = compared.iter().map(|column| column.name.as_str()).collect();
    let lengths = reader.episodes()[..episodes].iter().map(|episode| episode.length).enumerate();
    let filled: Vec<(usize, usize)> = lengths.filter(|&(_, length)| length > 0).collect();
    let sampled = SAMPLED.min(filled.len());
    let middles = (0..sampled).map(|i| filled[i * filled.len() / sampled]);
    let mut rows: Vec<StepRange> = middles.map(|(index, length)| StepRange::new(index, length / 2, 1)).collect();
    rows.extend(filled.first().map(|&(index, _)| StepRange::new(index, 0, 1)));
    rows.extend(filled.last().map(|&(index, length)| StepRange::new(index, length - 1, 1)));
    let values = reader.read(&names, &rows)?;
    let mut hasher = blake3::Hasher::new();
    for (index, spec) in compared.iter().enumerate() {
        hasher.update(format!("{} {:?} {:?}", spec.name, spec.dtype, spec.shape).as_bytes());
        hasher.update(values.bytes(index));
    }
    Ok(hasher.finalize().to_hex().to_string())
}
