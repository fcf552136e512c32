//! Rendering: walls, a half transparent goal and the agent within a thin border line, drawn at the reference's 500
//! pixels.

use super::factors;
use super::physics::{Layout, SIZE};
use crate::draw::{Area, Background, Pixels, Rgb, rect};
use crate::point_agent::Position;
use swm_core::{FactorValues, FrameMut};

/// Side of the square frame before it is resized, in pixels.
const SIDE: usize = 500;
/// Pixels per maze unit.
const SCALE: f64 = SIDE as f64 / SIZE as f64;
/// Opacity of the goal.
const GOAL_OPACITY: f64 = 0.5;
/// Coverage of the pixels that the border line covers in part. The border line is black, 1.11 pixels (0.8 points) wide,
/// and lies along the edge of the frame. At the left and at the top it covers the first pixel and this share of the
/// second pixel; at the right and at the bottom it covers this share of the last pixel.
const BORDER_COVERAGE: f64 = 0.0556;

/// A disc in the maze.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Disc {
    /// The centre, in maze units.
    pub center: Position,
    /// The radius, in maze units.
    pub radius: f32,
    /// The colour.
    pub color: Rgb,
}

impl Disc {
    /// Returns centre and radius in pixels of the frame, y down.
    fn in_pixels(&self) -> ([f64; 2], f64) {
        let [x, y] = self.center.map(|v| f64::from(v) * SCALE);
        ([x, SIDE as f64 - y], f64::from(self.radius) * SCALE)
    }
}

/// Geometry and colours of everything but the agent.
#[derive(Clone, Debug, PartialEq)]
pub struct MazeAppearance {
    /// Colour of the floor.
    pub background: Rgb,
    /// Colour of the walls.
    pub wall: Rgb,
    /// The walls.
    pub layout: Layout,
    /// The goal.
    pub goal: Disc,
}

impl MazeAppearance {
    /// Makes the appearance that the factors describe.
    pub fn new(factors: &FactorValues, layout: Layout) -> Self {
        Self {
            background: factors.rgb("background.color"),
            wall: factors.rgb("walls.color"),
            layout,
            goal: factors::disc(factors, "goal"),
        }
    }
}

/// Draws frames. It caches the background of the last appearance.
pub struct MazeRenderer {
    appearance: Option<MazeAppearance>,
    background: Background,
}

impl Default for MazeRenderer {
    fn default() -> Self {
        Self { appearance: None, background: Background::new(SIDE) }
    }
}

impl MazeRenderer {
    /// Draws a frame with the agent.
    pub fn draw(&mut self, appearance: &MazeAppearance, agent: &Disc, frame: FrameMut<'_>) {
        if self.appearance.as_ref() != Some(appearance) {
            self.background.redraw(|pixels| draw_background(appearance, pixels));
            self.appearance = Some(appearance.clone());
        }
        self.background.draw_over(frame, |pixels| draw_agent(agent, pixels));
    }
}

fn draw_background(appearance: &MazeAppearance, pixels: &mut Pixels<'_>) {
    let whole = Area::square(SIDE);
    pixels.fill(whole, appearance.background);
    for wall in appearance.layout.walls() {
        // Rounded to whole pixels, as matplotlib snaps rectangles.
        let [left, bottom] = wall.low.map(|v| f64::from(v) * SCALE);
        let [right, top] = wall.high.map(|v| f64::from(v) * SCALE);
        let low = nearest_pixel(left, SIDE as f64 - top);
        let high = nearest_pixel(right, SIDE as f64 - bottom);
        pixels.fill(rect(low, high), appearance.wall);
    }
    let (center, radius) = appearance.goal.in_pixels();
    pixels.circle(center, radius, appearance.goal.color, GOAL_OPACITY, whole);
    for (start, end) in PARTLY_COVERED {
        pixels.tint(rect([start, 0], [end, END]), [0; 3], BORDER_COVERAGE);
        pixels.tint(rect([0, start], [END, end]), [0; 3], BORDER_COVERAGE);
    }
    pixels.fill(rect([0, 0], [1, END]), [0; 3]);
    pixels.fill(rect([0, 0], [END, 1]), [0; 3]);
}

const END: i32 = SIDE as i32;
/// The ranges of columns, and of rows, that the border line covers in part.
const PARTLY_COVERED: [(i32, i32); 2] = [(1, 2), (END - 1, END)];

/// Draws the agent as if the border line were drawn over it: darkened where the line covers a share of the pixels.
/// Returns the area that may have changed.
fn draw_agent(agent: &Disc, pixels: &mut Pixels<'_>) -> Area {
    let (center, radius) = agent.in_pixels();
    let bounds = Pixels::circle_bounds(center, radius);
    let [first, last] = PARTLY_COVERED;
    // Bands of columns or rows, each with 1 if the line covers the band in part, otherwise 0.
    let bands = [(first, 1), ((first.1, last.0), 0), (last, 1)];
    for ((left, right), covered_x) in bands {
        for ((top, bottom), covered_y) in bands {
            let clip = rect([left, top], [right, bottom]);
            if clip.touches(bounds) {
                let brightness = (1.0 - BORDER_COVERAGE).powi(covered_x + covered_y);
                let color = agent.color.map(|v| (f64::from(v) * brightness + 0.5) as u8);
                pixels.circle(center, radius, color, 1.0, clip);
            }
        }
    }
    bounds
}

fn nearest_pixel(x: f64, y: f64) -> [i32; 2] {
    [x, y].map(|v| (v + 0.5).floor() as i32)
}
