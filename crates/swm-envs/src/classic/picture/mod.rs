//! Pictures as the reference makes them: drawn on a surface of fixed size with SDL_gfx's shapes, some colours swapped
//! afterwards, then resized with Pillow.

mod resize;
mod surface;

use resize::Resize;
pub use resize::Swaps;
pub use surface::{Color, Surface, pixel};
use swm_core::FrameMut;

/// What surfaces are cleared to.
const WHITE: Color = Color::new([255; 3]);
/// At how many sizes a background is kept.
const MAX_SIZES: usize = 4;

/// A background that stays for an episode, and before it what moves, at any size.
pub struct Picture {
    background: Surface,
    /// The background but for what is drawn while a frame is made.
    surface: Surface,
    swaps: Vec<(Color, Color)>,
    /// Sizes asked for before, the last new one first, and whether they know this episode's background.
    sizes: Vec<(Resize, bool)>,
}

impl Picture {
    /// A picture drawn at this width and height.
    pub fn new((width, height): (usize, usize)) -> Self {
        let blank = Surface::new(width, height, WHITE);
        Self { background: blank.clone(), surface: blank, swaps: vec![], sizes: vec![] }
    }

    /// Turns to an episode with another background and other colours.
    pub fn begin(&mut self, draw: impl FnOnce(&mut Surface), swaps: Swaps<'_>) {
        self.background.clear(WHITE);
        draw(&mut self.background);
        self.background.set_drawn(true);
        self.surface.copy(&self.background);
        self.swaps.clear();
        self.swaps.extend_from_slice(swaps);
        self.sizes.iter_mut().for_each(|(_, current)| *current = false);
    }

    /// Fills a frame: the background and what `draw` draws before it.
    pub fn show(&mut self, draw: impl FnOnce(&mut Surface), frame: FrameMut<'_>) {
        draw(&mut self.surface);
        let place = self.size(frame.width, frame.height);
        self.sizes[place].0.draw(&self.surface, &self.swaps, frame.rgb);
        self.surface.restore(&self.background);
    }

    /// The place of a size.
    fn size(&mut self, width: usize, height: usize) -> usize {
        let place = self.sizes.iter().position(|(resize, _)| resize.size() == (width, height)).unwrap_or_else(|| {
            self.sizes.truncate(MAX_SIZES - 1);
            self.sizes.insert(0, (Resize::new(self.background.size(), width, height), false));
            0
        });
        let (resize, current) = &mut self.sizes[place];
        if !*current {
            resize.set_background(&self.background, &self.swaps);
            *current = true;
        }
        place
    }
}
