//! What the world looks like: the goal pose, the block and the agent with outlines, walls, and red ticks where
//! shapes touch, as the reference draws it on 512 x 512 pixels and resizes it.
//!
//! The table with goal pose and walls does not change within an episode: it is drawn once, and resampled once for
//! each size. A frame copies it, draws what moves on the canvas, resamples that area, and puts the table back.

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
    /// The same between two frames.
    canvas: Canvas,
    /// The table at sizes asked for before, the last one first.
    pictures: Vec<Picture>,
}

/// The table at one size.
struct Picture {
    resampler: Resampler,
    rgb: Vec<u8>,
    /// Whether `rgb` shows the table of this episode.
    current: bool,
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
        walls().iter().for_each(|&[from, to]| self.table.bar(from, to, WALL));
        self.canvas.copy_area(&self.table, Area::square(SIDE));
        self.pictures.iter_mut().for_each(|picture| picture.current = false);
    }

    /// Draws a scene.
    pub fn draw(&mut self, scene: &Scene, frame: FrameMut<'_>) {
        let mut areas = [Area::EMPTY; 2];
        let mut corners = [Point::new(0, 0); 4];
        for &(body, part) in &self.order {
            let (design, pose) = (&self.designs[body], &scene.poses[body]);
            let (rim, inside) = (BODIES[body], BODIES[body] + 1);
            if design.is_circle() {
                let (centre, radius) = (pixel(pose.origin), whole(design.radius));
                self.canvas.fill_circle(centre, radius, rim);
                self.canvas.fill_circle(centre, whole(design.radius - RIM), inside);
                areas[body] = areas[body].with(centre, radius);
                continue;
            }
            for (corner, &point) in corners.iter_mut().zip(&design.rects[part]) {
                *corner = pixel(pose.point(point));
                areas[body] = areas[body].with(*corner, WIDTH / 2 + 1);
            }
            self.canvas.fill_polygon(&corners, inside);
            for i in 0..4 {
                self.canvas.bar(corners[i], corners[(i + 1) % 4], rim);
            }
        }
        for wall in walls() {
            if areas.iter().any(|area| area.touches(around(&wall))) {
                self.canvas.bar(wall[0], wall[1], WALL);
            }
        }
        for tick in &scene.ticks[..scene.touching] {
            let [from, to] = tick.ends.map(pixel);
            self.canvas.fine_line(from, to, TICK_COLOR, &mut self.palette);
            areas[tick.body] = areas[tick.body].with(from, 1).with(to, 1);
        }

        let picture = self.picture(frame.width, frame.height);
        let Picture { resampler, rgb, .. } = &self.pictures[picture];
        frame.rgb.copy_from_slice(rgb);
        for area in areas {
            resampler.draw(&self.canvas, &self.palette, area, frame.rgb);
        }
        for area in areas {
            self.canvas.copy_area(&self.table, area);
        }
        self.palette.forget_mixed();
    }

    /// The place of the table at this size.
    fn picture(&mut self, width: usize, height: usize) -> usize {
        let is_it = |picture: &Picture| (picture.resampler.width(), picture.resampler.height()) == (width, height);
        let place = self.pictures.iter().position(is_it).unwrap_or_else(|| {
            let (resampler, rgb) = (Resampler::new(SIDE, width, height), vec![0; width * height * 3]);
            self.pictures.truncate(MAX_PICTURES - 1);
            self.pictures.insert(0, Picture { resampler, rgb, current: false });
            0
        });
        let picture = &mut self.pictures[place];
        if !picture.current {
            picture.resampler.draw(&self.table, &self.palette, Area::square(SIDE), &mut picture.rgb);
            picture.current = true;
        }
        place
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
