//! Draws arrows that show the drift of every zone.
//!
//! Sizes and proportions are those of the reference's vector field (matplotlib's `quiver` with the settings of
//! `piecewise_env.py`).

use super::physics::{GRID, ZONES};
use crate::draw::{Pixels, Rgb};
use crate::point_agent::room::{BORDER, SIZE};
use std::f64::consts::PI;

const COLOR: Rgb = [17; 3];
const OPACITY: f64 = 0.85;
/// Arrows along a side of a zone.
const PER_ZONE: usize = 3;
/// Thickness of a shaft, in pixels.
const THICKNESS: f64 = 0.006 * SIZE;
/// Width of a head, in shaft thicknesses.
const HEAD_WIDTH: f64 = 4.0;
/// Length of a head from its tip to the ends of its barbs, in shaft thicknesses.
const HEAD: f64 = 4.0;
/// Length of a head along the shaft, from its tip to the shaft's end, in shaft thicknesses.
const HEAD_AXIS: f64 = 3.5;
/// The length in shaft thicknesses below which an arrow is drawn as a dot, of this diameter.
const MIN_LENGTH: f64 = 0.5;

/// Draws the arrows of all zones for their drift in pixels per step.
pub fn draw(drift: &[[f64; 2]; ZONES], pixels: &mut Pixels<'_>) {
    let zone = (SIZE - 2.0 * BORDER) / GRID as f64;
    // A drift of 5 pixels along both axes is drawn as long as 15 % of a zone's side.
    let scale = zone * 0.15 / (5.0 * 2.0_f64.sqrt());
    let spacing = zone / PER_ZONE as f64;
    for row in 0..GRID * PER_ZONE {
        for column in 0..GRID * PER_ZONE {
            let tail = [column, row].map(|i| BORDER + (i as f64 + 0.5) * spacing);
            let [x, y] = drift[row / PER_ZONE * GRID + column / PER_ZONE];
            arrow(tail, x.hypot(y) * scale / THICKNESS, y.atan2(x), pixels);
        }
    }
}

/// Draws an arrow from its tail (pixels); `length` is in shaft thicknesses, `angle` in radians.
fn arrow(tail: [f64; 2], length: f64, angle: f64, pixels: &mut Pixels<'_>) {
    let (sin, cos) = angle.sin_cos();
    let at = |[x, y]: [f64; 2]| {
        let [x, y] = [x * THICKNESS, y * THICKNESS];
        [tail[0] + x * cos - y * sin, tail[1] + x * sin + y * cos]
    };
    if length < MIN_LENGTH {
        let corner = |i: u8| (f64::from(i) * PI / 3.0).sin_cos();
        let dot = [0, 1, 2, 3, 4, 5].map(corner).map(|(sin, cos)| at([cos * MIN_LENGTH / 2.0, sin * MIN_LENGTH / 2.0]));
        pixels.polygon(&dot, COLOR, OPACITY);
        return;
    }
    // An arrow shorter than a head is drawn as a head, scaled down to the arrow's length.
    let (total, size) = if length < HEAD { (HEAD, length / HEAD) } else { (length, 1.0) };
    let half = [[0.0, 0.5], [total - HEAD_AXIS, 0.5], [total - HEAD, HEAD_WIDTH / 2.0], [total, 0.0]];
    let [a, b, c, tip] = half.map(|p| p.map(|v| v * size));
    let flip = |[x, y]: [f64; 2]| [x, -y];
    pixels.polygon(&[a, b, c, tip, flip(c), flip(b), flip(a)].map(at), COLOR, OPACITY);
}
