//! [`cast`]: values of a file as values of the type of a column, or an error where they are none.

use swm_core::DType;

/// A value that is converted to the type of a column.
pub trait Scalar: Copy {
    /// The value that stands for a null; `None` if the type has no such value.
    const MISSING: Option<Self>;
    /// The value, rounded to `f64`.
    fn f64(self) -> f64;
    /// The value without its fraction.
    fn i64(self) -> i64;
    /// Whether the value is this integer.
    fn is(self, integer: i64) -> bool;
    /// Whether the value is near this one: rounded, but no other integer, and not infinite unless the value is.
    fn is_near(self, single: f32) -> bool;
}

impl Scalar for f64 {
    const MISSING: Option<Self> = Some(Self::NAN);
    fn f64(self) -> f64 {
        self
    }
    fn i64(self) -> i64 {
        self as i64
    }
    fn is(self, integer: i64) -> bool {
        // 2^63 becomes the largest integer, which is rounded to 2^63 again.
        self == integer as f64 && self < i64::MAX as f64
    }
    fn is_near(self, single: f32) -> bool {
        single.is_finite() || !self.is_finite()
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
    fn is(self, integer: i64) -> bool {
        self == integer
    }
    fn is_near(self, single: f32) -> bool {
        (single as i64) == self && single < i64::MAX as f32
    }
}

/// Writes values as a column with type `dtype`. A file may store another type: Lance tables have most columns as `float32`.
///
/// # Errors
/// If a value is not one of the type. Rounding of `float64` is no error for a column of `float32`.
pub fn cast<N: Scalar>(values: impl Iterator<Item = N>, dtype: DType, out: &mut [u8]) -> Result<(), String> {
    /// Writes each value, and finds the first for which the second part is not true.
    fn write_each<const SIZE: usize, N: Scalar>(
        out: &mut [u8],
        values: impl Iterator<Item = N>,
        convert: impl Fn(N) -> ([u8; SIZE], bool),
    ) -> Option<N> {
        let mut wrong = None;
        for (slot, value) in out.chunks_exact_mut(SIZE).zip(values) {
            let (bytes, is_exact) = convert(value);
            slot.copy_from_slice(&bytes);
            if !is_exact {
                wrong = Some(value);
            }
        }
        wrong
    }
    let wrong = match dtype {
        DType::Bool => write_each(out, values, |v| ([u8::from(v.f64() != 0.0)], v.is(0) || v.is(1))),
        DType::U8 => write_each(out, values, |v| ([v.i64() as u8], v.is(i64::from(v.i64() as u8)))),
        DType::Int32 => write_each(out, values, |v| ((v.i64() as i32).to_ne_bytes(), v.is(i64::from(v.i64() as i32)))),
        DType::Int64 => write_each(out, values, |v| (v.i64().to_ne_bytes(), v.is(v.i64()))),
        DType::Float32 => write_each(out, values, |v| {
            let single = v.f64() as f32;
            (single.to_ne_bytes(), v.is_near(single))
        }),
        DType::Float64 => write_each(out, values, |v| (v.f64().to_ne_bytes(), true)),
    };
    match wrong {
        None => Ok(()),
        Some(value) => {
            let value = value.f64();
            // In full, a large number is hundreds of digits.
            let text = if value.abs() < 1e15 { value.to_string() } else { format!("{value:e}") };
            Err(format!("it has the value {text}, which is not one of its type {}", dtype.name()))
        }
    }
}
