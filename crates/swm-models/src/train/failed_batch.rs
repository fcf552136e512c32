//! A batch whose loss or gradient is not finite, saved for inspection.

use safetensors::tensor::{Dtype, TensorView};
use std::path::{Path, PathBuf};
use swm_core::{Batch, DType, Error, Result, files};

/// Saves `batch` in `folder` and returns the error that `what` is not finite. The error contains the `values` of the
/// step and the path of the batch.
pub(crate) fn error(folder: &Path, batch: &Batch, what: String, values: &str, fix: &str) -> Error {
    let saved = match save(folder, batch) {
        Ok(path) => format!("the batch is in {}", path.display()),
        Err(error) => format!("the batch could not be saved ({error})"),
    };
    Error::NotFinite { what, given: format!("{values} ({saved})"), fix: fix.to_owned() }
}

/// Writes a batch to `failed-batch.safetensors` in a folder.
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
    let path = folder.join("failed-batch.safetensors");
    let bytes = safetensors::serialize(views?, None).map_err(failed)?;
    files::write(&path, &bytes)?;
    Ok(path)
}

/// Metrics as text, such as `loss 0.5, reward NaN`.
pub(crate) fn describe(metrics: &[(&'static str, f64)]) -> String {
    metrics.iter().map(|(name, value)| format!("{name} {value}")).collect::<Vec<_>>().join(", ")
}
