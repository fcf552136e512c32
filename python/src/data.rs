//! Bindings that read, load, write, convert and examine datasets.
//!
//! - [`dataset`]: [`Dataset`](dataset::Dataset) reads the rows of episodes, also in forked processes.
//! - [`loader`]: shuffled batches that threads prefetch.
//! - [`writer`]: writes episodes in one of the engine's formats.
//! - [`replay`]: the latest episodes of a running collection.
//! - [`foreign`]: readers and writers implemented in Python.
//! - [`tools`]: converts, examines and describes datasets.
//! - [`process`]: support for forked processes.

pub mod dataset;
pub mod foreign;
pub mod loader;
pub mod process;
pub mod replay;
pub mod tools;
pub mod writer;

use crate::arrays;
use crate::errors::to_py_err;
use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use std::ops::Deref;
use swm::core::{Batch, ColumnSpec, DType, Schema};
use swm::data::{Constants, ImageCodec, LoadedBatch, WriteMode};

/// A batch that shares its memory with numpy arrays and is dropped after the last of these arrays.
#[pyclass(frozen, module = "stable_worldmodel._engine")]
struct SharedBatch(BatchMemory);

/// The memory behind a [`SharedBatch`].
enum BatchMemory {
    Owned(Batch),
    /// Returns its memory to the loader when it is dropped.
    Loaded(LoadedBatch),
}

impl Deref for SharedBatch {
    type Target = Batch;

    fn deref(&self) -> &Batch {
        match &self.0 {
            BatchMemory::Owned(batch) => batch,
            BatchMemory::Loaded(batch) => batch,
        }
    }
}

/// Returns the columns of a batch as arrays `[rows, ..]`, without a copy.
fn columns(py: Python<'_>, batch: BatchMemory) -> PyResult<Bound<'_, PyDict>> {
    let shared = Bound::new(py, SharedBatch(batch))?;
    let dict = PyDict::new(py);
    for (i, column) in shared.get().schema().columns().iter().enumerate() {
        // SAFETY: a `SharedBatch` never moves or resizes its buffers, and every array keeps it alive. Python may write to
        // the arrays; the engine does not access the batch after this function.
        #[allow(unsafe_code, reason = "numpy arrays share memory with the engine")]
        dict.set_item(&column.name, unsafe { arrays::view(shared.get(), i, false, shared.as_any()) }?)?;
    }
    Ok(dict)
}

/// The description of a column in Python: its name, the numpy name of its type, the shape of a row.
type Column = (String, String, Vec<usize>);

/// Returns the descriptions of a schema's columns.
fn described(schema: &Schema) -> Vec<Column> {
    let column = |column: &ColumnSpec| (column.name.clone(), column.dtype.name().to_owned(), column.shape.clone());
    schema.columns().iter().map(column).collect()
}

/// Builds a schema from the descriptions of its columns.
///
/// # Errors
/// `TypeError` for a type that datasets cannot store.
fn schema(columns: Vec<Column>) -> PyResult<Schema> {
    let all = [DType::Bool, DType::U8, DType::Int32, DType::Int64, DType::Float32, DType::Float64];
    let specs: PyResult<Vec<ColumnSpec>> = columns
        .into_iter()
        .map(|(name, dtype, shape)| match all.into_iter().find(|known| known.name() == dtype) {
            Some(dtype) => Ok(ColumnSpec::new(name, dtype, shape)),
            None => Err(PyTypeError::new_err(format!(
                "column '{name}': values of type {dtype} cannot be stored; convert them to bool, uint8, int32, int64, \
                 float32 or float64"
            ))),
        })
        .collect();
    Schema::new(specs?).map_err(to_py_err)
}

/// Converts the constants of an episode, text or bytes, from Python.
fn constants(given: &Bound<'_, PyDict>) -> PyResult<Constants> {
    let mut constants = Constants::new();
    for (name, value) in given {
        let bytes = match value.extract::<String>() {
            Ok(text) => text.into_bytes(),
            Err(_) => value.extract::<Vec<u8>>()?,
        };
        constants.insert(name.extract()?, bytes);
    }
    Ok(constants)
}

/// Returns the write mode for `"append"` or `"overwrite"`. Any other name selects `Create`, which fails if the dataset
/// exists.
fn write_mode(mode: &str) -> WriteMode {
    match mode {
        "append" => WriteMode::Append,
        "overwrite" => WriteMode::Overwrite,
        _ => WriteMode::Create,
    }
}

/// Parses the codec of stored images from JSON; `None` selects the default codec.
fn image_codec(codec: Option<&str>) -> PyResult<ImageCodec> {
    codec.map_or(Ok(ImageCodec::default()), |text| crate::errors::json("codec", text))
}
