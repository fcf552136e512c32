//! Rotation of vectors with the rounding of pygame.

/// Rotates a vector counter-clockwise by an angle in radians.
///
/// As in pygame, angles within a millionth of a quarter turn count as quarter turns, which decides whole pixels.
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
