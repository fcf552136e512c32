//! [`FrameRenderer`]: renders frames by the same steps as the reference: shapes of SDL_gfx on a surface of fixed size,
//! replacement of some colours, and Pillow's bilinear resize.

mod resize;
mod shapes;
mod surface;

use crate::draw::BySize;
use resize::Resize;
pub use resize::Swaps;
pub use surface::{Color, Surface, pixel};
use swm_core::FrameMut;

/// The colour that surfaces are cleared to.
const WHITE: Color = Color::new([255; 3]);

/// Draws the frames of an episode: a static background and moving parts over it, at any frame size.
pub struct FrameRenderer {
    background: Surface,
    /// A copy of the background into which a frame's moving parts are drawn.
    surface: Surface,
    swaps: Vec<(Color, Color)>,
    resized: BySize<Resize>,
}

impl FrameRenderer {
    /// Makes a renderer that draws at this width and height, in pixels.
    pub fn new((width, height): (usize, usize)) -> Self {
        let blank = Surface::new(width, height, WHITE);
        Self { background: blank.clone(), surface: blank, swaps: vec![], resized: BySize::default() }
    }

    /// Starts an episode: draws its background with `draw`, and sets its colour replacements.
    pub fn begin_episode(&mut self, draw: impl FnOnce(&mut Surface), swaps: Swaps<'_>) {
        self.background.clear(WHITE);
        draw(&mut self.background);
        self.background.set_drawn(true);
        self.surface.copy(&self.background);
        self.swaps.clear();
        self.swaps.extend_from_slice(swaps);
        self.resized.invalidate();
    }

    /// Renders a frame: the background, and the moving parts that `draw` draws over it.
    pub fn draw(&mut self, draw: impl FnOnce(&mut Surface), frame: FrameMut<'_>) {
        draw(&mut self.surface);
        let (width, height) = (frame.width, frame.height);
        let create = || Resize::new(self.background.size(), width, height);
        let update = |resize: &mut Resize| resize.set_background(&self.background, &self.swaps);
        let slot = self.resized.slot(width, height, create, update);
        self.resized[slot].draw(&self.surface, &self.swaps, frame.rgb);
        self.surface.restore(&self.background);
    }
}
