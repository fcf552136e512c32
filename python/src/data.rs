//! Data: reading, loading, writing, converting and examining datasets.
//!
//! - [`dataset`]: [`Dataset`](dataset::Dataset), rows of episodes, in any process.
//! - [`loader`]: shuffled batches made ahead by threads.
//! - [`writer`]: episodes into a dataset of one of our formats.
//! - [`replay`]: the latest episodes of a running collection.
//! - [`foreign`]: readers and writers that Python brings.
//! - [`work`]: converting, examining, describing.
//! - [`process`]: what a forked process must not do.

pub mod dataset;
pub mod foreign;
pub mod loader;
pub mod process;
pub mod replay;
pub mod work;
pub mod writer;

use crate::arrays;
use crate::errors::raised;
use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use std::ops::Deref;
use swm::core::{Batch, ColumnSpec, DType, Schema};
use swm::data::{Constants, ImageCodec, LoadedBatch, WriteMode};

/// A batch that numpy arrays look at; it goes when the last of them does.
#[pyclass(frozen, module = "stable_worldmodel._engine")]
struct Held(Kept);

enum Kept {
    Own(Batch),
    /// Goes back to the loader that made it.
    Lent(LoadedBatch),
}

impl Deref for Held {
    type Target = Batch;

    fn deref(&self) -> &Batch {
        match &self.0 {
            Kept::Own(batch) => batch,
            Kept::Lent(batch) => batch,
        }
    }
}

/// The columns of a batch, `[rows, ..]`, without a copy.
fn columns(py: Python<'_>, batch: Kept) -> PyResult<Bound<'_, PyDict>> {
    let held = Bound::new(py, Held(batch))?;
    let dict = PyDict::new(py);
    for (i, column) in held.get().schema().columns().iter().enumerate() {
        // SAFETY: nobody changes a batch that is held, and every array keeps it.
        #[allow(unsafe_code)]
        dict.set_item(&column.name, unsafe { arrays::view(held.get(), i, false, held.as_any()) }?)?;
    }
    Ok(dict)
}

/// A column as Python names it: its name, numpy's name of its type, the shape of a row.
type Column = (String, String, Vec<usize>);

fn described(schema: &Schema) -> Vec<Column> {
    let column = |column: &ColumnSpec| (column.name.clone(), column.dtype.name().to_owned(), column.shape.clone());
    schema.columns().iter().map(column).collect()
}

fn schema(columns: Vec<Column>) -> PyResult<Schema> {
    let all = [DType::Bool, DType::U8, DType::Int32, DType::Int64, DType::Float32, DType::Float64];
    let specs: PyResult<Vec<ColumnSpec>> = columns
        .into_iter()
        .map(|(name, dtype, shape)| match all.into_iter().find(|known| known.name() == dtype) {
            Some(dtype) => Ok(ColumnSpec::new(name, dtype, shape)),
            None => Err(PyTypeError::new_err(format!(
                "column '{name}': numbers of type {dtype} are not stored; convert them to bool, uint8, int32, int64, \
                 float32 or float64"
            ))),
        })
        .collect();
    Schema::new(specs?).map_err(raised)
}

/// What is the same in every step of an episode: text, or bytes.
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

/// How a dataset that is there is met.
fn write_mode(mode: &str) -> WriteMode {
    match mode {
        "append" => WriteMode::Append,
        "overwrite" => WriteMode::Overwrite,
        _ => WriteMode::Create,
    }
}

/// How pictures are stored, from JSON.
fn image_codec(codec: Option<&str>) -> PyResult<ImageCodec> {
    codec.map_or(Ok(ImageCodec::default()), |text| crate::errors::json("codec", text))
}
