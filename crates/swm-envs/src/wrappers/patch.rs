//! Rectangles of one colour, placed at random: what cutouts, occlusions and moving patches are made of.

use rand::Rng as _;
use swm_core::{FrameMut, Rng};

/// A rectangle of a picture, in pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rect {
    pub x: usize,
    pub y: usize,
    pub width: usize,
    pub height: usize,
}

impl Rect {
    /// Fills it, as far as it lies in the picture.
    pub fn fill(self, color: [u8; 3], frame: &mut FrameMut<'_>) {
        let (left, right) = (self.x.min(frame.width), (self.x + self.width).min(frame.width));
        let pixels = frame.rgb.as_chunks_mut::<3>().0;
        for y in self.y..(self.y + self.height).min(frame.height) {
            pixels[y * frame.width..][left..right].fill(color);
        }
    }
}

/// A rectangle drawn at random for pictures of any size: parts of what they offer, each in 0 ..= 1.
#[derive(Clone, Copy, Debug)]
pub struct Patch {
    /// Height and width, as parts of the picture.
    pub size: [f64; 2],
    /// Where it lies from top to bottom and from left to right, as parts of the room it has.
    pub place: [f64; 2],
}

impl Patch {
    /// Draws one whose sides lie in a range.
    pub fn draw(size: [f64; 2], rng: &mut Rng) -> Self {
        let side = |rng: &mut Rng| size[0] + (size[1] - size[0]) * rng.random::<f64>();
        Self { size: [side(rng), side(rng)], place: [rng.random(), rng.random()] }
    }

    /// Height and width in pixels: at least 1.
    #[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    pub fn pixels(&self, frame: &FrameMut<'_>) -> [usize; 2] {
        let side = |part: f64, of: usize| ((part * of as f64) as usize).max(1);
        [side(self.size[0], frame.height), side(self.size[1], frame.width)]
    }

    /// Where it lies: all places at which it fits are equally likely.
    #[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    pub fn rect(&self, frame: &FrameMut<'_>) -> Rect {
        let [height, width] = self.pixels(frame);
        let offset = |part: f64, free: usize| ((part * (free + 1) as f64) as usize).min(free);
        Rect {
            x: offset(self.place[1], frame.width.saturating_sub(width)),
            y: offset(self.place[0], frame.height.saturating_sub(height)),
            width,
            height,
        }
    }
}
