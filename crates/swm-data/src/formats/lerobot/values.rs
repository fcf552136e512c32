//! Conversions between Arrow arrays and the bytes of columns.

use crate::formats::cast::{Scalar, cast};
use arrow_array::cast::AsArray as _;
use arrow_array::types::{
    ArrowPrimitiveType, Float16Type, Float32Type, Float64Type, Int8Type, Int16Type, Int32Type, Int64Type, UInt8Type,
    UInt16Type, UInt32Type, UInt64Type,
};
use arrow_array::{Array, ArrayRef, BooleanArray, FixedSizeListArray, PrimitiveArray};
use arrow_buffer::{ArrowNativeType, ScalarBuffer};
use arrow_schema::{DataType, Field};
use std::sync::Arc;
use swm_core::{ColumnSpec, DType, Error, Result};

/// Appends an array with `column.len()` values per row as bytes of the column's type.
///
/// # Errors
/// If a row does not have `column.len()` values, or if values are missing or not numeric.
pub fn append(array: &dyn Array, column: &ColumnSpec, out: &mut Vec<u8>) -> Result<(), String> {
    let expected = array.len() * column.len();
    let mut leaf: ArrayRef = arrow_array::make_array(array.to_data());
    // The lengths of nested lists, outermost first.
    let mut lengths = vec![];
    loop {
        if leaf.null_count() > 0 {
            return Err("some values are missing".to_owned());
        }
        leaf = match leaf.data_type() {
            DataType::List(_) => {
                let list = leaf.as_list::<i32>();
                check_offsets(list.value_offsets())?;
                lengths.push(list.value_length(0) as usize);
                let (first, last) = (list.value_offsets()[0] as usize, list.value_offsets()[list.len()] as usize);
                list.values().slice(first, last - first)
            }
            DataType::FixedSizeList(_, length) => {
                lengths.push(usize::try_from(*length).unwrap_or(0));
                Arc::clone(leaf.as_fixed_size_list().values())
            }
            _ => break,
        };
    }
    if leaf.len() != expected {
        return Err(format!("it has {} values instead of {expected}", leaf.len()));
    }
    // One list may hold the values of any shape, row by row.
    if lengths.len() > 1 && lengths != column.shape && expected > 0 {
        return Err(format!("its rows are lists of the shape {lengths:?}, not {:?}", column.shape));
    }
    match leaf.data_type() {
        // A damaged description of the file, in which floats are read as bits.
        DataType::Boolean if matches!(column.dtype, DType::Float32 | DType::Float64) => {
            Err(format!("it is stored as booleans, and declared as {}", column.dtype.name()))
        }
        DataType::Boolean => append_values(leaf.as_boolean().values().iter().map(i64::from), column.dtype, out),
        DataType::Int8 => append_integers::<Int8Type>(&leaf, column, out),
        DataType::Int16 => append_integers::<Int16Type>(&leaf, column, out),
        DataType::Int32 => append_integers::<Int32Type>(&leaf, column, out),
        DataType::Int64 => append_integers::<Int64Type>(&leaf, column, out),
        DataType::UInt8 => append_integers::<UInt8Type>(&leaf, column, out),
        DataType::UInt16 => append_integers::<UInt16Type>(&leaf, column, out),
        DataType::UInt32 => append_integers::<UInt32Type>(&leaf, column, out),
        DataType::UInt64 => append_integers::<UInt64Type>(&leaf, column, out),
        DataType::Float16 => {
            append_values(leaf.as_primitive::<Float16Type>().values().iter().map(|v| f64::from(*v)), column.dtype, out)
        }
        DataType::Float32 => {
            append_values(leaf.as_primitive::<Float32Type>().values().iter().map(|v| f64::from(*v)), column.dtype, out)
        }
        DataType::Float64 => {
            append_values(leaf.as_primitive::<Float64Type>().values().iter().copied(), column.dtype, out)
        }
        other => Err(format!("it holds {other}, which is not numeric")),
    }
}

/// Checks that all lists have the same length. Damaged files may declare invalid offsets.
fn check_offsets(offsets: &[i32]) -> Result<(), String> {
    let equal = offsets.windows(2).all(|pair| pair[1] - pair[0] == offsets[1] - offsets[0]);
    if equal { Ok(()) } else { Err("its rows have different lengths".to_owned()) }
}

/// Appends integers.
///
/// # Errors
/// If a value does not fit the column's type.
fn append_integers<T: ArrowPrimitiveType>(leaf: &ArrayRef, column: &ColumnSpec, out: &mut Vec<u8>) -> Result<(), String>
where
    T::Native: ArrowNativeType + TryInto<i64>,
{
    let integer = |&value: &T::Native| {
        value.try_into().map_err(|_| format!("it has the value {value:?}, which is more than an int64 can be"))
    };
    let values: Result<Vec<i64>, String> = leaf.as_primitive::<T>().values().iter().map(integer).collect();
    append_values(values?.into_iter(), column.dtype, out)
}

fn append_values<V: Scalar>(
    values: impl ExactSizeIterator<Item = V>,
    dtype: DType,
    out: &mut Vec<u8>,
) -> Result<(), String> {
    let first = out.len();
    out.resize(first + values.len() * dtype.size(), 0);
    cast(values, dtype, &mut out[first..])
}

/// Converts the bytes of a column to an Arrow array, and returns it with its field.
///
/// # Errors
/// If a row has more values than Arrow supports.
pub fn array(name: &str, column: &ColumnSpec, bytes: &[u8]) -> Result<(Field, ArrayRef)> {
    let flat: ArrayRef = match column.dtype {
        DType::Bool => Arc::new(BooleanArray::from(bytes.iter().map(|&v| v != 0).collect::<Vec<bool>>())),
        DType::U8 => Arc::new(primitive::<UInt8Type, 1>(bytes, |[v]| v)),
        DType::Int32 => Arc::new(primitive::<Int32Type, 4>(bytes, i32::from_ne_bytes)),
        DType::Int64 => Arc::new(primitive::<Int64Type, 8>(bytes, i64::from_ne_bytes)),
        DType::Float32 => Arc::new(primitive::<Float32Type, 4>(bytes, f32::from_ne_bytes)),
        DType::Float64 => Arc::new(primitive::<Float64Type, 8>(bytes, f64::from_ne_bytes)),
    };
    let flat_type = flat.data_type().clone();
    if column.len() == 1 {
        return Ok((Field::new(name, flat_type, false), flat));
    }
    let failed = |e: &dyn std::fmt::Display| Error::external(format!("storing column '{}'", column.name), e);
    let length = i32::try_from(column.len()).map_err(|e| failed(&e))?;
    let item = Arc::new(Field::new("element", flat_type, false));
    let list = FixedSizeListArray::try_new(Arc::clone(&item), length, flat, None).map_err(|e| failed(&e))?;
    Ok((Field::new(name, DataType::FixedSizeList(item, length), false), Arc::new(list)))
}

fn primitive<T: ArrowPrimitiveType, const N: usize>(
    bytes: &[u8],
    convert: impl Fn([u8; N]) -> T::Native,
) -> PrimitiveArray<T> {
    let values: Vec<T::Native> = bytes.as_chunks::<N>().0.iter().map(|&chunk| convert(chunk)).collect();
    PrimitiveArray::new(ScalarBuffer::from(values), None)
}

#[cfg(test)]
mod tests {
    use super::*;
    use arrow_array::{Float64Array, UInt64Array};

    fn read(array: &dyn Array, column: &ColumnSpec) -> Result<Vec<u8>, String> {
        let mut out = vec![];
        append(array, column, &mut out).map(|()| out)
    }

    #[test]
    fn values_that_the_column_does_not_have_are_errors() {
        let integers = |value: u64, dtype| read(&UInt64Array::from(vec![1, value]), &ColumnSpec::new("x", dtype, []));
        assert_eq!(integers(1 << 62, DType::Int64), Ok([1_i64, 1 << 62].map(i64::to_ne_bytes).concat()));
        for (value, dtype) in [
            (1 << 63, DType::Int64),
            (1 << 63, DType::Float64),
            (1 << 31, DType::Int32),
            (256, DType::U8),
            (2, DType::Bool),
            ((1 << 53) + 1, DType::Float32),
        ] {
            let error = integers(value, dtype).expect_err("a value that does not fit");
            assert!(error.contains("it has the value"), "{value}: {error}");
        }
        let floats = |value: f64, dtype| read(&Float64Array::from(vec![1.0, value]), &ColumnSpec::new("x", dtype, []));
        assert_eq!(floats(0.1, DType::Float32), Ok([1.0_f32, 0.1].map(f32::to_ne_bytes).concat()));
        for (value, dtype) in [
            (1.5, DType::Int64),
            (f64::NAN, DType::U8),
            (300.0, DType::U8),
            (1e300, DType::Float32),
            (0.5, DType::Bool),
        ] {
            assert!(floats(value, dtype).is_err(), "{value}");
        }
        let booleans = |dtype| read(&BooleanArray::from(vec![true, false]), &ColumnSpec::new("x", dtype, []));
        assert_eq!(booleans(DType::Bool), Ok(vec![1, 0]));
        assert!(booleans(DType::Float32).is_err());
    }

    #[test]
    fn nested_lists_have_the_shape_of_the_column() {
        let list = |length, values: ArrayRef| {
            let item = Arc::new(Field::new("item", values.data_type().clone(), false));
            Arc::new(FixedSizeListArray::new(item, length, values, None)) as ArrayRef
        };
        let nested = list(2, list(3, Arc::new(Float64Array::from(vec![0.0; 12]))));
        let column = |shape: &[usize]| ColumnSpec::new("x", DType::Float64, shape.to_vec());
        assert!(read(&nested, &column(&[2, 3])).is_ok());
        assert!(read(&nested, &column(&[3, 2])).expect_err("another shape").contains("[2, 3], not [3, 2]"));
        let flat = list(6, Arc::new(Float64Array::from(vec![0.0; 12])));
        assert!(read(&flat, &column(&[3, 2])).is_ok());
    }
}
