//! [`not_finite`]: counts the NaN and infinite values of a column.

use crate::DType;

/// Returns the number of NaN and infinite values in the bytes of a column; 0 for integers and booleans.
pub fn not_finite(dtype: DType, bytes: &[u8]) -> usize {
    /// The bits of the exponent, which are all set in NaN and infinite values only.
    const EXPONENT_32: u32 = 0x7f80_0000;
    const EXPONENT_64: u64 = 0x7ff0_0000_0000_0000;
    match dtype {
        DType::Float32 => {
            let is_bad = |bits: &[u8; 4]| u32::from_ne_bytes(*bits) & EXPONENT_32 == EXPONENT_32;
            bytes.as_chunks().0.iter().map(|bits| usize::from(is_bad(bits))).sum()
        }
        DType::Float64 => {
            let is_bad = |bits: &[u8; 8]| u64::from_ne_bytes(*bits) & EXPONENT_64 == EXPONENT_64;
            bytes.as_chunks().0.iter().map(|bits| usize::from(is_bad(bits))).sum()
        }
        DType::Bool | DType::U8 | DType::Int32 | DType::Int64 => 0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_nan_and_infinite_values() {
        let singles = [0.0, f32::MAX, f32::NAN, -f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MIN_POSITIVE, -0.0];
        assert_eq!(not_finite(DType::Float32, bytemuck::cast_slice(&singles)), 4);
        let doubles = [f64::MAX, f64::NAN, f64::NEG_INFINITY, 1e-320];
        assert_eq!(not_finite(DType::Float64, bytemuck::cast_slice(&doubles)), 2);
        assert_eq!(not_finite(DType::U8, &[255; 16]), 0);
        assert_eq!(not_finite(DType::Int32, &[255; 16]), 0);
    }
}
