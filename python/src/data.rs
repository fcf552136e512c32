//! Bindings for datasets: reading, loading, writing, converting and examining datasets.
//!
//! - [`dataset`]: [`Dataset`](dataset::Dataset), the rows of episodes, usable after a fork.
//! - [`loader`]: shuffled batches that threads prefetch.
//! - [`writer`]: writes episodes in one of the engine's formats.
//! - [`replay`]: the latest episodes of a running collection.
//! - [`foreign`]: readers and writers implemented in Python.
//! - [`work`]: converts, examines and describes datasets.
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

/// A batch whose memory numpy arrays share; it is dropped with the last of them.
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

/// The columns of a batch as arrays `[rows, ..]`, without a copy.
fn columns(py: Python<'_>, batch: BatchMemory) -> PyResult<Bound<'_, PyDict>> {
    let held = Bound::new(py, SharedBatch(batch))?;
    let dict = PyDict::new(py);
    for (i, column) in held.get().schema().columns().iter().enumerate() {
        // SAFETY: a `SharedBatch` is immutable, and every array keeps it alive.
        #[allow(unsafe_code, reason = "numpy arrays share memory with the engine")]
        dict.set_item(&column.name, unsafe { arrays::view(held.get(), i, false, held.as_any()) }?)?;
    }
    Ok(dict)
}

/// A column as Python describes it: its name, the numpy name of its type, the shape of a row.
type Column = (String, String, Vec<usize>);

/// The columns of a schema, for Python.
fn described(schema: &Schema) -> Vec<Column> {
    let column = |column: &ColumnSpec| (column.name.clone(), column.dtype.name().to_owned(), column.shape.clone());
    schema.columns().iter().map(column).collect()
}

/// The schema of these columns.
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

/// The constants of an episode, text or bytes, from Python.
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

/// The write mode of this name; any other name creates a dataset and fails if one exists.
fn write_mode(mode: &str) -> WriteMode {
    match mode {
        "append" => WriteMode::Append,
        "overwrite" => WriteMode::Overwrite,
        _ => WriteMode::Create,
    }
}

/// The codec of stored images, from JSON; the default codec for `None`.
fn image_codec(codec: Option<&str>) -> PyResult<ImageCodec> {
    codec.map_or(Ok(ImageCodec::default()), |text| crate::errors::json("codec", text))
}
