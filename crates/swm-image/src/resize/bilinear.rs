//! OpenCV's bilinear interpolation (`INTER_LINEAR`) of bytes, in its fixed-point arithmetic. Pixels of the result blend
//! at most four pixels of the source, also when the image shrinks.

/// Fixed-point 1.
const ONE: i32 = 2048;

/// The two pixels of the source, in one direction, that a pixel of the result lies between.
#[derive(Clone, Copy, Debug)]
pub struct BilinearTap {
    /// The pixel to the left or above.
    pub first: usize,
    /// The pixel to the right or below.
    pub second: usize,
    /// Weights of `first` and `second` in units of 1/2048. They sum to 2048.
    pub weights: [i32; 2],
}

/// Returns the taps of one direction, from `from` pixels to `to` pixels.
pub fn bilinear_taps(from: usize, to: usize) -> Vec<BilinearTap> {
    let scale = from as f64 / to as f64;
    let last = from - 1;
    (0..to)
        .map(|i| {
            let at = ((i as f64 + 0.5) * scale - 0.5) as f32;
            let (first, fraction) = if at < 0.0 { (0, 0.0) } else { (at as usize, at - at.floor()) };
            let (first, fraction) = if first >= last { (last, 0.0) } else { (first, fraction) };
            let weight = (fraction * ONE as f32).round_ties_even() as i32;
            BilinearTap { first, second: (first + 1).min(last), weights: [ONE - weight, weight] }
        })
        .collect()
}

/// Blends four pixels: upper left, upper right, lower left, lower right. `across` and `down` are the weights of the
/// horizontal tap and of the vertical tap.
#[inline(always)]
pub fn bilinear_blend(pixels: [[u8; 3]; 4], across: [i32; 2], down: [i32; 2]) -> [u8; 3] {
    std::array::from_fn(|i| {
        let [a, b, c, d] = pixels.map(|pixel| i32::from(pixel[i]));
        let above = (a * across[0] + b * across[1]) >> 4;
        let below = (c * across[0] + d * across[1]) >> 4;
        ((((down[0] * above) >> 16) + ((down[1] * below) >> 16) + 2) >> 2) as u8
    })
}
