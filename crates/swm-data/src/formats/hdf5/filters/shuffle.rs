//! Shuffle: stores the first bytes of all elements, then their second bytes, and so on.

/// Unshuffles bytes. Bytes after the last whole element are not shuffled.
pub fn undo(from: &[u8], size: usize, out: &mut [u8]) -> Result<(), String> {
    if from.len() != out.len() {
        return Err(format!("a chunk has {} bytes instead of {}", from.len(), out.len()));
    }
    let count = out.len() / size.max(1);
    if size <= 1 || count == 0 {
        out.copy_from_slice(from);
        return Ok(());
    }
    match size {
        2 => unshuffle::<2>(from, count, out),
        4 => unshuffle::<4>(from, count, out),
        8 => unshuffle::<8>(from, count, out),
        _ => {
            for (byte, row) in from.chunks_exact(count).enumerate().take(size) {
                out[byte..].iter_mut().step_by(size).zip(row).for_each(|(target, &value)| *target = value);
            }
        }
    }
    let whole = count * size;
    out[whole..].copy_from_slice(&from[whole..]);
    Ok(())
}

fn unshuffle<const N: usize>(from: &[u8], count: usize, out: &mut [u8]) {
    let rows: [&[u8]; N] = std::array::from_fn(|byte| &from[byte * count..(byte + 1) * count]);
    for (i, target) in out.as_chunks_mut::<N>().0.iter_mut().enumerate() {
        *target = std::array::from_fn(|byte| rows[byte][i]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn undo_reverses_the_byte_shuffle() {
        for size in [1, 2, 3, 4, 8, 12] {
            let bytes: Vec<u8> = (0..100).collect();
            let count = bytes.len() / size;
            let mut shuffled: Vec<u8> = (0..size).flat_map(|b| (0..count).map(move |i| (i * size + b) as u8)).collect();
            shuffled.extend(&bytes[count * size..]);
            let mut out = vec![0; 100];
            undo(&shuffled, size, &mut out).expect("unshuffling the bytes");
            assert_eq!(out, bytes, "{size}");
        }
        assert!(undo(&[1, 2], 2, &mut [0; 3]).is_err());
    }
}
