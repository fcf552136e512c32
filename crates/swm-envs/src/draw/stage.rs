//! Something that moves before something that keeps still.
//!
//! What keeps still is drawn once an episode, and resized once for each size asked for. A frame copies it, draws what
//! moves at the world's own size, and resizes only what that touched.

use super::{Area, Pixels, Tent};
use swm_core::FrameMut;

/// A backdrop at its own size and others, and the room to draw before it.
pub struct Stage {
    side: usize,
    backdrop: Vec<u8>,
    /// The backdrop but for what is drawn while a frame is made; made for the first such frame.
    canvas: Option<Vec<u8>>,
    /// The backdrop at sizes asked for before, the last one first.
    views: Vec<View>,
}

/// The backdrop at one size.
struct View {
    tent: Tent,
    rgb: Vec<u8>,
    /// Whether `rgb` shows the backdrop of this episode.
    current: bool,
}

/// At how many sizes the backdrop is kept.
const MAX_VIEWS: usize = 4;

impl Stage {
    /// A backdrop of `side`² pixels, to be [`Stage::set`].
    pub fn new(side: usize) -> Self {
        Self { side, backdrop: vec![], canvas: None, views: vec![] }
    }

    /// Draws another backdrop.
    pub fn set(&mut self, draw: impl FnOnce(&mut Pixels<'_>)) {
        self.backdrop.resize(self.side * self.side * 3, 0);
        draw(&mut Pixels::new(self.side, &mut self.backdrop));
        if let Some(canvas) = &mut self.canvas {
            canvas.copy_from_slice(&self.backdrop);
        }
        self.views.iter_mut().for_each(|view| view.current = false);
    }

    /// Fills a frame with the backdrop, and says how that was resized, if it was.
    pub fn fill(&mut self, frame: &mut FrameMut<'_>) -> Option<&Tent> {
        if (frame.width, frame.height) == (self.side, self.side) {
            frame.rgb.copy_from_slice(&self.backdrop);
            return None;
        }
        let view = self.view(frame.width, frame.height);
        frame.rgb.copy_from_slice(&view.rgb);
        Some(&view.tent)
    }

    /// Fills a frame: the backdrop and what `draw` draws before it, which says what it touched at most.
    pub fn show(&mut self, mut frame: FrameMut<'_>, draw: impl FnOnce(&mut Pixels<'_>) -> Area) {
        let side = self.side;
        if self.fill(&mut frame).is_none() {
            draw(&mut Pixels::new(side, frame.rgb));
            return;
        }
        let mut canvas = self.canvas.take().unwrap_or_else(|| self.backdrop.clone());
        let area = draw(&mut Pixels::new(side, &mut canvas));
        self.view(frame.width, frame.height).tent.draw(&canvas, area, frame.rgb);
        let (columns, rows) = area.within(side);
        for y in rows {
            let row = 3 * (y * side + columns.start)..3 * (y * side + columns.end.max(columns.start));
            canvas[row.clone()].copy_from_slice(&self.backdrop[row]);
        }
        self.canvas = Some(canvas);
    }

    /// The backdrop at this size.
    fn view(&mut self, width: usize, height: usize) -> &mut View {
        let place = self.views.iter().position(|view| view.tent.size() == (width, height)).unwrap_or_else(|| {
            let (tent, rgb) = (Tent::new(self.side, width, height), vec![0; width * height * 3]);
            self.views.truncate(MAX_VIEWS - 1);
            self.views.insert(0, View { tent, rgb, current: false });
            0
        });
        let view = &mut self.views[place];
        if !view.current {
            view.tent.draw(&self.backdrop, Area::square(self.side), &mut view.rgb);
            view.current = true;
        }
        view
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::draw::Point;

    #[test]
    fn frames_are_the_resized_whole_and_leave_no_trace() {
        let mut stage = Stage::new(30);
        let dot = |x: i32| Area::EMPTY.with(Point::new(x, 12), 3);
        let scene = |pixels: &mut Pixels<'_>| pixels.fill(dot(4), [0, 90, 250]);
        stage.set(scene);
        let mut whole = vec![0; 30 * 30 * 3];
        for (width, height) in [(30, 30), (7, 11), (40, 16), (30, 9), (12, 12), (8, 8), (7, 11)] {
            for x in [0, 5, 28] {
                let mut frame = vec![9; width * height * 3];
                stage.show(FrameMut::new(width, height, &mut frame), |pixels| {
                    pixels.fill(dot(x), [255, 10, 30]);
                    dot(x)
                });
                whole.fill(0);
                scene(&mut Pixels::new(30, &mut whole));
                Pixels::new(30, &mut whole).fill(dot(x), [255, 10, 30]);
                let mut wanted = vec![0; width * height * 3];
                Tent::new(30, width, height).draw(&whole, Area::square(30), &mut wanted);
                assert!(frame == wanted, "{width} x {height}, {x}");
            }
        }
    }
}
