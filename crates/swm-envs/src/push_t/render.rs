//! What the world looks like: the goal pose, the block and the agent with outlines, walls, and red ticks where
//! shapes touch, as the reference draws it on 512 x 512 pixels and resizes it.
//!
//! The table with goal pose and walls does not change within an episode: it is drawn once, and resampled once for
//! each size. A frame copies it, draws what moves on the canvas, resamples that area, and puts the table back. While
//! nothing touches the block it rests, so it stays on the canvas from frame to frame and only the agent is drawn.

use super::physics::{AGENT, BLOCK, Pose, Vec2, World};
use super::shapes::Design;
use super::{TABLE, WALL_LINES, design};
use crate::draw::{Area, Canvas, Palette, Point, Resampler, WIDTH};
use swm_core::{FactorValues, FrameMut};

/// Pixels along a side of the canvas.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
const SIDE: usize = TABLE as usize;
/// How much smaller the light part of a circle is.
const RIM: f64 = 4.0;
/// By how much the inside of a shape is lighter than its outline.
const LIGHTER: f32 = 1.2;
/// The walls (X11's light gray).
const WALL_COLOR: [u8; 3] = [211, 211, 211];
/// The ticks (pymunk's debug drawing), and how far they reach on both sides of a contact.
const TICK_COLOR: [u8; 3] = [231, 76, 60];
const TICK: f64 = 2.0;
/// The most ticks a picture shows.
const MAX_TICKS: usize = 32;

/// Indices of the palette.
const BACKGROUND: u8 = 0;
const GOAL: u8 = 1;
const WALL: u8 = 2;
/// The outline of the agent; its inside is the next, the block's are the next two.
const BODIES: [u8; 2] = [3, 5];

/// What a picture needs to know.
#[derive(Clone)]
pub struct Scene {
    poses: [Pose; 2],
    ticks: [Tick; MAX_TICKS],
    touching: usize,
}

/// A short line across a contact, and the body it is drawn with.
#[derive(Clone, Copy, Default)]
struct Tick {
    ends: [Vec2; 2],
    body: usize,
}

impl Scene {
    /// The world as it is.
    pub fn of(world: &World) -> Self {
        let poses = [world.bodies[AGENT].pose, world.bodies[BLOCK].pose];
        let mut scene = Self { poses, ticks: [Tick::default(); MAX_TICKS], touching: 0 };
        for arbiter in world.touching() {
            let [a, b] = arbiter.bodies();
            let centres = [a, b].map(|body| world.bodies[body].centre);
            for contact in arbiter.contacts() {
                let Some(tick) = scene.ticks.get_mut(scene.touching) else { return scene };
                let ends = [(0, -TICK), (1, TICK)].map(|(i, by)| centres[i] + contact.arms[i] + arbiter.normal * by);
                *tick = Tick { ends, body: a.min(b) };
                scene.touching += 1;
            }
        }
        scene
    }
}

/// Draws scenes of one episode.
pub struct Renderer {
    designs: [Design; 2],
    /// Which rectangles or circles are drawn when, as (body, place in its design).
    order: Vec<(usize, usize)>,
    palette: Palette,
    /// Background, goal pose and walls.
    table: Canvas,
    /// The same between two frames, with the block where it rests.
    canvas: Canvas,
    resting: Option<Resting>,
    /// The table at sizes asked for before, the last one first.
    pictures: Vec<Picture>,
}

/// A block on the canvas.
#[derive(Clone, Copy)]
struct Resting {
    pose: Pose,
    area: Area,
}

/// The table at one size.
struct Picture {
    resampler: Resampler,
    table: Vec<u8>,
    /// Whether `table` shows the table of this episode.
    current: bool,
    /// The same with the block where it rests, and whether it does.
    still: Vec<u8>,
    resting: bool,
}

/// At how many sizes the table is kept.
const MAX_PICTURES: usize = 4;

impl Renderer {
    /// A renderer for an episode with these factors.
    pub fn new(factors: &FactorValues) -> Self {
        let mut renderer = Self {
            designs: ["agent", "block"].map(|name| design(factors, name)),
            order: vec![],
            palette: Palette::new(&[]),
            table: Canvas::new(SIDE),
            canvas: Canvas::new(SIDE),
            resting: None,
            pictures: vec![],
        };
        renderer.begin(factors);
        renderer
    }

    /// Turns to another episode.
    pub fn begin(&mut self, factors: &FactorValues) {
        self.designs = ["agent", "block"].map(|name| design(factors, name));
        let parts = [AGENT, BLOCK].map(|body| self.designs[body].rects.len().max(1));
        self.order = super::physics::visiting_order(WALL_LINES.len(), parts[0] + parts[1])
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
            // As large as the block: the reference samples `goal.scale` and does not look at it.
            for rect in &self.designs[BLOCK].rects {
                self.table.fill_polygon(&rect.map(|corner| pixel(pose.point(corner))), GOAL);
            }
        }
        walls().iter().for_each(|&[from, to]| self.table.thick_line(from, to, WALL));
        self.canvas.copy_area(&self.table, Area::square(SIDE));
        self.resting = None;
        self.pictures.iter_mut().for_each(|picture| (picture.current, picture.resting) = (false, false));
    }

    /// Draws a scene.
    pub fn draw(&mut self, scene: &Scene, frame: FrameMut<'_>) {
        let picture = self.picture(frame.width, frame.height);
        let areas = [AGENT, BLOCK].map(|body| self.area(body, &scene.poses[body]));
        if scene.touching == 0 && !areas[AGENT].touches(areas[BLOCK]) {
            self.rest(&scene.poses[BLOCK], areas[BLOCK]);
            self.draw_moving(scene, areas[AGENT], picture, frame);
        } else {
            self.draw_touching(scene, areas, picture, frame);
        }
    }

    /// Draws the agent beside the block where it rests.
    fn draw_moving(&mut self, scene: &Scene, area: Area, picture: usize, frame: FrameMut<'_>) {
        let Picture { resampler, table, still, resting, .. } = &mut self.pictures[picture];
        if !*resting {
            still.copy_from_slice(table);
            let block = self.resting.map_or(Area::EMPTY, |block| block.area);
            resampler.draw(&self.canvas, &self.palette, block, still);
            *resting = true;
        }
        // The area of the agent alone is taken back afterwards; the block is not in it.
        self.draw_body(AGENT, &scene.poses[AGENT]);
        self.canvas.draw_walls(&[area]);
        let Picture { resampler, still, .. } = &self.pictures[picture];
        frame.rgb.copy_from_slice(still);
        resampler.draw(&self.canvas, &self.palette, area, frame.rgb);
        self.canvas.copy_area(&self.table, area);
    }

    /// Draws everything that moves, part by part in the reference's order, and ticks where it touches.
    fn draw_touching(&mut self, scene: &Scene, mut areas: [Area; 2], picture: usize, frame: FrameMut<'_>) {
        self.lift();
        for &(body, part) in &self.order {
            self.canvas.draw_part(&self.designs[body], body, part, &scene.poses[body]);
        }
        self.canvas.draw_walls(&areas);
        for tick in &scene.ticks[..scene.touching] {
            let [from, to] = tick.ends.map(pixel);
            self.canvas.fine_line(from, to, TICK_COLOR, &mut self.palette);
            areas[tick.body] = areas[tick.body].with(from, 1).with(to, 1);
        }
        let Picture { resampler, table, .. } = &self.pictures[picture];
        frame.rgb.copy_from_slice(table);
        for area in areas {
            resampler.draw(&self.canvas, &self.palette, area, frame.rgb);
        }
        for area in areas {
            self.canvas.copy_area(&self.table, area);
        }
        self.palette.drop_blended();
    }

    /// Draws all of a body.
    fn draw_body(&mut self, body: usize, pose: &Pose) {
        for &(_, part) in self.order.iter().filter(|(owner, _)| *owner == body) {
            self.canvas.draw_part(&self.designs[body], body, part, pose);
        }
    }

    /// Puts the block on the canvas, unless it rests there already.
    fn rest(&mut self, pose: &Pose, area: Area) {
        if self.resting.is_some_and(|block| block.pose == *pose) {
            return;
        }
        self.lift();
        self.draw_body(BLOCK, pose);
        self.canvas.draw_walls(&[area]);
        self.resting = Some(Resting { pose: *pose, area });
    }

    /// Takes the block off the canvas.
    fn lift(&mut self) {
        if let Some(block) = self.resting.take() {
            self.canvas.copy_area(&self.table, block.area);
            self.pictures.iter_mut().for_each(|picture| picture.resting = false);
        }
    }

    /// The pixels of a body.
    fn area(&self, body: usize, pose: &Pose) -> Area {
        let design = &self.designs[body];
        if design.is_circle() {
            return Area::EMPTY.with(pixel(pose.origin), whole(design.radius));
        }
        let corners = design.rects.iter().flatten().map(|&corner| pixel(pose.point(corner)));
        corners.fold(Area::EMPTY, |area, corner| area.with(corner, WIDTH / 2 + 1))
    }

    /// The place of the table at this size.
    fn picture(&mut self, width: usize, height: usize) -> usize {
        let is_it = |picture: &Picture| (picture.resampler.width(), picture.resampler.height()) == (width, height);
        let place = self.pictures.iter().position(is_it).unwrap_or_else(|| {
            let blank = || vec![0; width * height * 3];
            let (resampler, table, still) = (Resampler::new(SIDE, width, height), blank(), blank());
            self.pictures.truncate(MAX_PICTURES - 1);
            self.pictures.insert(0, Picture { resampler, table, current: false, still, resting: false });
            0
        });
        let picture = &mut self.pictures[place];
        if !picture.current {
            picture.resampler.draw(&self.table, &self.palette, Area::square(SIDE), &mut picture.table);
            picture.current = true;
        }
        place
    }
}

impl Canvas {
    /// Draws a rectangle of a body, or its circle.
    fn draw_part(&mut self, design: &Design, body: usize, part: usize, pose: &Pose) {
        let (rim, inside) = (BODIES[body], BODIES[body] + 1);
        if design.is_circle() {
            let centre = pixel(pose.origin);
            self.fill_circle(centre, whole(design.radius), rim);
            self.fill_circle(centre, whole(design.radius - RIM), inside);
            return;
        }
        let corners = design.rects[part].map(|corner| pixel(pose.point(corner)));
        self.fill_polygon(&corners, inside);
        for i in 0..4 {
            self.thick_line(corners[i], corners[(i + 1) % 4], rim);
        }
    }

    /// Draws the walls again that bodies in these areas may cover.
    fn draw_walls(&mut self, areas: &[Area]) {
        for wall in walls() {
            if areas.iter().any(|area| area.touches(around(&wall))) {
                self.thick_line(wall[0], wall[1], WALL);
            }
        }
    }
}

/// The pixel of the canvas at a place of the table.
fn pixel(place: Vec2) -> Point {
    Point::nearest(place.x, place.y)
}

#[allow(clippy::cast_possible_truncation)]
fn whole(radius: f64) -> i32 {
    radius.round_ties_even() as i32
}

#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
fn lighter(color: [u8; 3]) -> [u8; 3] {
    color.map(|v| (f32::from(v) * LIGHTER).round_ties_even().min(255.0) as u8)
}

/// The middle lines of the walls.
fn walls() -> [[Point; 2]; 4] {
    WALL_LINES.map(|line| line.map(|[x, y]| Point::nearest(x, y)))
}

/// The pixels of a bar.
fn around(bar: &[Point; 2]) -> Area {
    bar.iter().fold(Area::EMPTY, |area, &end| area.with(end, WIDTH / 2 + 1))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::push_t::{place, settle, start_of, variation_space, world_of};
    use swm_core::{Key, VariationRequest};

    #[test]
    fn a_block_that_rests_on_the_canvas_changes_no_picture() {
        let all = VariationRequest { variation: Some(vec!["all".to_owned()]), ..VariationRequest::default() };
        let space = variation_space();
        let mut apart = 0;
        for seed in 0..40 {
            let factors = space.resolve(&all, Key::new(seed)).expect("factors");
            let mut renderer = Renderer::new(&factors);
            let mut world = settle(world_of(&factors), &start_of(&factors));
            for t in 0..6 {
                // The block moves every third time, the agent always.
                let mut state = crate::push_t::state_of(&world);
                state[0] = (state[0] + 71.0 * f64::from(t)) % TABLE;
                state[2] = if t % 3 == 2 { (state[2] + 150.0) % TABLE } else { state[2] };
                place(&mut world, &state);
                let scene = Scene { touching: if t == 4 { 1 } else { 0 }, ..Scene::of(&world) };
                for side in [64, 100] {
                    let [mut got, mut wanted] = [vec![0; side * side * 3], vec![0; side * side * 3]];
                    renderer.draw(&scene, FrameMut::new(side, side, &mut got));
                    let mut other = Renderer::new(&factors);
                    let areas = [AGENT, BLOCK].map(|body| other.area(body, &scene.poses[body]));
                    apart += usize::from(scene.touching == 0 && !areas[AGENT].touches(areas[BLOCK]));
                    let picture = other.picture(side, side);
                    other.draw_touching(&scene, areas, picture, FrameMut::new(side, side, &mut wanted));
                    assert!(got == wanted, "seed {seed}, frame {t}, {side} pixels");
                }
            }
        }
        assert!(apart > 100, "{apart} frames with agent and block apart");
    }
}
