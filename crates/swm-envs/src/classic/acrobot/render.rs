//! The picture: two links with their joints, and the line to reach, on 500 x 500 pixels.

use super::physics::{Physics, State};
use crate::classic::picture::{Color, Surface, pixel};
use crate::classic::turned;
use std::f64::consts::FRAC_PI_2;

/// Width and height of the drawing.
pub const SIZE: (usize, usize) = (500, 500);
pub const LINK: [u8; 3] = [0, 204, 204];
pub const JOINT: [u8; 3] = [204, 204, 0];
pub const LINE: [u8; 3] = [0, 0, 0];

/// The middle of the picture.
const MIDDLE: f64 = 250.0;
/// What stays free around stretched links, half a link's width, how high and how long the line is: metres.
const FREE: f64 = 0.2;
const LINK_HALF: f64 = 0.1;
const LINE_HEIGHT: f64 = 1.0;
const LINE_HALF: f64 = 2.2;

/// Pixels in a metre: the links fit in, however long they are.
fn scale(physics: &Physics) -> f64 {
    MIDDLE / (physics.length[0] + physics.length[1] + FREE)
}

/// Draws the line.
pub fn line(surface: &mut Surface, physics: &Physics) {
    let scale = scale(physics);
    let [from, to] = [-LINE_HALF, LINE_HALF].map(|x| pixel([x * scale + MIDDLE, LINE_HEIGHT * scale + MIDDLE]));
    surface.level(from.y, from.x, to.x, Color::new(LINE));
}

/// Draws links and joints.
#[allow(clippy::cast_possible_truncation)]
pub fn links(surface: &mut Surface, physics: &Physics, &[angle, bend, ..]: &State) {
    let scale = scale(physics);
    let half = LINK_HALF * scale;
    let mut joint = [MIDDLE; 2];
    for (length, angle) in physics.length.into_iter().zip([angle, angle + bend]) {
        let length = length * scale;
        let place = |corner| {
            let [x, y] = turned(corner, angle - FRAC_PI_2);
            pixel([x + joint[0], y + joint[1]])
        };
        surface.polygon(&[[0.0, -half], [0.0, half], [length, half], [length, -half]].map(place), Color::new(LINK));
        surface.disc(pixel(joint), half as i32, Color::new(JOINT));
        joint = [joint[0] + length * angle.sin(), joint[1] - length * angle.cos()];
    }
}
