//! The picture: a room with a frame of lines, zones and their drift where they are shown, and soft discs for target and
//! agent, drawn at the reference's 224 pixels.

use super::arrows;
use super::physics::{BORDER, GRID, SIZE, ZONES};
use crate::draw::{Area, Brush, Disc, Rgb, Stage, rect};
use swm_core::FrameMut;

/// Side of the picture as it is drawn.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
const SIDE: usize = SIZE as usize;
/// The lines that frame the room are this thick, ending where it begins.
const LINE: i32 = 4;

/// What keeps still during an episode.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// The colour of everything else.
    pub background: Rgb,
    /// The colour of the lines that frame the room.
    pub border: Rgb,
    /// The zones' colours, where they are shown.
    pub zones: Option<[Rgb; ZONES]>,
    /// The zones' drift, where it is shown.
    pub drift: Option<[[f64; 2]; ZONES]>,
    /// The target, where it is shown.
    pub target: Option<Disc>,
}

/// Draws frames, remembering the last scene.
pub struct Renderer {
    scene: Option<Scene>,
    stage: Stage,
    brush: Brush,
}

impl Default for Renderer {
    fn default() -> Self {
        Self { scene: None, stage: Stage::new(SIDE), brush: Brush::default() }
    }
}

impl Renderer {
    /// Draws a scene and the agent in it.
    pub fn draw(&mut self, scene: &Scene, agent: &Disc, mut frame: FrameMut<'_>) {
        if self.scene.as_ref() != Some(scene) {
            self.set(scene);
            self.scene = Some(scene.clone());
        }
        match self.stage.fill(&mut frame) {
            None => self.brush.blend(agent, SIDE, SIDE, frame.rgb),
            Some(tent) => self.brush.blend_resized(agent, tent, frame.rgb),
        }
    }

    #[allow(clippy::cast_possible_truncation, clippy::cast_possible_wrap)]
    fn set(&mut self, scene: &Scene) {
        let (side, low) = (SIDE as i32, BORDER as i32);
        let high = side - low;
        let room = (high - low) / GRID as i32;
        self.stage.set(|pixels| {
            pixels.fill(Area::square(SIDE), scene.background);
            for (i, &color) in scene.zones.iter().flatten().enumerate() {
                let [x, y] = [i % GRID, i / GRID].map(|cell| low + cell as i32 * room);
                pixels.fill(rect([x, y], [x + room, y + room]), color);
            }
            for start in [low - LINE, high] {
                pixels.fill(rect([start, 0], [start + LINE, side]), scene.border);
                pixels.fill(rect([0, start], [side, start + LINE]), scene.border);
            }
            if let Some(target) = &scene.target {
                self.brush.blend(target, SIDE, SIDE, pixels.bytes());
            }
            if let Some(drift) = &scene.drift {
                arrows::draw(drift, pixels);
            }
        });
    }
}
