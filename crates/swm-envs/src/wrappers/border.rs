//! The mirrored border that filters read beyond the edge of a frame.

/// Returns the pixel, in a line of `n` ≥ 1 pixels, for a position `i` inside or outside the line. The line is mirrored
/// at its last pixels, which are not repeated (OpenCV's default border).
pub fn mirror(i: isize, n: usize) -> usize {
    let inside = i as usize;
    if inside < n {
        return inside;
    }
    let period = 2 * n.saturating_sub(1).max(1);
    let i = i.rem_euclid(period as isize) as usize;
    i.min(period - i).min(n - 1)
}

#[cfg(test)]
mod tests {
    #[test]
    fn mirrored_indices_stay_inside_at_any_distance() {
        let mirrored = |n| (-5..6).map(|i| super::mirror(i, n)).collect::<Vec<_>>();
        assert_eq!(mirrored(3), [1, 0, 1, 2, 1, 0, 1, 2, 1, 0, 1]);
        assert_eq!(mirrored(1), [0; 11]);
    }
}
