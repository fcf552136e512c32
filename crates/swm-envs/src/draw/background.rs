//! [`Background`]: the static part of a frame, drawn once per episode and resized once per frame size.
//!
//! A frame copies the resized background, draws the moving shapes at the original size, and resizes only the pixels
//! that these shapes touch.

use super::{Area, BySize, Pixels};
use swm_core::FrameMut;
use swm_image::resize::TriangleResizer;

/// A square background image with resized copies, and a canvas to draw moving shapes over it.
pub struct Background {
    side: usize,
    /// The background, `[side, side, 3]`.
    image: Vec<u8>,
    /// A copy of `image` into which a frame's moving shapes are drawn; made for the first resized frame.
    canvas: Option<Vec<u8>>,
    resized: BySize<Resized>,
}

/// The background at one frame size.
struct Resized {
    resizer: TriangleResizer,
    /// The resized background, `[height, width, 3]`.
    rgb: Vec<u8>,
}

impl Background {
    /// Makes a background of `side`² pixels. [`Background::redraw`] must be called before the first frame.
    pub fn new(side: usize) -> Self {
        Self { side, image: vec![], canvas: None, resized: BySize::default() }
    }

    /// Draws a new background with `draw`.
    pub fn redraw(&mut self, draw: impl FnOnce(&mut Pixels<'_>)) {
        self.image.resize(self.side * self.side * 3, 0);
        draw(&mut Pixels::new(self.side, &mut self.image));
        if let Some(canvas) = &mut self.canvas {
            canvas.copy_from_slice(&self.image);
        }
        self.resized.invalidate();
    }

    /// Fills a frame with the background. Returns the filter that resized the background, or `None` at the original
    /// size.
    pub fn copy_to(&mut self, frame: &mut FrameMut<'_>) -> Option<&TriangleResizer> {
        if (frame.width, frame.height) == (self.side, self.side) {
            frame.rgb.copy_from_slice(&self.image);
            return None;
        }
        let resized = self.resized(frame.width, frame.height);
        frame.rgb.copy_from_slice(&resized.rgb);
        Some(&resized.resizer)
    }

    /// Renders a frame: the background, and the shapes that `draw` draws over it. `draw` returns the area that may
    /// have changed.
    pub fn draw_over(&mut self, mut frame: FrameMut<'_>, draw: impl FnOnce(&mut Pixels<'_>) -> Area) {
        let side = self.side;
        if self.copy_to(&mut frame).is_none() {
            draw(&mut Pixels::new(side, frame.rgb));
            return;
        }
        let mut canvas = self.canvas.take().unwrap_or_else(|| self.image.clone());
        let area = draw(&mut Pixels::new(side, &mut canvas));
        let (columns, rows) = area.within(side);
        let resizer = &mut self.resized(frame.width, frame.height).resizer;
        resizer.resize_part(&canvas, columns.clone(), rows.clone(), frame.rgb);
        for y in rows {
            let row = 3 * (y * side + columns.start)..3 * (y * side + columns.end.max(columns.start));
            canvas[row.clone()].copy_from_slice(&self.image[row]);
        }
        self.canvas = Some(canvas);
    }

    /// Returns the background at a frame size.
    fn resized(&mut self, width: usize, height: usize) -> &mut Resized {
        let (side, image) = (self.side, &self.image);
        let create =
            || Resized { resizer: TriangleResizer::new(side, width, height), rgb: vec![0; width * height * 3] };
        let update = |resized: &mut Resized| resized.resizer.resize_part(image, 0..side, 0..side, &mut resized.rgb);
        let slot = self.resized.slot(width, height, create, update);
        &mut self.resized[slot]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::draw::Point;

    #[test]
    fn frames_equal_the_resized_full_image_and_leave_the_background_unchanged() {
        let mut background = Background::new(30);
        let dot = |x: i32| Area::EMPTY.with(Point::new(x, 12), 3);
        let draw = |pixels: &mut Pixels<'_>| pixels.fill(dot(4), [0, 90, 250]);
        background.redraw(draw);
        let mut full = vec![0; 30 * 30 * 3];
        for (width, height) in [(30, 30), (7, 11), (40, 16), (30, 9), (12, 12), (8, 8), (7, 11)] {
            for x in [0, 5, 28] {
                let mut frame = vec![9; width * height * 3];
                background.draw_over(FrameMut::new(width, height, &mut frame), |pixels| {
                    pixels.fill(dot(x), [255, 10, 30]);
                    dot(x)
                });
                full.fill(0);
                draw(&mut Pixels::new(30, &mut full));
                Pixels::new(30, &mut full).fill(dot(x), [255, 10, 30]);
                let mut expected = vec![0; width * height * 3];
                TriangleResizer::new(30, width, height).resize_part(&full, 0..30, 0..30, &mut expected);
                assert!(frame == expected, "{width} x {height}, dot at {x}");
            }
        }
    }
}
