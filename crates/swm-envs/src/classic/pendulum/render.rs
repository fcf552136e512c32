//! The picture: a rod around its hub, and an arrow around both that tells the last torque, on 500 x 500 pixels.

use crate::classic::picture::{Color, Surface, pixel};
use crate::classic::turned;
use crate::draw::Point;
use std::f64::consts::FRAC_PI_2;

/// Width and height of the drawing.
pub const SIZE: (usize, usize) = (500, 500);
pub const ROD: [u8; 3] = [204, 77, 77];
pub const HUB: [u8; 3] = [0, 0, 0];

/// Pixels in the rod's length, whatever that is, and the middle of the picture.
const SCALE: f64 = 500.0 / 4.4;
const MIDDLE: f64 = 250.0;
/// Half the rod's width, and the hub's radius.
const ROD_HALF: f64 = 0.1 * SCALE;
const HUB_RADIUS: f64 = 0.05 * SCALE;

/// Draws rod, arrow and hub for an angle from upright, against the clock, and a torque.
#[allow(clippy::cast_possible_truncation)]
pub fn rod(surface: &mut Surface, &[angle, _, torque]: &[f64; 3]) {
    let color = Color::new(ROD);
    let place = |along, across| {
        let [x, y] = turned([along, across], angle + FRAC_PI_2);
        pixel([x + MIDDLE, y + MIDDLE])
    };
    let corners = [(0.0, -ROD_HALF), (0.0, ROD_HALF), (SCALE, ROD_HALF), (SCALE, -ROD_HALF)];
    surface.polygon(&corners.map(|(along, across)| place(along, across)), color);
    let hub = pixel([MIDDLE; 2]);
    surface.disc(hub, ROD_HALF as i32, color);
    surface.disc(place(SCALE, 0.0), ROD_HALF as i32, color);
    arrow(surface, hub, torque);
    surface.disc(hub, HUB_RADIUS as i32, Color::new(HUB));
}

/// The arrow for a clockwise torque, in a box of this width and height, y down: a ring from the top clockwise to the
/// left, and a head that ends it. Measured on the picture that Gymnasium shows.
const BOX: [f64; 2] = [329.0, 312.0];
const CENTRE: [f64; 2] = [173.0, 156.0];
const RING: [f64; 2] = [146.0, 156.0];
const BEGIN: f64 = 170.5;
const TIP: [f64; 2] = [21.5, 110.0];
const NOTCH: [f64; 2] = [22.0, 153.5];
const BARBS: [f64; 2] = [0.0, 45.0];
const BARBS_AT: f64 = 170.0;
/// pygame's `smoothscale` leaves it a hair short of opaque: it stays black whatever the hub's colour is.
const OPACITY: f32 = 0.992;

/// Where the arrow crosses a level line: the ring right and left of its centre, and the two sides of the head.
fn crossings(y: f64) -> [[f64; 2]; 4] {
    const EMPTY: [f64; 2] = [0.0; 2];
    let dy = y - CENTRE[1];
    let [inner, outer] = RING.map(|radius| (radius * radius - dy * dy).max(0.0).sqrt());
    let begin = if dy < 0.0 && inner == 0.0 { BEGIN } else { CENTRE[0] + inner };
    let right = [begin, (CENTRE[0] + outer).max(begin)];
    let left = if y > NOTCH[1] { [CENTRE[0] - outer, CENTRE[0] - inner] } else { EMPTY };
    if !(TIP[1]..BARBS_AT).contains(&y) {
        return [right, left, EMPTY, EMPTY];
    }
    let towards = |from: [f64; 2], x: f64| from[0] + (x - from[0]) * ((y - from[1]) / (BARBS_AT - from[1])).max(0.0);
    let [a, b] = BARBS;
    [right, left, [towards(TIP, a), towards(NOTCH, a)], [towards(NOTCH, b), towards(TIP, b)]]
}

/// Draws the arrow, larger for larger torques.
#[allow(clippy::cast_possible_truncation)]
fn arrow(surface: &mut Surface, centre: Point, torque: f64) {
    let side = (SCALE * torque.abs() / 2.0) as i32;
    let (left, low) = (f64::from(centre.x - side / 2), centre.y - side / 2);
    let [across, down] = BOX.map(|length| f64::from(side) / length);
    surface.shape(low..low + side, Color::new(HUB), OPACITY, |y| {
        crossings((f64::from(low + side) - y) / down).map(|[from, to]| {
            let [from, to] = [from * across, to * across];
            // A torque against the clock is the mirror image.
            if torque > 0.0 {
                [left + f64::from(side) - to, left + f64::from(side) - from]
            } else {
                [left + from, left + to]
            }
        })
    });
}
