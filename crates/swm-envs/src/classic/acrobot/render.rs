//! Rendering: two links with their joints, and the line to reach, at 500 x 500 pixels.

use super::physics::{Physics, State};
use crate::classic::frame::{Color, Surface, pixel};
use crate::classic::geometry::rotated;
use std::f64::consts::FRAC_PI_2;

/// Width and height of frames before they are resized, in pixels.
pub const SIZE: (usize, usize) = (500, 500);
/// Colour of the links.
pub const LINK: [u8; 3] = [0, 204, 204];
/// Colour of the joints.
pub const JOINT: [u8; 3] = [204, 204, 0];
/// Colour of the goal line.
pub const LINE: [u8; 3] = [0, 0, 0];

/// Coordinate of the centre of the frame, in pixels.
const MIDDLE: f64 = 250.0;
/// Margin around the stretched links, in metres.
const MARGIN: f64 = 0.2;
/// Half the width of a link, in metres.
const LINK_HALF: f64 = 0.1;
/// Height of the line above the bar, in metres.
const LINE_HEIGHT: f64 = 1.0;
/// Half the length of the line, in metres.
const LINE_HALF: f64 = 2.2;

/// Returns the scale in pixels per metre, at which the stretched links fit into the frame.
fn scale(physics: &Physics) -> f64 {
    MIDDLE / (physics.length[0] + physics.length[1] + MARGIN)
}

/// Draws the goal line.
pub fn line(surface: &mut Surface, physics: &Physics) {
    let scale = scale(physics);
    let [from, to] = [-LINE_HALF, LINE_HALF].map(|x| pixel([x * scale + MIDDLE, LINE_HEIGHT * scale + MIDDLE]));
    surface.horizontal_line(from.y, from.x, to.x, Color::new(LINE));
}

/// Draws the links and the joints.
pub fn links(surface: &mut Surface, physics: &Physics, &[angle, joint_angle, ..]: &State) {
    let scale = scale(physics);
    let half = LINK_HALF * scale;
    let mut joint = [MIDDLE; 2];
    for (length, angle) in physics.length.into_iter().zip([angle, angle + joint_angle]) {
        let length = length * scale;
        let to_pixel = |corner| {
            let [x, y] = rotated(corner, angle - FRAC_PI_2);
            pixel([x + joint[0], y + joint[1]])
        };
        surface.polygon(&[[0.0, -half], [0.0, half], [length, half], [length, -half]].map(to_pixel), Color::new(LINK));
        surface.disc(pixel(joint), half as i32, Color::new(JOINT));
        joint = [joint[0] + length * angle.sin(), joint[1] - length * angle.cos()];
    }
}
