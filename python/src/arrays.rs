//! Columns of batches as numpy arrays, and back.

use numpy::ndarray::{ArrayView, IxDyn};
use numpy::{Element, PyArray1, PyArrayDyn, PyArrayMethods as _, PyReadonlyArrayDyn, PyUntypedArrayMethods as _};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use swm::core::{Batch, ColumnSpec, DType, Schema};

/// Calls `$go::<T>($($arg),*)` with the element type of a column.
macro_rules! typed {
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

/// A copy of some rows of a column, of shape `[rows, ..]`.
pub fn copied<'py>(py: Python<'py>, batch: &Batch, column: usize, rows: &[usize]) -> PyResult<Bound<'py, PyAny>> {
    let spec = &batch.schema().columns()[column];
    let n = spec.row_bytes();
    let mut bytes = Vec::with_capacity(rows.len() * n);
    for &row in rows {
        bytes.extend_from_slice(&batch.bytes(column)[row * n..][..n]);
    }
    array(py, spec.dtype, &with_rows(&[rows.len()], spec), &bytes)
}

/// An array of these bytes, which need not be aligned.
pub fn array<'py>(py: Python<'py>, dtype: DType, shape: &[usize], bytes: &[u8]) -> PyResult<Bound<'py, PyAny>> {
    fn make<'py, T: Element + Copy>(py: Python<'py>, shape: &[usize], bytes: &[u8]) -> PyResult<Bound<'py, PyAny>> {
        let array = PyArrayDyn::<T>::zeros(py, IxDyn(shape), false);
        // SAFETY: the array was just made, is contiguous, and nobody else knows of it. It has as many bytes as are given
        // (asserted), and every pattern of them is a value: booleans are stored as 0 and 1.
        #[allow(unsafe_code)]
        unsafe {
            assert_eq!(array.len() * size_of::<T>(), bytes.len(), "as many bytes as the shape says");
            std::ptr::copy_nonoverlapping(bytes.as_ptr(), array.data().cast::<u8>(), bytes.len());
        }
        Ok(array.into_any())
    }
    typed!(dtype, make(py, shape, bytes))
}

/// A view of every row of a column, `[rows, 1, ..]`: of one moment. It follows what is written to the batch.
///
/// # Safety
/// The batch must stay where it is, and as long as it is, for as long as `owner` lives.
#[allow(unsafe_code)]
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
        // SAFETY: columns are aligned to 64 bytes and hold values of this type; the caller vouches for their life.
        let view = unsafe { ArrayView::from_shape_ptr(IxDyn(shape), bytes.as_ptr().cast::<T>()) };
        // SAFETY: as above.
        Ok(unsafe { PyArrayDyn::borrow_from_array(&view, owner.clone()) }.into_any())
    }
    let spec = &batch.schema().columns()[column];
    let rows = [batch.rows(), 1];
    let shape = with_rows(if time { &rows } else { &rows[..1] }, spec);
    let bytes = batch.bytes(column);
    // SAFETY: handed on.
    unsafe { typed!(spec.dtype, make(bytes, &shape, owner)) }
}

fn with_rows(rows: &[usize], spec: &ColumnSpec) -> Vec<usize> {
    rows.iter().chain(&spec.shape).copied().collect()
}

/// Copies the numbers of an array, in row-major order, over a column. The array must be of the column's type already.
pub fn fill(batch: &mut Batch, column: usize, given: &Bound<'_, PyAny>) -> PyResult<()> {
    fn go<T: Element + Copy>(to: &mut [u8], given: &Bound<'_, PyAny>, what: &str) -> PyResult<()> {
        let Ok(array) = given.extract::<PyReadonlyArrayDyn<'_, T>>() else {
            return Err(PyTypeError::new_err(format!("{what}: expected a numpy array of its type, got {given:?}")));
        };
        let slice = array.as_slice().map_err(|_| PyValueError::new_err(format!("{what}: not contiguous")))?;
        if size_of_val(slice) != to.len() {
            let (n, expected) = (slice.len(), to.len() / size_of::<T>());
            let problem = format!("{what}: got {n} numbers (shape {:?}), expected {expected}", array.shape());
            return Err(PyValueError::new_err(problem));
        }
        // SAFETY: numpy's elements of these types are plain bytes, and both have the same number of them (checked).
        #[allow(unsafe_code)]
        unsafe {
            std::ptr::copy_nonoverlapping(slice.as_ptr().cast::<u8>(), to.as_mut_ptr(), to.len());
        }
        Ok(())
    }
    let spec = batch.schema().columns()[column].clone();
    let to = batch.bytes_mut(column);
    typed!(spec.dtype, go(to, given, &spec.name))
}

/// A batch of arrays `[rows, ..]` of the types batches have.
pub fn batch(infos: &Bound<'_, PyDict>) -> PyResult<Batch> {
    let mut columns = vec![];
    let mut rows = None;
    for (name, value) in infos {
        let name: String = name.extract()?;
        let (dtype, shape) = form(&value).ok_or_else(|| {
            let message = format!("{name}: expected a numpy array of bool, uint8, int32, int64, float32 or float64");
            PyTypeError::new_err(message)
        })?;
        let Some((&first, rest)) = shape.split_first() else {
            return Err(PyValueError::new_err(format!("{name}: has no rows")));
        };
        if *rows.get_or_insert(first) != first {
            let message = format!("{name}: has {first} rows, other columns {}", rows.unwrap_or_default());
            return Err(PyValueError::new_err(message));
        }
        columns.push(ColumnSpec::new(name, dtype, rest));
    }
    let schema = Schema::new(columns).map_err(crate::errors::raised)?;
    let mut batch = Batch::zeros(&schema, rows.unwrap_or(0));
    for (column, (_, value)) in infos.iter().enumerate() {
        fill(&mut batch, column, &value)?;
    }
    Ok(batch)
}

/// The type and shape of a numpy array, if a batch can hold it.
fn form(value: &Bound<'_, PyAny>) -> Option<(DType, Vec<usize>)> {
    let array = value.cast::<numpy::PyUntypedArray>().ok()?;
    let is = |name: &str| array.dtype().str().is_ok_and(|s| s.to_string_lossy() == name);
    let all = [DType::Bool, DType::U8, DType::Int32, DType::Int64, DType::Float32, DType::Float64];
    let dtype = all.into_iter().find(|dtype| is(dtype.name()))?;
    Some((dtype, array.shape().to_vec()))
}

/// The numbers of a `float32` array, with its shape checked.
pub fn numbers(what: &str, given: &Bound<'_, PyAny>, shape: &[usize]) -> PyResult<Vec<f32>> {
    let Ok(array) = given.extract::<PyReadonlyArrayDyn<'_, f32>>() else {
        return Err(PyTypeError::new_err(format!(
            "{what}: expected a float32 array of shape {shape:?}, got {given:?}"
        )));
    };
    if array.shape() != shape {
        let message = format!("{what}: got shape {:?}, expected {shape:?}", array.shape());
        return Err(PyValueError::new_err(message));
    }
    Ok(array.as_array().iter().copied().collect())
}

/// A `float32` array of this shape.
pub fn floats<'py>(py: Python<'py>, numbers: &[f32], shape: &[usize]) -> PyResult<Bound<'py, PyAny>> {
    Ok(PyArray1::from_slice(py, numbers).reshape(IxDyn(shape))?.into_any())
}
