//! Colours for depth and segmentation.

/// The colours of equally spaced depths, near to far: dark blue, green, yellow, as in the map "viridis".
const DEPTHS: [[u8; 3]; 9] = [
    [253, 231, 37],
    [173, 220, 48],
    [94, 201, 98],
    [40, 174, 128],
    [33, 145, 140],
    [44, 114, 142],
    [59, 82, 139],
    [71, 45, 123],
    [68, 1, 84],
];

/// Colours of segments that are easy to tell apart.
const SEGMENTS: [[u8; 3]; 12] = [
    [31, 119, 180],
    [255, 127, 14],
    [44, 160, 44],
    [214, 39, 40],
    [148, 103, 189],
    [140, 86, 75],
    [227, 119, 194],
    [127, 127, 127],
    [188, 189, 34],
    [23, 190, 207],
    [174, 199, 232],
    [255, 187, 120],
];

/// The colours of depths in metres, from the nearest to the farthest of the image. Depths that are not finite are black.
pub(super) fn depths(values: &[f32]) -> Vec<[u8; 3]> {
    let finite = values.iter().copied().filter(|value| value.is_finite());
    let (near, far) =
        finite.fold((f32::INFINITY, f32::NEG_INFINITY), |(near, far), value| (near.min(value), far.max(value)));
    let scale = if far > near { (DEPTHS.len() - 1) as f32 / (far - near) } else { 0.0 };
    let colour = |value: f32| {
        if !value.is_finite() {
            return [0; 3];
        }
        let at = (value - near) * scale;
        let (index, share) = (at as usize, at.fract());
        let (low, high) = (DEPTHS[index], DEPTHS[(index + 1).min(DEPTHS.len() - 1)]);
        [0, 1, 2].map(|i| (f32::from(low[i]) * (1.0 - share) + f32::from(high[i]) * share).round() as u8)
    };
    values.iter().map(|&value| colour(value)).collect()
}

/// The colours of segments; negative ones, which are background, are black.
pub(super) fn segments(values: &[i32]) -> Vec<[u8; 3]> {
    let colour = |value: i32| usize::try_from(value).map_or([0; 3], |value| SEGMENTS[value % SEGMENTS.len()]);
    values.iter().map(|&value| colour(value)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nearest_and_farthest_depths_have_the_ends_of_the_map() {
        let colours = depths(&[1.0, 3.0, 2.0, f32::INFINITY]);
        assert_eq!(colours, [DEPTHS[0], DEPTHS[8], DEPTHS[4], [0; 3]]);
        assert_eq!(depths(&[2.0]), [DEPTHS[0]]);
        assert_eq!(segments(&[-1, 0, 13]), [[0; 3], SEGMENTS[0], SEGMENTS[1]]);
    }
}
