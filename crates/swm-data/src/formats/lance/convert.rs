//! Converts Arrow values to the bytes of a column.

use crate::formats::cast::{Scalar, cast};
use arrow_array::cast::AsArray;
use arrow_array::types::{
    Float16Type, Float32Type, Float64Type, Int8Type, Int16Type, Int32Type, Int64Type, UInt8Type, UInt16Type,
    UInt32Type, UInt64Type,
};
use arrow_array::{Array, ArrayRef, ArrowPrimitiveType};
use arrow_schema::DataType;
use std::sync::Arc;
use swm_core::{DType, Error, Result};

/// Returns the encoded image in a row.
pub fn image_bytes(values: &ArrayRef, row: usize) -> Result<&[u8]> {
    let bytes = if let Some(values) = values.as_binary_opt::<i32>() {
        (!values.is_null(row)).then(|| values.value(row))
    } else if let Some(values) = values.as_binary_opt::<i64>() {
        (!values.is_null(row)).then(|| values.value(row))
    } else {
        None
    };
    bytes.ok_or_else(|| Error::mismatch("reading images", format!("{} or null", values.data_type()), "encoded bytes"))
}

/// Converts stored values (a scalar or a list of `n` per row) to the bytes of a column with type `dtype`.
pub fn convert(values: &ArrayRef, n: usize, dtype: DType, out: &mut [u8]) -> Result<(), String> {
    let elements = match values.as_fixed_size_list_opt() {
        Some(lists) if lists.value_length() as usize == n && lists.null_count() == 0 => {
            // `values()` ignores the offset of the list array, so the slice applies it.
            lists.values().slice(lists.value_offset(0) as usize, lists.len() * n)
        }
        Some(lists) => {
            return Err(format!(
                "it has lists of {} elements ({} of them null) instead of {n}",
                lists.value_length(),
                lists.null_count()
            ));
        }
        None => Arc::clone(values),
    };
    if elements.len() * dtype.size() != out.len() {
        return Err(format!("it has {} values for {} bytes", elements.len(), out.len()));
    }
    match elements.data_type() {
        DataType::Float32 => cast_all::<Float32Type, f64>(&elements, dtype, out),
        DataType::Float64 => cast_all::<Float64Type, f64>(&elements, dtype, out),
        DataType::Float16 => {
            let values = elements.as_primitive::<Float16Type>();
            cast(values.iter().map(|v| v.map_or(f64::NAN, f64::from)), dtype, out)
        }
        DataType::Int8 => cast_all::<Int8Type, i64>(&elements, dtype, out),
        DataType::Int16 => cast_all::<Int16Type, i64>(&elements, dtype, out),
        DataType::Int32 => cast_all::<Int32Type, i64>(&elements, dtype, out),
        DataType::Int64 => cast_all::<Int64Type, i64>(&elements, dtype, out),
        DataType::UInt8 => cast_all::<UInt8Type, i64>(&elements, dtype, out),
        DataType::UInt16 => cast_all::<UInt16Type, i64>(&elements, dtype, out),
        DataType::UInt32 => cast_all::<UInt32Type, i64>(&elements, dtype, out),
        DataType::UInt64 => {
            let values = elements.as_primitive::<UInt64Type>();
            check_no_nulls(values.null_count())?;
            if let Some(large) = values.values().iter().find(|&&value| i64::try_from(value).is_err()) {
                return Err(format!("it has the value {large}, which is more than an int64 can be"));
            }
            cast(values.values().iter().map(|&value| value as i64), dtype, out)
        }
        DataType::Boolean if elements.null_count() == 0 => {
            cast(elements.as_boolean().values().iter().map(i64::from), dtype, out)
        }
        other => Err(format!("{other} is not a supported numeric type")),
    }
}

fn cast_all<T, N>(values: &ArrayRef, dtype: DType, out: &mut [u8]) -> Result<(), String>
where
    T: ArrowPrimitiveType,
    N: Scalar + From<T::Native>,
{
    let values = values.as_primitive::<T>();
    if values.null_count() == 0 {
        return cast(values.values().iter().map(|&v| N::from(v)), dtype, out);
    }
    let Some(missing) = N::MISSING else { return check_no_nulls(values.null_count()) };
    cast(values.iter().map(|v| v.map_or(missing, N::from)), dtype, out)
}

fn check_no_nulls(count: usize) -> Result<(), String> {
    if count == 0 {
        return Ok(());
    }
    Err(format!("it has {count} null values, which its type does not allow"))
}

/// Converts integers of any width to 64 bits.
pub fn integers(values: &ArrayRef, out: &mut [i64]) -> Result<()> {
    convert(values, 1, DType::Int64, bytemuck::cast_slice_mut(out)).map_err(|problem| {
        Error::mismatch("reading an index column", format!("invalid values ({problem})"), "integers")
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use arrow_array::{Float32Array, Float64Array, Int64Array, UInt64Array};

    fn read(values: ArrayRef, dtype: DType) -> Result<Vec<u8>, String> {
        let mut out = vec![0; values.len() * dtype.size()];
        convert(&values, 1, dtype, &mut out).map(|()| out)
    }

    #[test]
    fn values_that_the_type_does_not_have_are_refused() {
        let integers = |value: i64| Arc::new(Int64Array::from(vec![1, value])) as ArrayRef;
        let numbers = |value: f64| Arc::new(Float64Array::from(vec![1.0, value])) as ArrayRef;
        for (values, dtype) in [
            (integers(300), DType::U8),
            (integers(-1), DType::U8),
            (integers(1 << 40), DType::Int32),
            (integers(2), DType::Bool),
            (numbers(1.5), DType::Int32),
            (numbers(f64::NAN), DType::Int64),
            (numbers(2f64.powi(63)), DType::Int64),
            (numbers(0.25), DType::Bool),
            (numbers(1e300), DType::Float32),
            (Arc::new(UInt64Array::from(vec![1, u64::MAX])), DType::Int64),
            (Arc::new(UInt64Array::from(vec![Some(1), None])), DType::Int64),
        ] {
            let name = format!("{values:?} as {}", dtype.name());
            let problem = read(values, dtype).expect_err(&name);
            assert!(problem.contains("which"), "{name}: {problem}");
        }
    }

    #[test]
    fn values_of_the_type_are_read_whatever_stores_them() {
        let singles = |values: &[f32]| Arc::new(Float32Array::from(values.to_vec())) as ArrayRef;
        assert_eq!(read(singles(&[0.0, 1.0, 255.0]), DType::U8), Ok(vec![0, 1, 255]));
        assert_eq!(read(singles(&[0.0, 1.0]), DType::Bool), Ok(vec![0, 1]));
        assert_eq!(read(singles(&[-7.0]), DType::Int32), Ok((-7_i32).to_ne_bytes().to_vec()));
        assert!(read(singles(&[f32::NAN, f32::INFINITY]), DType::Float32).is_ok());
        let largest = Arc::new(Int64Array::from(vec![i64::MAX, i64::MIN]));
        assert_eq!(read(largest, DType::Int64), Ok([i64::MAX.to_ne_bytes(), i64::MIN.to_ne_bytes()].concat()));
    }
}
