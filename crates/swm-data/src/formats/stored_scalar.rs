//! Numeric types in third-party files, and their conversion to the types of columns.

use swm_core::DType;

/// Class of a numeric type.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Class {
    Bool,
    Signed,
    Unsigned,
    Float,
}

/// A numeric type as stored in a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct StoredScalar {
    pub class: Class,
    /// Size of a value in bytes.
    pub size: usize,
    pub big_endian: bool,
}

impl StoredScalar {
    /// The stored type, in files that this crate writes, of a column with type `dtype`.
    pub const fn of(dtype: DType) -> Self {
        let class = match dtype {
            DType::Bool => Class::Bool,
            DType::U8 => Class::Unsigned,
            DType::Int32 | DType::Int64 => Class::Signed,
            DType::Float32 | DType::Float64 => Class::Float,
        };
        Self { class, size: dtype.size(), big_endian: false }
    }

    /// The narrowest column type that holds all values without loss (unsigned 64-bit values must be below 2^63).
    pub const fn dtype(self) -> Option<DType> {
        Some(match (self.class, self.size) {
            (Class::Bool, 1) => DType::Bool,
            (Class::Unsigned, 1) => DType::U8,
            (Class::Signed, 1 | 2 | 4) | (Class::Unsigned, 2) => DType::Int32,
            (Class::Signed, 8) | (Class::Unsigned, 4 | 8) => DType::Int64,
            (Class::Float, 2 | 4) => DType::Float32,
            (Class::Float, 8) => DType::Float64,
            _ => return None,
        })
    }

    /// Whether the stored bytes of a value equal its bytes in a column.
    pub fn is_plain(self) -> bool {
        let little = Self { big_endian: self.big_endian && self.size > 1, ..self };
        self.dtype().is_some_and(|dtype| little == Self::of(dtype))
    }

    /// Converts stored values to the bytes of a column with type [`StoredScalar::dtype`].
    ///
    /// # Errors
    /// If an unsigned value is 2^63 or more.
    pub fn convert(self, from: &[u8], to: &mut [u8]) -> Result<(), String> {
        if self.is_plain() {
            to.copy_from_slice(from);
            return Ok(());
        }
        match (self.class, self.size) {
            (Class::Signed, 1) => convert_each(from, to, |[b]: [u8; 1]| i32::from(b.cast_signed()).to_ne_bytes()),
            (Class::Signed, 2) => {
                convert_each(from, to, |b| i32::from(self.read_value(b, i16::from_le_bytes)).to_ne_bytes())
            }
            (Class::Unsigned, 2) => {
                convert_each(from, to, |b| i32::from(self.read_value(b, u16::from_le_bytes)).to_ne_bytes())
            }
            (Class::Unsigned, 4) => {
                convert_each(from, to, |b| i64::from(self.read_value(b, u32::from_le_bytes)).to_ne_bytes())
            }
            (Class::Unsigned, 8) => {
                let mut largest = 0;
                convert_each(from, to, |b| {
                    let value = self.read_value(b, u64::from_le_bytes);
                    largest = largest.max(value);
                    value.to_ne_bytes()
                });
                if i64::try_from(largest).is_err() {
                    return Err(format!("{largest} is too large for a signed 64-bit integer"));
                }
            }
            (Class::Float, 2) => convert_each(from, to, |b| half(self.read_value(b, u16::from_le_bytes)).to_ne_bytes()),
            (_, 4) => convert_each(from, to, |b| self.read_value(b, u32::from_le_bytes).to_ne_bytes()),
            _ => convert_each(from, to, |b| self.read_value(b, u64::from_le_bytes).to_ne_bytes()),
        }
        Ok(())
    }

    fn read_value<const N: usize, T>(self, mut bytes: [u8; N], read: impl Fn([u8; N]) -> T) -> T {
        if self.big_endian {
            bytes.reverse();
        }
        read(bytes)
    }
}

fn convert_each<const N: usize, const M: usize>(
    from: &[u8],
    to: &mut [u8],
    mut convert: impl FnMut([u8; N]) -> [u8; M],
) {
    let (from, to) = (from.as_chunks::<N>().0, to.as_chunks_mut::<M>().0);
    to.iter_mut().zip(from).for_each(|(to, from)| *to = convert(*from));
}

/// Converts half precision (IEEE 754 binary16) to single precision.
fn half(bits: u16) -> f32 {
    let sign = u32::from(bits >> 15) << 31;
    let exponent = u32::from(bits >> 10) & 31;
    let fraction = u32::from(bits & 0x3ff);
    match exponent {
        // A subnormal value is a multiple of 2^-24, which is exact in single precision.
        0 => f32::from_bits(sign) + f32::from_bits(sign | 1.0_f32.to_bits()) * f32::from(bits & 0x3ff) / 16_777_216.0,
        31 => f32::from_bits(sign | 0x7f80_0000 | fraction << 13),
        _ => f32::from_bits(sign | (exponent + 112) << 23 | fraction << 13),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn convert(class: Class, size: usize, big_endian: bool, from: &[u8]) -> Result<Vec<u8>, String> {
        let stored = StoredScalar { class, size, big_endian };
        let dtype = stored.dtype().expect("a numeric type");
        let mut to = vec![0; from.len() / size * dtype.size()];
        stored.convert(from, &mut to).map(|()| to)
    }

    #[test]
    fn converts_values_of_every_width_and_byte_order() {
        assert_eq!(convert(Class::Signed, 2, true, &[0xff, 0xfe]), Ok((-2_i32).to_ne_bytes().to_vec()));
        assert_eq!(convert(Class::Unsigned, 2, false, &[0xfe, 0xff]), Ok(65_534_i32.to_ne_bytes().to_vec()));
        assert_eq!(convert(Class::Signed, 1, false, &[0x80]), Ok((-128_i32).to_ne_bytes().to_vec()));
        assert_eq!(convert(Class::Float, 8, true, &1.5_f64.to_be_bytes()), Ok(1.5_f64.to_ne_bytes().to_vec()));
        assert_eq!(convert(Class::Unsigned, 8, false, &7_u64.to_le_bytes()), Ok(7_i64.to_ne_bytes().to_vec()));
        assert!(
            convert(Class::Unsigned, 8, false, &u64::MAX.to_le_bytes()).expect_err("a value above 2^63").contains("64")
        );
        assert_eq!(StoredScalar { class: Class::Float, size: 16, big_endian: false }.dtype(), None);
    }

    #[test]
    fn converts_half_precision() {
        let cases = [
            (0x3c00, 1.0),
            (0xc000, -2.0),
            (0x7bff, 65504.0),
            (0x0001, 2.0_f32.powi(-24)),
            (0x0400, 2.0_f32.powi(-14)),
        ];
        for (bits, value) in cases {
            assert_eq!(half(bits), value);
        }
        assert_eq!(half(0x83ff), -1023.0 * 2.0_f32.powi(-24));
        assert_eq!(half(0x8000).to_bits(), (-0.0_f32).to_bits());
        assert!(half(0x7e00).is_nan() && half(0xfc00) == f32::NEG_INFINITY);
    }
}
