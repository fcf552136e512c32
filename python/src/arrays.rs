//! Conversion between the columns of batches and numpy arrays.

use crate::exit::Call;
use numpy::ndarray::{ArrayView, IxDyn};
use numpy::{Element, PyArray1, PyArrayDyn, PyArrayMethods as _, PyReadonlyArrayDyn, PyUntypedArrayMethods as _};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use swm::core::{Batch, ColumnSpec, DType, Schema};

/// Calls `$go::<T>($($arg),*)` with the Rust type of a [`DType`].
macro_rules! with_dtype {
    ($dtype:expr, $go:ident($($arg:expr),*)) => {
        match $dtype {
            DType::Bool => $go::<bool>($($arg),*),
            DType::U8 => $go::<u8>($($arg),*),
            DType::Int32 => $go::<i32>($($arg),*),
            DType::Int64 => $go::<i64>($($arg),*),
            DType::Float32 => $go::<f32>($($arg),*),
            DType::Float64 => $go::<f64>($($arg),*),
        }
    };
}

/// Copies the given rows of a column into a new array `[rows, ..]`.
pub fn copy_rows<'py>(py: Python<'py>, batch: &Batch, column: usize, rows: &[usize]) -> PyResult<Bound<'py, PyAny>> {
    let spec = &batch.schema().columns()[column];
    let n = spec.row_bytes();
    let mut bytes = Vec::with_capacity(rows.len() * n);
    for &row in rows {
        bytes.extend_from_slice(&batch.bytes(column)[row * n..][..n]);
    }
    array(py, spec.dtype, &with_rows(&[rows.len()], spec), &bytes)
}

/// Copies bytes into a new array of the given type and shape. The bytes need not be aligned.
///
/// # Panics
/// If the number of bytes does not match the shape.
pub fn array<'py>(py: Python<'py>, dtype: DType, shape: &[usize], bytes: &[u8]) -> PyResult<Bound<'py, PyAny>> {
    // The first array imports numpy.
    let _call = Call::begin();
    fn make<'py, T: Element + Copy>(py: Python<'py>, shape: &[usize], bytes: &[u8]) -> PyResult<Bound<'py, PyAny>> {
        let array = PyArrayDyn::<T>::zeros(py, IxDyn(shape), false);
        // SAFETY: the new array is contiguous and has no other reference. It has the size of `bytes` (asserted). Bytes are
        // copied as bytes: no Rust code reads the array's booleans, whose bytes a file may have set to other values than 0
        // and 1.
        #[allow(unsafe_code, reason = "numpy arrays share memory with the engine")]
        unsafe {
            assert_eq!(array.len() * size_of::<T>(), bytes.len(), "the bytes must fill the shape");
            std::ptr::copy_nonoverlapping(bytes.as_ptr(), array.data().cast::<u8>(), bytes.len());
        }
        Ok(array.into_any())
    }
    with_dtype!(dtype, make(py, shape, bytes))
}

/// Returns an array that shares the memory of a column, so later writes to the batch change the array.
///
/// # Shapes
/// `[rows, 1, ..]` if `time` is set, else `[rows, ..]`.
///
/// # Safety
/// The batch must neither move nor be resized while `owner` lives.
#[allow(unsafe_code, reason = "numpy arrays share memory with the engine")]
pub unsafe fn view<'py>(
    batch: &Batch,
    column: usize,
    time: bool,
    owner: &Bound<'py, PyAny>,
) -> PyResult<Bound<'py, PyAny>> {
    unsafe fn make<'py, T: Element>(
        bytes: &[u8],
        shape: &[usize],
        owner: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyAny>> {
        // SAFETY: columns are aligned to 64 bytes and have the size of the shape; the caller guarantees their lifetime. The
        // view only describes a numpy array: no Rust code reads its elements.
        let view = unsafe { ArrayView::from_shape_ptr(IxDyn(shape), bytes.as_ptr().cast::<T>()) };
        // SAFETY: `owner` keeps the memory alive, as the caller guarantees.
        Ok(unsafe { PyArrayDyn::borrow_from_array(&view, owner.clone()) }.into_any())
    }
    let spec = &batch.schema().columns()[column];
    let rows = [batch.rows(), 1];
    let shape = with_rows(if time { &rows } else { &rows[..1] }, spec);
    let bytes = batch.bytes(column);
    // SAFETY: the caller guarantees the lifetime that `make` requires.
    unsafe { with_dtype!(spec.dtype, make(bytes, &shape, owner)) }
}

fn with_rows(rows: &[usize], spec: &ColumnSpec) -> Vec<usize> {
    rows.iter().chain(&spec.shape).copied().collect()
}

/// Copies the elements of an array, in row-major order, into a column of the same type.
///
/// # Errors
/// `TypeError` if the array and the column differ in type; `ValueError` if they differ in their number of elements, or
/// if the array is not contiguous.
pub fn fill(batch: &mut Batch, column: usize, given: &Bound<'_, PyAny>) -> PyResult<()> {
    fn go<T: Element + Copy>(to: &mut [u8], given: &Bound<'_, PyAny>, what: &str) -> PyResult<()> {
        let Ok(array) = given.extract::<PyReadonlyArrayDyn<'_, T>>() else {
            return Err(PyTypeError::new_err(format!(
                "{what}: expected a numpy array of the column's type, got {given:?}"
            )));
        };
        let slice = array.as_slice().map_err(|_| {
            PyValueError::new_err(format!("{what}: expected a contiguous array; call numpy.ascontiguousarray"))
        })?;
        if size_of_val(slice) != to.len() {
            let (n, expected) = (slice.len(), to.len() / size_of::<T>());
            let problem = format!("{what}: got {n} values (shape {:?}), expected {expected}", array.shape());
            return Err(PyValueError::new_err(problem));
        }
        // SAFETY: elements of these types are plain data, and both slices have the same size (checked above).
        #[allow(unsafe_code, reason = "numpy arrays share memory with the engine")]
        unsafe {
            std::ptr::copy_nonoverlapping(slice.as_ptr().cast::<u8>(), to.as_mut_ptr(), to.len());
        }
        Ok(())
    }
    let spec = batch.schema().columns()[column].clone();
    let to = batch.bytes_mut(column);
    with_dtype!(spec.dtype, go(to, given, &spec.name))
}

/// Creates a batch with one column for every array `[rows, ..]` in `infos`.
///
/// # Errors
/// `TypeError` for a type that batches cannot hold, `ValueError` if the arrays differ in their number of rows.
pub fn batch(infos: &Bound<'_, PyDict>) -> PyResult<Batch> {
    let mut columns = vec![];
    let mut rows = None;
    for (name, value) in infos {
        let name: String = name.extract()?;
        let (dtype, shape) = dtype_and_shape(&value).ok_or_else(|| {
            let message = format!("{name}: expected a numpy array of bool, uint8, int32, int64, float32 or float64");
            PyTypeError::new_err(message)
        })?;
        let Some((&first, rest)) = shape.split_first() else {
            return Err(PyValueError::new_err(format!("{name}: got an array without dimensions, expected [rows, ..]")));
        };
        if *rows.get_or_insert(first) != first {
            let message =
                format!("{name}: got {first} rows, expected {} as in the other columns", rows.unwrap_or_default());
            return Err(PyValueError::new_err(message));
        }
        columns.push(ColumnSpec::new(name, dtype, rest));
    }
    let schema = Schema::new(columns).map_err(crate::errors::to_py_err)?;
    let mut batch = Batch::zeros(&schema, rows.unwrap_or(0));
    for (column, (_, value)) in infos.iter().enumerate() {
        fill(&mut batch, column, &value)?;
    }
    Ok(batch)
}

/// The type and shape of a numpy array; `None` if batches cannot hold its type.
fn dtype_and_shape(value: &Bound<'_, PyAny>) -> Option<(DType, Vec<usize>)> {
    let array = value.cast::<numpy::PyUntypedArray>().ok()?;
    let is = |name: &str| array.dtype().str().is_ok_and(|s| s.to_string_lossy() == name);
    let all = [DType::Bool, DType::U8, DType::Int32, DType::Int64, DType::Float32, DType::Float64];
    let dtype = all.into_iter().find(|dtype| is(dtype.name()))?;
    Some((dtype, array.shape().to_vec()))
}

/// Copies the elements of a `float32` array, which must have the given shape. `what` names the array in errors.
pub fn f32_values(what: &str, given: &Bound<'_, PyAny>, shape: &[usize]) -> PyResult<Vec<f32>> {
    // As many as the array has, because nothing has compared its shape yet.
    let mut values = vec![0.0; given.cast::<PyArrayDyn<f32>>().map_or(0, |array| array.len())];
    copy_f32(what, given, shape, &mut values)?;
    Ok(values)
}

/// Copies the elements of a `float32` array, which must have the given shape, to `to`. `what` names the array in errors.
///
/// # Panics
/// If `to` does not have as many elements as the shape.
pub fn copy_f32(what: &str, given: &Bound<'_, PyAny>, shape: &[usize], to: &mut [f32]) -> PyResult<()> {
    let Ok(array) = given.cast::<PyArrayDyn<f32>>() else {
        return Err(PyTypeError::new_err(format!(
            "{what}: expected a float32 array of shape {shape:?}, got {given:?}"
        )));
    };
    if array.shape() != shape {
        let message = format!("{what}: got shape {:?}, expected {shape:?}", array.shape());
        return Err(PyValueError::new_err(message));
    }
    let array = array.try_readonly()?;
    match array.as_slice() {
        Ok(values) => to.copy_from_slice(values),
        Err(_) => to.iter_mut().zip(array.as_array()).for_each(|(to, value)| *to = *value),
    }
    Ok(())
}

/// Creates a `float32` array of the given shape from its elements.
pub fn f32_array<'py>(py: Python<'py>, values: &[f32], shape: &[usize]) -> PyResult<Bound<'py, PyAny>> {
    Ok(PyArray1::from_slice(py, values).reshape(IxDyn(shape))?.into_any())
}
