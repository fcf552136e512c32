//! A batch that broke a run, kept to be looked at.

use safetensors::tensor::{Dtype, TensorView};
use std::path::{Path, PathBuf};
use swm_core::{Batch, DType, Error, Result};

/// Writes a batch to `failed-batch.safetensors` in a folder.
///
/// # Errors
/// When the disk refuses.
pub fn save(folder: &Path, batch: &Batch) -> Result<PathBuf> {
    let wrong = |error| Error::external("writing safetensors", error);
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
            Ok((column.name.clone(), TensorView::new(dtype, shape, batch.bytes(index)).map_err(wrong)?))
        })
        .collect();
    let path = folder.join("failed-batch.safetensors");
    let bytes = safetensors::serialize(views?, None).map_err(wrong)?;
    std::fs::write(&path, bytes).map_err(|error| Error::io(&path, "saving a batch", error))?;
    Ok(path)
}
