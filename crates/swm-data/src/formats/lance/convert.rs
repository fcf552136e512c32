//! Converts Arrow values to the bytes of a column.

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
            cast(values.iter().map(|v| v.map_or(f64::NAN, f64::from)), dtype, out);
            Ok(())
        }
        DataType::Int8 => cast_all::<Int8Type, i64>(&elements, dtype, out),
        DataType::Int16 => cast_all::<Int16Type, i64>(&elements, dtype, out),
        DataType::Int32 => cast_all::<Int32Type, i64>(&elements, dtype, out),
        DataType::Int64 => cast_all::<Int64Type, i64>(&elements, dtype, out),
        DataType::UInt8 => cast_all::<UInt8Type, i64>(&elements, dtype, out),
        DataType::UInt16 => cast_all::<UInt16Type, i64>(&elements, dtype, out),
        DataType::UInt32 => cast_all::<UInt32Type, i64>(&elements, dtype, out),
        DataType::UInt64 => {
            let values = elements.as_primitive::<UInt64Type>().values().iter().map(|&v| v as i64);
            cast(values, dtype, out);
            Ok(())
        }
        DataType::Boolean if elements.null_count() == 0 => {
            cast(elements.as_boolean().values().iter().map(i64::from), dtype, out);
            Ok(())
        }
        other => Err(format!("{other} is not a supported numeric type")),
    }
}

/// A value that is converted to the type of a column.
pub trait Scalar: Copy {
    /// The value that stands for a null; `None` if the type has no such value.
    const MISSING: Option<Self>;
    /// The value, rounded to `f64`.
    fn f64(self) -> f64;
    /// The value without its fraction.
    fn i64(self) -> i64;
}

impl Scalar for f64 {
    const MISSING: Option<Self> = Some(Self::NAN);
    fn f64(self) -> f64 {
        self
    }
    fn i64(self) -> i64 {
        self as i64
    }
}

impl Scalar for i64 {
    const MISSING: Option<Self> = None;
    fn f64(self) -> f64 {
        self as f64
    }
    fn i64(self) -> i64 {
        self
    }
}

fn cast_all<T, N>(values: &ArrayRef, dtype: DType, out: &mut [u8]) -> Result<(), String>
where
    T: ArrowPrimitiveType,
    N: Scalar + From<T::Native>,
{
    let values = values.as_primitive::<T>();
    if values.null_count() == 0 {
        cast(values.values().iter().map(|&v| N::from(v)), dtype, out);
        return Ok(());
    }
    let Some(missing) = N::MISSING else {
        return Err(format!("it has {} null values, which its type does not allow", values.null_count()));
    };
    cast(values.iter().map(|v| v.map_or(missing, N::from)), dtype, out);
    Ok(())
}

/// Writes values as a column with type `dtype`.
pub fn cast<N: Scalar>(values: impl Iterator<Item = N>, dtype: DType, out: &mut [u8]) {
    fn write_each<const SIZE: usize>(out: &mut [u8], values: impl Iterator<Item = [u8; SIZE]>) {
        out.chunks_exact_mut(SIZE).zip(values).for_each(|(slot, value)| slot.copy_from_slice(&value));
    }
    match dtype {
        DType::Bool => write_each(out, values.map(|v| [u8::from(v.f64() != 0.0)])),
        DType::U8 => write_each(out, values.map(|v| [v.i64() as u8])),
        DType::Int32 => write_each(out, values.map(|v| (v.i64() as i32).to_ne_bytes())),
        DType::Int64 => write_each(out, values.map(|v| v.i64().to_ne_bytes())),
        DType::Float32 => write_each(out, values.map(|v| (v.f64() as f32).to_ne_bytes())),
        DType::Float64 => write_each(out, values.map(|v| v.f64().to_ne_bytes())),
    }
}

/// Converts integers of any width to 64 bits.
pub fn integers(values: &ArrayRef, out: &mut [i64]) -> Result<()> {
    convert(values, 1, DType::Int64, bytemuck::cast_slice_mut(out)).map_err(|problem| {
        Error::mismatch("reading an index column", format!("invalid values ({problem})"), "integers")
    })
}
