//! Parameters of a stream that stand among its frames: a decoder keeps them, and they would count for the next file as well.

use crate::mp4::{Codec, Index};

/// Returns whether an encoded frame brings parameters that the header of its file does not have.
pub fn brings_parameters(index: &Index, frame: &[u8]) -> bool {
    let known = |unit: &[u8]| index.extradata.windows(unit.len()).any(|window| window == unit);
    let new = |unit: &[u8]| !unit.is_empty() && !known(unit);
    match (index.codec, index.extradata.first()) {
        (Codec::H264, Some(1)) => {
            let length = 1 + usize::from(index.extradata.get(4).unwrap_or(&3) & 3);
            // Sequence and frame parameter sets, extensions and subsets of the former.
            units(frame, length)
                .any(|unit| unit.first().is_some_and(|b| matches!(b & 31, 7 | 8 | 13 | 15)) && new(unit))
        }
        (Codec::Hevc, Some(1)) => {
            let length = 1 + usize::from(index.extradata.get(21).unwrap_or(&3) & 3);
            // Video, sequence and frame parameter sets.
            units(frame, length).any(|unit| unit.first().is_some_and(|b| matches!(b >> 1 & 63, 32..=34)) && new(unit))
        }
        // Without a record, parameters can stand among the frames only.
        (Codec::H264 | Codec::Hevc, _) => true,
        (Codec::Av1, _) => open_units(frame).any(|(kind, unit)| kind == 1 && new(unit)),
        // Their key frames reset everything that a decoder keeps.
        (Codec::Vp9 | Codec::Ffv1, _) => false,
    }
}

/// The units of an H.264 or H.265 frame, before each of which stands its length as an integer of `size` bytes. They end where a
/// length is wrong, which the decoder reports.
fn units(mut frame: &[u8], size: usize) -> impl Iterator<Item = &[u8]> {
    std::iter::from_fn(move || {
        let (length, rest) = frame.split_at_checked(size)?;
        let length = length.iter().fold(0, |length, byte| length << 8 | usize::from(*byte));
        let (unit, rest) = rest.split_at_checked(length)?;
        frame = rest;
        Some(unit)
    })
}

/// The open bitstream units of an AV1 frame: their types and contents.
fn open_units(mut frame: &[u8]) -> impl Iterator<Item = (u8, &[u8])> {
    std::iter::from_fn(move || {
        let (&header, mut rest) = frame.split_first()?;
        if header & 4 != 0 {
            rest = rest.get(1..)?; // The layers of scalable streams.
        }
        let mut length = rest.len();
        if header & 2 != 0 {
            length = 0;
            for shift in (0..56).step_by(7) {
                let (&byte, after) = rest.split_first()?;
                rest = after;
                length |= usize::from(byte & 127) << shift;
                if byte < 128 {
                    break;
                }
            }
        }
        let (unit, rest) = rest.split_at_checked(length)?;
        frame = rest;
        Some((header >> 3 & 15, unit))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn index(codec: Codec, extradata: &[u8]) -> Index {
        let extradata = extradata.into();
        let (samples, frames, times) = (vec![], vec![], vec![]);
        Index { codec, extradata, colours: None, width: 8, height: 8, samples, frames, times, timescale: 1, sums: None }
    }

    #[test]
    fn parameters_among_frames_are_found_unless_the_header_has_them() {
        // A record whose units have lengths of two bytes, with the parameter set `67 01`.
        let h264 = index(Codec::H264, &[1, 66, 0, 10, 0xfd, 0xe1, 0, 2, 0x67, 1]);
        assert!(!brings_parameters(&h264, &[0, 2, 0x67, 1, 0, 1, 0x65]));
        assert!(brings_parameters(&h264, &[0, 1, 9, 0, 2, 0x68, 7, 0, 1, 0x65]));
        assert!(!brings_parameters(&h264, &[0, 2, 0x65, 0x68, 0, 9, 0x68]), "the last unit is cut short");
        let mut record = vec![1; 23];
        record[21] = 3;
        let hevc = index(Codec::Hevc, &record);
        assert!(brings_parameters(&hevc, &[0, 0, 0, 2, 33 << 1, 5]));
        assert!(!brings_parameters(&hevc, &[0, 0, 0, 2, 19 << 1, 5]));
        assert!(brings_parameters(&index(Codec::H264, &[]), &[0, 0, 0, 1, 0x65]));
        let av1 = index(Codec::Av1, &[0x81, 0, 0, 0, 0x0a, 2, 3, 4]);
        assert!(!brings_parameters(&av1, &[0x12, 0, 0x0a, 2, 3, 4, 0x32, 1, 9]));
        assert!(brings_parameters(&av1, &[0x12, 0, 0x0a, 2, 3, 5, 0x32, 1, 9]));
        assert!(!brings_parameters(&index(Codec::Vp9, &[]), &[0x82, 1, 2]));
    }
}
