//! Calls of the crate `hdf5-pure`, which reads the structure of a file. Panics of the crate become errors.

use crate::formats::stored_scalar::{Class, StoredScalar};
use hdf5_pure::{Datatype, DatatypeByteOrder, FloatingPointLayout};
use swm_core::guarded::guarded;

/// Calls `hdf5-pure`, which may panic on damaged files.
pub(super) fn catch_panic<T, E: std::fmt::Display>(
    action: &str,
    code: impl FnOnce() -> Result<T, E>,
) -> Result<T, String> {
    guarded(code).and_then(|result| result.map_err(|e| e.to_string())).map_err(|problem| format!("{action}: {problem}"))
}

/// The numeric type of a dataset; `None` for text and compound types.
pub(super) fn scalar_type(datatype: &Datatype) -> Option<StoredScalar> {
    let (class, size, order) = match datatype {
        Datatype::FixedPoint { size, byte_order, layout } => {
            if layout.bit_offset != 0 || size.checked_mul(8) != Some(u32::from(layout.bit_precision)) {
                return None;
            }
            (if layout.signed { Class::Signed } else { Class::Unsigned }, *size, *byte_order)
        }
        Datatype::FloatingPoint { size, byte_order, layout } => {
            // Accepts IEEE 754 types with 16, 32 or 64 bits.
            let half = FloatingPointLayout {
                bit_precision: 16,
                exponent_location: 10,
                exponent_size: 5,
                mantissa_size: 10,
                exponent_bias: 15,
                ..FloatingPointLayout::IEEE754_BINARY32
            };
            let known =
                [(2, half), (4, FloatingPointLayout::IEEE754_BINARY32), (8, FloatingPointLayout::IEEE754_BINARY64)];
            if !known.contains(&(*size, *layout)) {
                return None;
            }
            (Class::Float, *size, *byte_order)
        }
        // h5py stores booleans as an enumeration with two members, 0 and 1; others are numbers.
        Datatype::Enumeration { size: 1, members, .. }
            if members.len() == 2 && [0, 1].iter().all(|value| members.iter().any(|it| it.value == [*value])) =>
        {
            (Class::Bool, 1, DatatypeByteOrder::LittleEndian)
        }
        Datatype::Enumeration { base_type, .. } => return scalar_type(base_type),
        _ => return None,
    };
    let big_endian = match order {
        DatatypeByteOrder::LittleEndian => false,
        DatatypeByteOrder::BigEndian => true,
        DatatypeByteOrder::Vax => return None,
    };
    let stored = StoredScalar { class, size: size as usize, big_endian };
    stored.dtype().map(|_| stored)
}

#[cfg(test)]
mod tests {
    use super::*;
    use hdf5_pure::FixedPointLayout;

    #[test]
    fn sizes_of_numbers_in_bits_do_not_overflow() {
        let number = |size, bits| {
            let layout = FixedPointLayout { signed: false, bit_offset: 0, bit_precision: bits };
            scalar_type(&Datatype::FixedPoint { size, byte_order: DatatypeByteOrder::LittleEndian, layout })
        };
        assert_eq!(number(4, 32).map(|stored| stored.size), Some(4));
        // Eight times this size is 8 bits modulo 2^32.
        assert!(number((1 << 29) + 1, 8).is_none() && number(u32::MAX, 65_528).is_none());
    }
}
