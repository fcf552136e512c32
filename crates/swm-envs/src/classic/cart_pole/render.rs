//! Rendering: a track, a cart, a pole and its axle, at 600 x 400 pixels for 4.8 metres of track.

use crate::classic::frame::{Color, Surface, pixel};
use crate::classic::geometry::rotated;

/// Width and height of frames before they are resized, in pixels.
pub const SIZE: (usize, usize) = (600, 400);
/// Colour of cart and track.
pub const CART: [u8; 3] = [0, 0, 0];
/// Colour of the pole.
pub const POLE: [u8; 3] = [202, 152, 101];
/// Colour of the axle.
pub const AXLE: [u8; 3] = [129, 132, 203];

/// Pixels per metre.
const SCALE: f64 = 600.0 / 4.8;
/// Column of the centre of the track.
const MIDDLE: f64 = 300.0;
/// Row of the track, at the centre of the cart.
const TRACK: i32 = 100;
/// Half the width and height of the cart, in pixels.
const CART_HALF: [f64; 2] = [25.0, 15.0];
/// Height of the axle above the centre of the cart, in pixels.
const AXLE_ABOVE: f64 = 7.5;
/// Half the width of the pole, in pixels.
const POLE_HALF: f64 = 5.0;

/// Draws the track.
pub fn track(surface: &mut Surface) {
    surface.horizontal_line(TRACK, 0, SIZE.0 as i32, Color::new(CART));
}

/// Draws cart, pole and axle, and the track that crosses them. `length` is half the length of the pole, in metres.
pub fn cart(surface: &mut Surface, state: &[f64; 5], length: f64) {
    let (x, y) = (state[0] * SCALE + MIDDLE, f64::from(TRACK));
    let [wide, high] = CART_HALF;
    let corners = [[-wide, -high], [-wide, high], [wide, high], [wide, -high]];
    surface.polygon(&corners.map(|[dx, dy]| pixel([x + dx, y + dy])), Color::new(CART));

    let top = SCALE * (2.0 * length) - POLE_HALF;
    let corners = [[-POLE_HALF, -POLE_HALF], [-POLE_HALF, top], [POLE_HALF, top], [POLE_HALF, -POLE_HALF]];
    let to_pixel = |corner| {
        let [dx, dy] = rotated(corner, -state[2]);
        pixel([x + dx, y + AXLE_ABOVE + dy])
    };
    surface.polygon(&corners.map(to_pixel), Color::new(POLE));
    surface.disc(pixel([x, y + AXLE_ABOVE]), POLE_HALF as i32, Color::new(AXLE));

    // The track is redrawn only in the drawn columns, because resizing costs time for every drawn pixel.
    surface.fill_drawn(TRACK, Color::new(CART));
}
