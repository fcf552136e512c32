//! The picture: a track, a cart, a pole and its axle, on 600 x 400 pixels for 4.8 metres of track.

use crate::classic::picture::{Color, Surface, pixel};
use crate::classic::turned;

/// Width and height of the drawing.
pub const SIZE: (usize, usize) = (600, 400);
/// The colours of the drawing: cart and track, pole, axle.
pub const CART: [u8; 3] = [0, 0, 0];
pub const POLE: [u8; 3] = [202, 152, 101];
pub const AXLE: [u8; 3] = [129, 132, 203];

/// Pixels in a metre, and where the middle of the track is.
const SCALE: f64 = 600.0 / 4.8;
const MIDDLE: f64 = 300.0;
/// The row of the track; the middle of the cart.
const TRACK: i32 = 100;
/// Half the cart's width and height, how far the axle is above its middle, half the pole's width: all in pixels.
const CART_HALF: [f64; 2] = [25.0, 15.0];
const AXLE_ABOVE: f64 = 7.5;
const POLE_HALF: f64 = 5.0;

/// Draws the track.
pub fn track(surface: &mut Surface) {
    surface.level(TRACK, 0, SIZE.0 as i32, Color::new(CART));
}

/// Draws cart, pole and axle, and the track that crosses them. `length` is half the pole's.
pub fn cart(surface: &mut Surface, state: &[f64; 5], length: f64) {
    let (x, y) = (state[0] * SCALE + MIDDLE, f64::from(TRACK));
    let [wide, high] = CART_HALF;
    let corners = [[-wide, -high], [-wide, high], [wide, high], [wide, -high]];
    surface.polygon(&corners.map(|[dx, dy]| pixel([x + dx, y + dy])), Color::new(CART));

    let top = SCALE * (2.0 * length) - POLE_HALF;
    let corners = [[-POLE_HALF, -POLE_HALF], [-POLE_HALF, top], [POLE_HALF, top], [POLE_HALF, -POLE_HALF]];
    let place = |corner| {
        let [dx, dy] = turned(corner, -state[2]);
        pixel([x + dx, y + AXLE_ABOVE + dy])
    };
    surface.polygon(&corners.map(place), Color::new(POLE));
    #[allow(clippy::cast_possible_truncation)]
    surface.disc(pixel([x, y + AXLE_ABOVE]), POLE_HALF as i32, Color::new(AXLE));

    // Only where something was drawn: a frame costs what differs from the background.
    surface.level_over(TRACK, Color::new(CART));
}
