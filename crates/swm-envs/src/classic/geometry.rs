//! Rotation of vectors with the rounding of pygame.

/// Rotates a vector counter-clockwise by an angle in radians.
///
/// As in pygame, an angle within 10⁻⁶ radians of a multiple of a quarter turn counts as this multiple. Otherwise
/// rounding errors could move corners by a pixel.
pub fn rotated([x, y]: [f64; 2], angle: f64) -> [f64; 2] {
    const TOLERANCE: f64 = 1e-6;
    let quarter = std::f64::consts::FRAC_PI_2;
    let angle = angle.rem_euclid(4.0 * quarter);
    if (angle + TOLERANCE) % quarter < 2.0 * TOLERANCE {
        return match ((angle + TOLERANCE) / quarter) as i32 {
            1 => [-y, x],
            2 => [-x, -y],
            3 => [y, -x],
            _ => [x, y],
        };
    }
    let (sin, cos) = angle.sin_cos();
    [cos * x - sin * y, sin * x + cos * y]
}
