//! A batch whose loss or gradient is not finite, saved for inspection.

use safetensors::tensor::{Dtype, TensorView};
use std::collections::HashMap;
use std::io::Read as _;
use std::path::{Path, PathBuf};
use swm_core::columns::ACTION;
use swm_core::{Batch, ColumnSpec, DType, Error, Result, files};

/// The name of the file.
pub(crate) const FILE: &str = "failed-batch.safetensors";

/// The key and the value in the metadata of the file, by which the program recognises its own.
const MARK: (&str, &str) = ("stable_worldmodel", "failed batch");

/// Saves `batch` in `folder` and returns the error that `what` is not finite. The error contains the `values` of the
/// step, the columns with NaN, and the path of the batch. `repair` says what to do about NaN in the batch, and `fix` what to do
/// otherwise.
pub(crate) fn error(folder: &Path, batch: &Batch, what: String, values: &str, repair: &str, fix: &str) -> Error {
    let saved = match save(folder, batch) {
        Ok(path) => format!("the batch is in {}", path.display()),
        Err(error) => format!("the batch could not be saved ({error})"),
    };
    let incomplete = incomplete(batch);
    if incomplete.is_empty() {
        return Error::NotFinite { what, given: format!("{values} ({saved})"), fix: fix.to_owned() };
    }
    let given = format!("{values}, with NaN in {} ({saved})", incomplete.join(", "));
    Error::NotFinite { what, given, fix: format!("{repair}; if the model accepts NaN, {fix}") }
}

/// The columns of a batch that have NaN, except actions, which may be missing in the last row of an episode.
fn incomplete(batch: &Batch) -> Vec<String> {
    let has_nan = |column: &&ColumnSpec| {
        matches!(column.dtype, DType::Float32 | DType::Float64)
            && column.name != ACTION
            && batch.to_f32(&column.name).is_ok_and(|values| values.iter().any(|value| value.is_nan()))
    };
    batch.schema().columns().iter().filter(has_nan).map(|column| format!("'{}'", column.name)).collect()
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

#[cfg(test)]
mod tests {
    use super::*;
    use swm_core::Schema;

    #[test]
    fn columns_with_nan_are_named() {
        let folder = tempfile::tempdir().expect("a folder");
        let column = |name: &str| ColumnSpec::new(name, DType::Float32, [2]);
        let schema = Schema::new([column(ACTION), column("state"), column("reward")]).expect("a schema");
        let mut batch = Batch::zeros(&schema, 3);
        batch.row_mut(2).set(0, &[f32::NAN; 2]);
        let message = |batch: &Batch| {
            error(folder.path(), batch, "the loss".to_owned(), "loss NaN", "correct it", "lower optim.lr").to_string()
        };
        let found = message(&batch);
        assert!(found.ends_with("; lower optim.lr") && !found.contains("with NaN in"), "{found}");
        assert!(!found.contains("correct it"), "{found}");
        batch.row_mut(1).set(1, &[0.0, f32::NAN]);
        let found = message(&batch);
        assert!(found.contains("loss NaN, with NaN in 'state' ("), "{found}");
        assert!(found.ends_with("; correct it; if the model accepts NaN, lower optim.lr"), "{found}");
    }
}
