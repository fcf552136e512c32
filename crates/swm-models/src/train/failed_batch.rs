//! A batch whose loss or gradient is not finite, saved for inspection.

use safetensors::tensor::{Dtype, TensorView};
use std::collections::HashMap;
use std::io::Read as _;
use std::path::{Path, PathBuf};
use swm_core::{Batch, DType, Error, Result, files};

/// The name of the file.
pub(crate) const FILE: &str = "failed-batch.safetensors";

/// The key and the value in the metadata of the file, by which the program recognises its own.
const MARK: (&str, &str) = ("stable_worldmodel", "failed batch");

/// Saves `batch` in `folder` and returns the error that `what` is not finite. The error contains the `values` of the
/// step and the path of the batch.
pub(crate) fn error(folder: &Path, batch: &Batch, what: String, values: &str, fix: &str) -> Error {
    let saved = match save(folder, batch) {
        Ok(path) => format!("the batch is in {}", path.display()),
        Err(error) => format!("the batch could not be saved ({error})"),
    };
    Error::NotFinite { what, given: format!("{values} ({saved})"), fix: fix.to_owned() }
}

/// Writes a batch to [`FILE`] in a folder. Replaces the batch of an earlier run only.
fn save(folder: &Path, batch: &Batch) -> Result<PathBuf> {
    let failed = |error| Error::external("writing safetensors", error);
    let views: Result<Vec<(String, TensorView<'_>)>> = batch
        .schema()
        .columns()
        .iter()
        .enumerate()
        .map(|(index, column)| {
            let dtype = match column.dtype {
                DType::U8 => Dtype::U8,
                DType::Bool => Dtype::BOOL,
                DType::Int32 => Dtype::I32,
                DType::Int64 => Dtype::I64,
                DType::Float32 => Dtype::F32,
                DType::Float64 => Dtype::F64,
            };
            let shape = [&[batch.rows()], &column.shape[..]].concat();
            Ok((column.name.clone(), TensorView::new(dtype, shape, batch.bytes(index)).map_err(failed)?))
        })
        .collect();
    let path = folder.join(FILE);
    files::check_own(&path, is_own)?;
    let mark = HashMap::from([(MARK.0.to_owned(), MARK.1.to_owned())]);
    let bytes = safetensors::serialize(views?, Some(mark)).map_err(failed)?;
    files::write(&path, &bytes)?;
    Ok(path)
}

/// Returns whether a file is a batch that this program saved.
pub(crate) fn is_own(path: &Path) -> bool {
    /// The most bytes of the header of a batch.
    const MAX_HEADER: u64 = 1 << 20;
    let header = || {
        let mut file = files::open(path).ok()?;
        let mut length = [0; 8];
        file.read_exact(&mut length).ok()?;
        let length = Some(u64::from_le_bytes(length)).filter(|&length| length <= MAX_HEADER)?;
        let mut text = vec![];
        file.take(length).read_to_end(&mut text).ok()?;
        serde_json::from_slice::<serde_json::Value>(&text).ok()
    };
    header().is_some_and(|header| header["__metadata__"][MARK.0] == MARK.1)
}

/// Metrics as text, such as `loss 0.5, reward NaN`.
pub(crate) fn describe(metrics: &[(&'static str, f64)]) -> String {
    metrics.iter().map(|(name, value)| format!("{name} {value}")).collect::<Vec<_>>().join(", ")
}
