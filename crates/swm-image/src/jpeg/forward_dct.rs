//! The cosine transform of 8 × 8 blocks, for the encoder: IEEE single precision in a fixed order, so that equal images
//! give equal bytes on every machine.

/// Eight values, one in each lane.
type Lanes = [f32; 8];
/// An 8 × 8 block, row-major.
pub type Block = [Lanes; 8];

/// Transforms a block in both dimensions. The result is transposed, and its coefficients keep the factors that
/// `encode::reciprocals` divides by.
pub fn forward_dct(block: &Block) -> Block {
    let mut rows = *block;
    transform_rows(&mut rows);
    rows = std::array::from_fn(|row| std::array::from_fn(|column| rows[column][row]));
    transform_rows(&mut rows);
    rows
}

/// Transforms every lane (column) across the eight rows (Arai, Agui and Nakajima 1988: 5 multiplications).
#[allow(clippy::needless_range_loop, reason = "the loop is over lanes, each of which crosses all rows")]
fn transform_rows(r: &mut Block) {
    for i in 0..8 {
        let (s07, d07, s16, d16) = (r[0][i] + r[7][i], r[0][i] - r[7][i], r[1][i] + r[6][i], r[1][i] - r[6][i]);
        let (s25, d25, s34, d34) = (r[2][i] + r[5][i], r[2][i] - r[5][i], r[3][i] + r[4][i], r[3][i] - r[4][i]);
        let (even0, even3, even1, even2) = (s07 + s34, s07 - s34, s16 + s25, s16 - s25);
        let turned = (even2 + even3) * std::f32::consts::FRAC_1_SQRT_2;
        let (a, b, c) = (d34 + d25, d25 + d16, d16 + d07);
        // Factors: sin(pi / 8), then cos(pi / 8) - sin(pi / 8) and cos(pi / 8) + sin(pi / 8).
        let shared = (a - c) * 0.382_683_43;
        let (low, high) = (a * 0.541_196_1 + shared, c * 1.306_563 + shared);
        let middle = b * std::f32::consts::FRAC_1_SQRT_2;
        let (plus, minus) = (d07 + middle, d07 - middle);
        (r[0][i], r[4][i]) = (even0 + even1, even0 - even1);
        (r[2][i], r[6][i]) = (even3 + turned, even3 - turned);
        (r[5][i], r[3][i]) = (minus + low, minus - low);
        (r[1][i], r[7][i]) = (plus + high, plus - high);
    }
}
