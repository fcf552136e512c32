//! What filters see beyond the edge of a picture.

/// The pixel in a line of `n`, at least 1, that stands for place `i`, inside or not: the line mirrored at its last pixels, which
/// are not repeated (OpenCV's default border).
#[allow(clippy::cast_possible_wrap, clippy::cast_sign_loss)]
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
    fn lines_are_mirrored_however_far_one_looks() {
        let seen = |n| (-5..6).map(|i| super::mirror(i, n)).collect::<Vec<_>>();
        assert_eq!(seen(3), [1, 0, 1, 2, 1, 0, 1, 2, 1, 0, 1]);
        assert_eq!(seen(1), [0; 11]);
    }
}
