//! Rectangles of one colour at random positions, which the wrappers `cutout`, `occlusion` and `moving-patch` draw.

use rand::Rng as _;
use swm_core::{FrameMut, Rng};

/// A rectangle of a frame, in pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rect {
    pub x: usize,
    pub y: usize,
    pub width: usize,
    pub height: usize,
}

impl Rect {
    /// Fills the part of the rectangle that lies in the frame.
    pub fn fill(self, color: [u8; 3], frame: &mut FrameMut<'_>) {
        let (left, right) = (self.x.min(frame.width), (self.x + self.width).min(frame.width));
        let pixels = frame.rgb.as_chunks_mut::<3>().0;
        for y in self.y..(self.y + self.height).min(frame.height) {
            pixels[y * frame.width..][left..right].fill(color);
        }
    }
}

/// A random rectangle for frames of any size; all values are shares, 0 ..= 1.
#[derive(Clone, Copy, Debug)]
pub struct Patch {
    /// Height and width, as shares of the frame.
    pub size: [f64; 2],
    /// Position from top to bottom and from left to right, as shares of the free space.
    pub position: [f64; 2],
}

impl Patch {
    /// Samples a rectangle whose sides lie in a range.
    pub fn draw(size: [f64; 2], rng: &mut Rng) -> Self {
        let side = |rng: &mut Rng| size[0] + (size[1] - size[0]) * rng.random::<f64>();
        Self { size: [side(rng), side(rng)], position: [rng.random(), rng.random()] }
    }

    /// Returns height and width in pixels, at least 1.
    pub fn pixels(&self, frame: &FrameMut<'_>) -> [usize; 2] {
        let side = |share: f64, length: usize| ((share * length as f64) as usize).max(1);
        [side(self.size[0], frame.height), side(self.size[1], frame.width)]
    }

    /// Returns the rectangle in a frame; all positions at which it fits are equally likely.
    pub fn rect(&self, frame: &FrameMut<'_>) -> Rect {
        let [height, width] = self.pixels(frame);
        let offset = |share: f64, free: usize| ((share * (free + 1) as f64) as usize).min(free);
        Rect {
            x: offset(self.position[1], frame.width.saturating_sub(width)),
            y: offset(self.position[0], frame.height.saturating_sub(height)),
            width,
            height,
        }
    }
}
