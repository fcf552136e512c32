//! Rendering: a rod around its hub, and a circular arrow that shows the last torque, at 500 x 500 pixels.

use crate::classic::frame::{Color, Surface, pixel};
use crate::classic::geometry::rotated;
use crate::draw::Point;
use std::f64::consts::FRAC_PI_2;

/// Width and height of frames before they are resized, in pixels.
pub const SIZE: (usize, usize) = (500, 500);
/// Colour of the rod.
pub const ROD: [u8; 3] = [204, 77, 77];
/// Colour of hub and arrow.
pub const HUB: [u8; 3] = [0, 0, 0];

/// Length of the drawn rod, for every physical length, in pixels.
const SCALE: f64 = 500.0 / 4.4;
/// Coordinate of the centre of the frame, in pixels.
const MIDDLE: f64 = 250.0;
/// Half the width of the rod, in pixels.
const ROD_HALF: f64 = 0.1 * SCALE;
/// Radius of the hub, in pixels.
const HUB_RADIUS: f64 = 0.05 * SCALE;

/// Draws rod, arrow and hub. The angle is measured from upright, counter-clockwise.
pub fn rod(surface: &mut Surface, &[angle, _, torque]: &[f64; 3]) {
    let color = Color::new(ROD);
    let to_pixel = |along, across| {
        let [x, y] = rotated([along, across], angle + FRAC_PI_2);
        pixel([x + MIDDLE, y + MIDDLE])
    };
    let corners = [(0.0, -ROD_HALF), (0.0, ROD_HALF), (SCALE, ROD_HALF), (SCALE, -ROD_HALF)];
    surface.polygon(&corners.map(|(along, across)| to_pixel(along, across)), color);
    let hub = pixel([MIDDLE; 2]);
    surface.disc(hub, ROD_HALF as i32, color);
    surface.disc(to_pixel(SCALE, 0.0), ROD_HALF as i32, color);
    arrow(surface, hub, torque);
    surface.disc(hub, HUB_RADIUS as i32, Color::new(HUB));
}

// The arrow for a clockwise torque: a ring from the top clockwise to the left, and a head at its end. Coordinates are
// in pixels of Gymnasium's arrow image, y down, and were measured on this image.

/// Width and height of the arrow image.
const BOX: [f64; 2] = [329.0, 312.0];
/// Centre of the ring.
const CENTRE: [f64; 2] = [173.0, 156.0];
/// Inner and outer radius of the ring.
const RING: [f64; 2] = [146.0, 156.0];
/// x at which the ring starts, above its inner circle.
const BEGIN: f64 = 170.5;
/// Tip of the head.
const TIP: [f64; 2] = [21.5, 110.0];
/// Notch of the head, between its barbs.
const NOTCH: [f64; 2] = [22.0, 153.5];
/// x of the ends of the left and the right barb.
const BARBS: [f64; 2] = [0.0, 45.0];
/// y of the ends of the barbs.
const BARBS_AT: f64 = 170.0;
/// Opacity of the arrow. pygame's `smoothscale` leaves the opacity slightly below 1, so the colour replacement does not
/// match and the arrow stays black for every colour of the hub.
const OPACITY: f32 = 0.992;

/// Returns the intervals in which the arrow crosses a horizontal line: the ring right and left of its centre, and the
/// two sides of the head.
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
fn arrow(surface: &mut Surface, centre: Point, torque: f64) {
    let side = (SCALE * torque.abs() / 2.0) as i32;
    let (left, low) = (f64::from(centre.x - side / 2), centre.y - side / 2);
    let [across, down] = BOX.map(|length| f64::from(side) / length);
    surface.fill_spans(low..low + side, Color::new(HUB), OPACITY, |y| {
        crossings((f64::from(low + side) - y) / down).map(|[from, to]| {
            let [from, to] = [from * across, to * across];
            // A counter-clockwise torque is shown by the mirror image.
            if torque > 0.0 {
                [left + f64::from(side) - to, left + f64::from(side) - from]
            } else {
                [left + from, left + to]
            }
        })
    });
}
