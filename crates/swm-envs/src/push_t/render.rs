//! Rendering: the goal pose, the block and the agent with outlines, the walls, and red marks at contacts. Frames are
//! drawn at 512 x 512 pixels as in the reference, then resized.
//!
//! The table with goal pose and walls is static during an episode: it is drawn once, and resampled once per frame size.
//! A frame copies the resampled table, draws agent and block on the canvas, resamples their area, and restores the
//! canvas. An untouched block does not move, so it stays on the canvas from frame to frame and only the agent is drawn.

use super::factors::body_shape;
use super::physics::{AGENT, BLOCK, Pose, Simulation, Vec2, visiting_order};
use super::shapes::BodyShape;
use super::table::{TABLE, WALL_LINES};
use crate::draw::{Area, BySize, Canvas, Palette, Point, Resampler, WIDTH};
use swm_core::{FactorValues, FrameMut};

/// Side of the canvas, in pixels.
const SIDE: usize = TABLE as usize;
/// Width of the outline of a circle, in pixels.
const RIM: f64 = 4.0;
/// Factor by which the inside of a shape is lighter than its outline.
const LIGHTER: f32 = 1.2;
/// Colour of the walls (X11's light gray).
const WALL_COLOR: [u8; 3] = [211, 211, 211];
/// Colour of contact marks (pymunk's debug drawing).
const MARK_COLOR: [u8; 3] = [231, 76, 60];
/// Length of a contact mark on each side of the contact, in pixels.
const MARK_LENGTH: f64 = 2.0;
/// The maximal number of contact marks in a frame.
const MAX_MARKS: usize = 32;

// Indices of the palette.
const BACKGROUND: u8 = 0;
const GOAL: u8 = 1;
const WALL: u8 = 2;
/// Indices of the outlines of agent and block; the inside of each has the next index.
const BODIES: [u8; 2] = [3, 5];

/// The part of the simulation state that frames depend on.
#[derive(Clone)]
pub struct DrawnState {
    poses: [Pose; 2],
    /// The contact marks; the first `contacts` are valid.
    marks: [ContactMark; MAX_MARKS],
    contacts: usize,
}

/// A short line across a contact.
#[derive(Clone, Copy, Default)]
struct ContactMark {
    /// Both ends of the line, in pixels of the table.
    ends: [Vec2; 2],
    /// The body whose area contains the mark.
    body: usize,
}

impl DrawnState {
    /// Reads the state of a simulation.
    pub fn of(simulation: &Simulation) -> Self {
        let poses = [simulation.bodies[AGENT].pose, simulation.bodies[BLOCK].pose];
        let mut drawn = Self { poses, marks: [ContactMark::default(); MAX_MARKS], contacts: 0 };
        for arbiter in simulation.touching() {
            let [a, b] = arbiter.bodies();
            let centres = [a, b].map(|body| simulation.bodies[body].centre);
            for contact in arbiter.contacts() {
                let Some(mark) = drawn.marks.get_mut(drawn.contacts) else { return drawn };
                let ends = [(0, -MARK_LENGTH), (1, MARK_LENGTH)]
                    .map(|(i, by)| centres[i] + contact.arms[i] + arbiter.normal * by);
                *mark = ContactMark { ends, body: a.min(b) };
                drawn.contacts += 1;
            }
        }
        drawn
    }
}

/// Draws the frames of an episode.
pub struct TableRenderer {
    shapes: [BodyShape; 2],
    /// The order in which the parts of bodies are drawn, as (body, index of the rectangle).
    order: Vec<(usize, usize)>,
    palette: Palette,
    /// Background, goal pose and walls.
    table: Canvas,
    /// The table, with the block while it does not move.
    canvas: Canvas,
    /// The block that the canvas contains, if any.
    drawn_block: Option<DrawnBlock>,
    /// The table at the frame sizes in use.
    resampled: BySize<ResampledTable>,
}

/// A block that is drawn on the canvas.
#[derive(Clone, Copy)]
struct DrawnBlock {
    pose: Pose,
    area: Area,
}

/// The table at one frame size.
struct ResampledTable {
    resampler: Resampler,
    /// The table without the block, `[height, width, 3]`.
    table: Vec<u8>,
    /// The table with the block, `[height, width, 3]`; valid if `has_block` is set.
    with_block: Vec<u8>,
    has_block: bool,
}

impl TableRenderer {
    /// Makes a renderer for an episode with these factors.
    pub fn new(factors: &FactorValues) -> Self {
        let mut renderer = Self {
            shapes: ["agent", "block"].map(|name| body_shape(factors, name)),
            order: vec![],
            palette: Palette::new(&[]),
            table: Canvas::new(SIDE),
            canvas: Canvas::new(SIDE),
            drawn_block: None,
            resampled: BySize::default(),
        };
        renderer.begin_episode(factors);
        renderer
    }

    /// Starts an episode with these factors.
    pub fn begin_episode(&mut self, factors: &FactorValues) {
        self.shapes = ["agent", "block"].map(|name| body_shape(factors, name));
        let parts = [AGENT, BLOCK].map(|body| self.shapes[body].rects.len().max(1));
        self.order = visiting_order(WALL_LINES.len(), parts[0] + parts[1])
            .into_iter()
            .map(|i| if i < parts[0] { (AGENT, i) } else { (BLOCK, i - parts[0]) })
            .collect();
        let [agent, block] = ["agent.color", "block.color"].map(|key| factors.rgb(key));
        self.palette = Palette::new(&[
            factors.rgb("background.color"),
            factors.rgb("goal.color"),
            WALL_COLOR,
            agent,
            lighter(agent),
            block,
            lighter(block),
        ]);
        self.table.clear(BACKGROUND);
        if factors.integer("rendering.render_goal") != 0 {
            let at = factors.get("goal.position");
            let pose = Pose::new(Vec2::new(at[0], at[1]), factors.scalar("goal.angle"), Vec2::ZERO);
            // The goal has the size of the block: the reference samples `goal.scale` and ignores it.
            for rect in &self.shapes[BLOCK].rects {
                self.table.fill_polygon(&rect.map(|corner| pixel(pose.point(corner))), GOAL);
            }
        }
        walls().iter().for_each(|&[from, to]| self.table.thick_line(from, to, WALL));
        self.canvas.copy_area(&self.table, Area::square(SIDE));
        self.drawn_block = None;
        self.resampled.invalidate();
    }

    /// Draws a frame.
    pub fn draw(&mut self, drawn: &DrawnState, frame: FrameMut<'_>) {
        let slot = self.slot(frame.width, frame.height);
        let areas = [AGENT, BLOCK].map(|body| self.area(body, &drawn.poses[body]));
        if drawn.contacts == 0 && !areas[AGENT].touches(areas[BLOCK]) {
            self.draw_block(&drawn.poses[BLOCK], areas[BLOCK]);
            self.draw_agent(drawn, areas[AGENT], slot, frame);
        } else {
            self.draw_both(drawn, areas, slot, frame);
        }
    }

    /// Draws a frame in which the agent does not touch the block. The canvas already contains the block.
    fn draw_agent(&mut self, drawn: &DrawnState, area: Area, slot: usize, frame: FrameMut<'_>) {
        let ResampledTable { resampler, table, with_block, has_block } = &mut self.resampled[slot];
        if !*has_block {
            with_block.copy_from_slice(table);
            let block = self.drawn_block.map_or(Area::EMPTY, |block| block.area);
            resampler.draw(&self.canvas, &self.palette, block, with_block);
            *has_block = true;
        }
        // Only the area of the agent is restored afterwards; the block lies outside this area.
        self.draw_body(AGENT, &drawn.poses[AGENT]);
        self.canvas.draw_walls(&[area]);
        let ResampledTable { resampler, with_block, .. } = &self.resampled[slot];
        frame.rgb.copy_from_slice(with_block);
        resampler.draw(&self.canvas, &self.palette, area, frame.rgb);
        self.canvas.copy_area(&self.table, area);
    }

    /// Draws a frame with both bodies, part by part in the reference's order, and marks at their contacts.
    fn draw_both(&mut self, drawn: &DrawnState, mut areas: [Area; 2], slot: usize, frame: FrameMut<'_>) {
        self.erase_block();
        for &(body, part) in &self.order {
            self.canvas.draw_part(&self.shapes[body], body, part, &drawn.poses[body]);
        }
        self.canvas.draw_walls(&areas);
        for mark in &drawn.marks[..drawn.contacts] {
            let [from, to] = mark.ends.map(pixel);
            self.canvas.fine_line(from, to, MARK_COLOR, &mut self.palette);
            areas[mark.body] = areas[mark.body].with(from, 1).with(to, 1);
        }
        let ResampledTable { resampler, table, .. } = &self.resampled[slot];
        frame.rgb.copy_from_slice(table);
        for area in areas {
            resampler.draw(&self.canvas, &self.palette, area, frame.rgb);
        }
        for area in areas {
            self.canvas.copy_area(&self.table, area);
        }
        self.palette.drop_blended();
    }

    /// Draws all parts of a body on the canvas.
    fn draw_body(&mut self, body: usize, pose: &Pose) {
        for &(_, part) in self.order.iter().filter(|(owner, _)| *owner == body) {
            self.canvas.draw_part(&self.shapes[body], body, part, pose);
        }
    }

    /// Draws the block on the canvas, unless the canvas already contains it in this pose.
    fn draw_block(&mut self, pose: &Pose, area: Area) {
        if self.drawn_block.is_some_and(|block| block.pose == *pose) {
            return;
        }
        self.erase_block();
        self.draw_body(BLOCK, pose);
        self.canvas.draw_walls(&[area]);
        self.drawn_block = Some(DrawnBlock { pose: *pose, area });
    }

    /// Removes the block from the canvas.
    fn erase_block(&mut self) {
        if let Some(block) = self.drawn_block.take() {
            self.canvas.copy_area(&self.table, block.area);
            self.resampled.values_mut().for_each(|resampled| resampled.has_block = false);
        }
    }

    /// Returns an area that contains the pixels of a body.
    fn area(&self, body: usize, pose: &Pose) -> Area {
        let shape = &self.shapes[body];
        if shape.is_circle() {
            return Area::EMPTY.with(pixel(pose.origin), rounded(shape.radius));
        }
        let corners = shape.rects.iter().flatten().map(|&corner| pixel(pose.point(corner)));
        corners.fold(Area::EMPTY, |area, corner| area.with(corner, WIDTH / 2 + 1))
    }

    /// Returns the cache slot of the table at a frame size.
    fn slot(&mut self, width: usize, height: usize) -> usize {
        let create = || {
            let blank = || vec![0; width * height * 3];
            let resampler = Resampler::new(SIDE, width, height);
            ResampledTable { resampler, table: blank(), with_block: blank(), has_block: false }
        };
        self.resampled.slot(width, height, create, |resampled| {
            resampled.resampler.draw(&self.table, &self.palette, Area::square(SIDE), &mut resampled.table);
            resampled.has_block = false;
        })
    }
}

impl Canvas {
    /// Draws a rectangle of a body, or its circle.
    fn draw_part(&mut self, shape: &BodyShape, body: usize, part: usize, pose: &Pose) {
        let (rim, inside) = (BODIES[body], BODIES[body] + 1);
        if shape.is_circle() {
            let centre = pixel(pose.origin);
            self.fill_circle(centre, rounded(shape.radius), rim);
            self.fill_circle(centre, rounded(shape.radius - RIM), inside);
            return;
        }
        let corners = shape.rects[part].map(|corner| pixel(pose.point(corner)));
        self.fill_polygon(&corners, inside);
        for i in 0..4 {
            self.thick_line(corners[i], corners[(i + 1) % 4], rim);
        }
    }

    /// Redraws the walls that bodies in these areas may cover.
    fn draw_walls(&mut self, areas: &[Area]) {
        for wall in walls() {
            if areas.iter().any(|area| area.touches(line_area(&wall))) {
                self.thick_line(wall[0], wall[1], WALL);
            }
        }
    }
}

/// Returns the pixel of the canvas at a point of the table.
fn pixel(point: Vec2) -> Point {
    Point::nearest(point.x, point.y)
}

fn rounded(radius: f64) -> i32 {
    radius.round_ties_even() as i32
}

fn lighter(color: [u8; 3]) -> [u8; 3] {
    color.map(|v| (f32::from(v) * LIGHTER).round_ties_even().min(255.0) as u8)
}

/// The centre lines of the walls, in pixels of the canvas.
fn walls() -> [[Point; 2]; 4] {
    WALL_LINES.map(|line| line.map(|[x, y]| Point::nearest(x, y)))
}

/// Returns an area that contains the pixels of a thick line.
fn line_area(line: &[Point; 2]) -> Area {
    line.iter().fold(Area::EMPTY, |area, &end| area.with(end, WIDTH / 2 + 1))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::push_t::factors::variation_space;
    use crate::push_t::state::{set_state, settled, start_state, state_of};
    use crate::push_t::table::simulation;
    use swm_core::{Key, VariationRequest};

    #[test]
    fn caching_the_block_changes_no_frame() {
        let all = VariationRequest { variation: Some(vec!["all".to_owned()]), ..VariationRequest::default() };
        let space = variation_space();
        let mut frames_apart = 0;
        for seed in 0..40 {
            let factors = space.resolve(&all, Key::new(seed)).expect("resolving the factors");
            let mut renderer = TableRenderer::new(&factors);
            let mut simulation = settled(simulation(&factors), &start_state(&factors));
            for t in 0..6 {
                // The block moves in every third frame, the agent in every frame.
                let mut state = state_of(&simulation);
                state[0] = (state[0] + 71.0 * f64::from(t)) % TABLE;
                state[2] = if t % 3 == 2 { (state[2] + 150.0) % TABLE } else { state[2] };
                set_state(&mut simulation, &state);
                let drawn = DrawnState { contacts: if t == 4 { 1 } else { 0 }, ..DrawnState::of(&simulation) };
                for side in [64, 100] {
                    let [mut frame, mut expected] = [vec![0; side * side * 3], vec![0; side * side * 3]];
                    renderer.draw(&drawn, FrameMut::new(side, side, &mut frame));
                    let mut uncached = TableRenderer::new(&factors);
                    let areas = [AGENT, BLOCK].map(|body| uncached.area(body, &drawn.poses[body]));
                    frames_apart += usize::from(drawn.contacts == 0 && !areas[AGENT].touches(areas[BLOCK]));
                    let slot = uncached.slot(side, side);
                    uncached.draw_both(&drawn, areas, slot, FrameMut::new(side, side, &mut expected));
                    assert!(frame == expected, "seed {seed}, frame {t}, {side} pixels");
                }
            }
        }
        assert!(frames_apart > 100, "{frames_apart} frames with agent and block apart");
    }
}
