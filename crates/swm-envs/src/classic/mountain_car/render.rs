//! Rendering: the hill as a line, a car on two wheels, and a flag, at 600 x 400 pixels.

use super::physics::{ENDS, height};
use crate::classic::frame::{Color, Surface, pixel};
use crate::classic::geometry::rotated;
use crate::draw::Point;

/// Width and height of frames before they are resized, in pixels.
pub const SIZE: (usize, usize) = (600, 400);
/// Colour of hill, car and flagpole.
pub const INK: [u8; 3] = [0, 0, 0];
/// Colour of the wheels.
const WHEEL: [u8; 3] = [128, 128, 128];
/// Colour of the flag.
const FLAG: [u8; 3] = [204, 204, 0];

/// Pixels per track unit.
const SCALE: f64 = 600.0 / (ENDS[1] - ENDS[0]);
/// Points of the polyline of the hill.
const HILL_POINTS: usize = 100;
/// Half the length, and the full height, of the car, in pixels.
const CAR: [f64; 2] = [20.0, 20.0];
/// Height of the car above the hill, in pixels.
const CLEARANCE: f64 = 10.0;
/// Distance of the wheels from the centre of the car, in pixels.
const WHEELS: f64 = 10.0;
/// Radius of the wheels, in pixels.
const WHEEL_RADIUS: i32 = 8;
/// Height of the flagpole, in pixels.
const POLE: i32 = 50;
/// Length and width of the flag, in pixels.
const FLAG_SIZE: [i32; 2] = [25, 10];

/// Returns the point of the hill at a position, in pixels, y up.
fn hill_point(x: f64) -> [f64; 2] {
    [(x - ENDS[0]) * SCALE, height(x) * SCALE]
}

/// Draws the hill as a polyline.
pub fn hill(surface: &mut Surface) {
    let point = |i: usize| hill_point(ENDS[0] + (ENDS[1] - ENDS[0]) * i as f64 / (HILL_POINTS - 1) as f64);
    for i in 1..HILL_POINTS {
        surface.fine_line(point(i - 1), point(i), Color::new(INK));
    }
}

/// Draws the car at position `x` and, over it, the flag at position `flag`, both in track units.
pub fn car(surface: &mut Surface, x: f64, flag: f64) {
    let ink = Color::new(INK);
    let [at, height] = hill_point(x);
    let to_pixel = |corner| {
        let [dx, dy] = rotated(corner, (3.0 * x).cos());
        pixel([dx + at, dy + CLEARANCE + height])
    };
    let [half, top] = CAR;
    surface.polygon(&[[-half, 0.0], [-half, top], [half, top], [half, 0.0]].map(to_pixel), ink);
    for wheel in [WHEELS, -WHEELS] {
        surface.disc(to_pixel([wheel, 0.0]), WHEEL_RADIUS, Color::new(WHEEL));
    }

    let foot = pixel(hill_point(flag));
    let (tip, [length, width]) = (foot.y + POLE, FLAG_SIZE);
    surface.vertical_line(foot.x, foot.y, tip, ink);
    let corners = [(0, 0), (0, -width), (length, -width / 2)].map(|(dx, dy)| Point::new(foot.x + dx, tip + dy));
    surface.polygon(&corners, Color::new(FLAG));
}
