//! Rendering: the lines around the room, the zones and arrows of their drift if shown, and soft discs for target and
//! agent, drawn at the reference's 224 pixels.

use super::arrows;
use super::physics::{GRID, ZONES};
use crate::draw::{Area, Background, Brush, Rgb, SoftDisc, rect};
use crate::point_agent::room::{BORDER, LINE, SIZE};
use swm_core::FrameMut;

/// Side of the square frame before it is resized, in pixels.
const SIDE: usize = SIZE as usize;

/// Colours and geometry of everything but the agent.
#[derive(Clone, Debug, PartialEq)]
pub struct ZonesAppearance {
    /// Colour of the floor and of the border.
    pub background: Rgb,
    /// Colour of the lines around the room.
    pub border: Rgb,
    /// Colours of the zones, if they are shown.
    pub zones: Option<[Rgb; ZONES]>,
    /// Drift of the zones in pixels per step, if it is shown.
    pub drift: Option<[[f64; 2]; ZONES]>,
    /// The target, if it is shown.
    pub target: Option<SoftDisc>,
}

/// Draws frames. It caches the background of the last appearance.
pub struct ZonesRenderer {
    appearance: Option<ZonesAppearance>,
    background: Background,
    brush: Brush,
}

impl Default for ZonesRenderer {
    fn default() -> Self {
        Self { appearance: None, background: Background::new(SIDE), brush: Brush::default() }
    }
}

impl ZonesRenderer {
    /// Draws a frame with the agent.
    pub fn draw(&mut self, appearance: &ZonesAppearance, agent: &SoftDisc, mut frame: FrameMut<'_>) {
        if self.appearance.as_ref() != Some(appearance) {
            self.draw_background(appearance);
            self.appearance = Some(appearance.clone());
        }
        match self.background.copy_to(&mut frame) {
            None => self.brush.blend(agent, SIDE, SIDE, frame.rgb),
            Some(resizer) => self.brush.blend_resized(agent, resizer, frame.rgb),
        }
    }

    fn draw_background(&mut self, appearance: &ZonesAppearance) {
        let (side, line, low) = (SIDE as i32, LINE as i32, BORDER as i32);
        let high = side - low;
        let zone = (high - low) / GRID as i32;
        self.background.redraw(|pixels| {
            pixels.fill(Area::square(SIDE), appearance.background);
            for (i, &color) in appearance.zones.iter().flatten().enumerate() {
                let [x, y] = [i % GRID, i / GRID].map(|cell| low + cell as i32 * zone);
                pixels.fill(rect([x, y], [x + zone, y + zone]), color);
            }
            for start in [low - line, high] {
                pixels.fill(rect([start, 0], [start + line, side]), appearance.border);
                pixels.fill(rect([0, start], [side, start + line]), appearance.border);
            }
            if let Some(target) = &appearance.target {
                self.brush.blend(target, SIDE, SIDE, pixels.bytes());
            }
            if let Some(drift) = &appearance.drift {
                arrows::draw(drift, pixels);
            }
        });
    }
}
