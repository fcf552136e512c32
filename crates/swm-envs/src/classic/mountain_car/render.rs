//! The picture: the hill as a line, a car on two wheels, and a flag, on 600 x 400 pixels.

use super::physics::{ENDS, height};
use crate::classic::picture::{Color, Surface, pixel};
use crate::classic::turned;
use crate::draw::Point;

/// Width and height of the drawing.
pub const SIZE: (usize, usize) = (600, 400);
/// The colour of hill, car and flag-pole.
pub const INK: [u8; 3] = [0, 0, 0];
const WHEEL: [u8; 3] = [128, 128, 128];
const FLAG: [u8; 3] = [204, 204, 0];

/// Pixels in a unit of the track.
const SCALE: f64 = 600.0 / (ENDS[1] - ENDS[0]);
/// Places at which the hill's line bends.
const BENDS: usize = 100;
/// Half the car's length, its height, and how far it is above the hill; where wheels are, and their radius: pixels.
const CAR: [f64; 2] = [20.0, 20.0];
const CLEARANCE: f64 = 10.0;
const WHEELS: f64 = 10.0;
const WHEEL_RADIUS: i32 = 8;
/// The flag-pole's height, the flag's height and length: pixels.
const POLE: i32 = 50;
const FLAG_SIZE: [i32; 2] = [25, 10];

/// A place on the hill.
fn place(x: f64) -> [f64; 2] {
    [(x - ENDS[0]) * SCALE, height(x) * SCALE]
}

/// Draws the hill: straight lines between places of it.
#[allow(clippy::cast_precision_loss)]
pub fn hill(surface: &mut Surface) {
    let bend = |i: usize| place(ENDS[0] + (ENDS[1] - ENDS[0]) * i as f64 / (BENDS - 1) as f64);
    for i in 1..BENDS {
        surface.fine_line(bend(i - 1), bend(i), Color::new(INK));
    }
}

/// Draws the car, and the flag before it.
#[allow(clippy::cast_possible_truncation)]
pub fn car(surface: &mut Surface, x: f64, flag: f64) {
    let ink = Color::new(INK);
    let [at, above] = place(x);
    let from_car = |corner| {
        let [dx, dy] = turned(corner, (3.0 * x).cos());
        pixel([dx + at, dy + CLEARANCE + above])
    };
    let [half, top] = CAR;
    surface.polygon(&[[-half, 0.0], [-half, top], [half, top], [half, 0.0]].map(from_car), ink);
    for wheel in [WHEELS, -WHEELS] {
        surface.disc(from_car([wheel, 0.0]), WHEEL_RADIUS, Color::new(WHEEL));
    }

    let foot = pixel(place(flag));
    let (tip, [length, width]) = (foot.y + POLE, FLAG_SIZE);
    surface.upright(foot.x, foot.y, tip, ink);
    let corners = [(0, 0), (0, -width), (length, -width / 2)].map(|(dx, dy)| Point::new(foot.x + dx, tip + dy));
    surface.polygon(&corners, Color::new(FLAG));
}
