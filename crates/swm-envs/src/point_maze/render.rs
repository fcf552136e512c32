//! The picture: walls, a half transparent goal and the agent in a thin frame, drawn at the reference's 500 pixels.

use super::physics::{Layout, Point, SIZE};
use crate::draw::{Area, Pixels, Rgb, Stage, rect};
use swm_core::FrameMut;

/// Side of the picture as it is drawn.
const SIDE: usize = 500;
/// Pixels in a unit of the world.
const SCALE: f64 = SIDE as f64 / SIZE as f64;
/// How much of the goal hides what is below it.
const GOAL_OPACITY: f64 = 0.5;
/// The frame is a black line of 1.11 pixels (0.8 points) along the picture's edge: left and above it covers the first
/// pixel and this share of the second, right and below the same share of the last.
const FRAME_SHARE: f64 = 0.0556;

/// A disc in the world.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Disc {
    /// Its middle.
    pub center: Point,
    /// Its radius.
    pub radius: f32,
    /// Its colour.
    pub color: Rgb,
}

impl Disc {
    fn pixel(&self) -> ([f64; 2], f64) {
        let [x, y] = self.center.map(|v| f64::from(v) * SCALE);
        ([x, SIDE as f64 - y], f64::from(self.radius) * SCALE)
    }
}

/// What keeps still during an episode.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// The floor's colour.
    pub background: Rgb,
    /// The walls' colour.
    pub wall: Rgb,
    /// The walls.
    pub layout: Layout,
    /// The goal.
    pub goal: Disc,
}

/// Draws frames, remembering the last scene.
pub struct Renderer {
    scene: Option<Scene>,
    stage: Stage,
}

impl Default for Renderer {
    fn default() -> Self {
        Self { scene: None, stage: Stage::new(SIDE) }
    }
}

impl Renderer {
    /// Draws a scene and the agent in it.
    pub fn draw(&mut self, scene: &Scene, agent: &Disc, frame: FrameMut<'_>) {
        if self.scene.as_ref() != Some(scene) {
            self.stage.set(|pixels| backdrop(scene, pixels));
            self.scene = Some(scene.clone());
        }
        self.stage.show(frame, |pixels| below_the_frame(agent, pixels));
    }
}

fn backdrop(scene: &Scene, pixels: &mut Pixels<'_>) {
    let whole = Area::square(SIDE);
    pixels.fill(whole, scene.background);
    for wall in scene.layout.walls() {
        // To whole pixels, as matplotlib snaps rectangles.
        let [left, bottom] = wall.low.map(|v| f64::from(v) * SCALE);
        let [right, top] = wall.high.map(|v| f64::from(v) * SCALE);
        let low = nearest(left, SIDE as f64 - top);
        let high = nearest(right, SIDE as f64 - bottom);
        pixels.fill(rect(low, high), scene.wall);
    }
    let (center, radius) = scene.goal.pixel();
    pixels.circle(center, radius, scene.goal.color, GOAL_OPACITY, whole);
    for (start, end) in [SHADED[0], SHADED[1]] {
        pixels.tint(rect([start, 0], [end, END]), [0; 3], FRAME_SHARE);
        pixels.tint(rect([0, start], [END, end]), [0; 3], FRAME_SHARE);
    }
    pixels.fill(rect([0, 0], [1, END]), [0; 3]);
    pixels.fill(rect([0, 0], [END, 1]), [0; 3]);
}

const END: i32 = SIDE as i32;
/// Where, along x and along y, the frame covers a share of the pixels.
const SHADED: [(i32, i32); 2] = [(1, 2), (END - 1, END)];

/// Draws the agent as if the frame were drawn over it: in darker colours where the frame covers a share.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
fn below_the_frame(agent: &Disc, pixels: &mut Pixels<'_>) -> Area {
    let (center, radius) = agent.pixel();
    let around = Pixels::around(center, radius);
    let bands = [(SHADED[0], 1), ((SHADED[0].1, SHADED[1].0), 0), (SHADED[1], 1)];
    for ((left, right), shaded_x) in bands {
        for ((top, bottom), shaded_y) in bands {
            let clip = rect([left, top], [right, bottom]);
            if clip.touches(around) {
                let light = (1.0 - FRAME_SHARE).powi(shaded_x + shaded_y);
                let color = agent.color.map(|v| (f64::from(v) * light + 0.5) as u8);
                pixels.circle(center, radius, color, 1.0, clip);
            }
        }
    }
    around
}

#[allow(clippy::cast_possible_truncation)]
fn nearest(x: f64, y: f64) -> [i32; 2] {
    [x, y].map(|v| (v + 0.5).floor() as i32)
}
