#![doc = include_str!("README.md")]

mod expert;
mod paths;
mod physics;
mod render;

use crate::draw::{Rgb, SoftDisc};
use crate::point_agent::room::{self, GOAL_RADIUS, SIZE, choice, color, position_factor, scalar};
use crate::point_agent::{PointAgentEnv, PointTask, Position, distance64, farthest_goal, position, widen};
use physics::{Layout, MAX_DOORS, WALL_CENTER};
use render::{RoomAppearance, RoomRenderer};
use swm_core::{DType, EnvEntry, EnvSpec, Factor, FactorValues, FrameMut, Rng, RowMut, Space, VariationSpace};

/// The registry row of this environment.
pub const ENTRY: EnvEntry = EnvEntry {
    id: TwoRoom::ID,
    summary: "walk from room to room through the doors of the wall between them, to the target",
    options: &[],
    make: |_| Ok(Box::new(PointAgentEnv::<TwoRoom>::new())),
    experts: expert::EXPERTS,
};

/// Values of the `observation` column: x and y of the agent, of the target and of the centre of every door.
const OBSERVATION_LEN: usize = 4 + 2 * MAX_DOORS;

/// Two rooms and a wall with doors between them.
struct TwoRoom {
    layout: Layout,
    agent_color: Rgb,
    appearance: RoomAppearance,
}

impl PointTask for TwoRoom {
    const ID: &'static str = "swm/TwoRoom-v1";
    const SIZE: f64 = SIZE;
    const GOAL_FACTOR: &'static str = "target.position";
    const GOAL_TRIES: usize = room::GOAL_TRIES;

    type Renderer = RoomRenderer;

    fn spec() -> EnvSpec {
        room::spec(Self::ID, OBSERVATION_LEN, ("layout", Layout::LEN), variation_space())
    }

    fn new(factors: &FactorValues) -> Self {
        let layout = layout(factors);
        let appearance = RoomAppearance {
            floor: factors.rgb("background.color"),
            wall: factors.rgb("wall.color"),
            border: factors.rgb("wall.border_color"),
            door: factors.rgb("door.color"),
            across: layout.across,
            half_thickness: layout.half_thickness,
            doors: doors(factors),
            target: room::target_disc(factors),
        };
        Self { layout, agent_color: factors.rgb("agent.color"), appearance }
    }

    fn advance(&self, from: Position, action: [f32; 2]) -> Position {
        self.layout.advance(from, action)
    }

    fn is_reached(&self, agent: Position, goal: Position) -> bool {
        room::distance(agent, goal) < GOAL_RADIUS
    }

    fn reward(&self, _reached: bool) -> f64 {
        0.0
    }

    fn observe(&self, agent: Position, goal: Position, row: &mut RowMut<'_>) {
        let mut observation = [0.0; OBSERVATION_LEN];
        observation[..2].copy_from_slice(&agent);
        observation[2..4].copy_from_slice(&goal);
        let slots = observation[4..].as_chunks_mut::<2>().0;
        for (slot, &[center, _]) in slots.iter_mut().zip(&self.appearance.doors) {
            slot[self.layout.across] = WALL_CENTER as f32;
            slot[1 - self.layout.across] = center as f32;
        }
        room::observe(agent, goal, &observation, &self.layout.to_row(), row);
    }

    fn set_goal(&mut self, goal: Position) {
        if let Some(target) = &mut self.appearance.target {
            target.center = goal;
        }
    }

    fn draw(&self, agent: Position, renderer: &mut RoomRenderer, frame: FrameMut<'_>) {
        let agent = SoftDisc { center: agent, radius: self.layout.radius, color: self.agent_color };
        renderer.draw(&self.appearance, &agent, frame);
    }

    fn find_goal(&self, factors: &FactorValues, agent: Position, rng: &mut Rng) -> Option<Position> {
        let [low, high] = self.layout.reach();
        let space = Space::uniform_box([2], DType::Float32, low, high);
        let wanted = factors.scalar("task.min_steps") * self.layout.speed;
        farthest_goal(Self::GOAL_TRIES, wanted, || {
            let candidate = space.sample(rng);
            let goal = position(&candidate);
            if !self.layout.is_free(goal) || self.is_reached(agent, goal) {
                return None;
            }
            let length = paths::length(&self.layout, widen(agent), [candidate[0], candidate[1]])?;
            Some((length, goal))
        })
    }

    fn goal_distance(&self, agent: Position, goal: Position) -> f64 {
        let (from, to) = (widen(agent), widen(goal));
        // Without a passable door there is no path; the length of the straight line is used.
        paths::length(&self.layout, from, to).unwrap_or_else(|| distance64(from, to))
    }
}

/// Returns the variation space, with names, bounds, defaults, order and constraints of the reference.
fn variation_space() -> VariationSpace {
    let per_door = |key, n: i64, start: i64, default: f64| {
        let space = Space::MultiDiscrete { nvec: vec![n; MAX_DOORS], start: vec![start; MAX_DOORS] };
        Factor::new(key, space, [default; MAX_DOORS])
    };
    let (black, white) = ([0.0; 3], [255.0; 3]);
    VariationSpace::new(
        vec![
            color("background.color", white),
            color("wall.color", black),
            color("wall.border_color", black),
            choice("wall.thickness", 35, 7, 10.0),
            choice("wall.axis", 2, 0, 1.0),
            color("agent.color", [255.0, 0.0, 0.0]),
            scalar("agent.radius", 7.0, 14.0, 7.0),
            position_factor("agent.position", [60.0, 112.0]),
            scalar("agent.speed", 1.75, 10.5, 5.0),
            color("door.color", white),
            choice("door.number", 3, 1, 1.0),
            per_door("door.size", 21, 1, 14.0),
            per_door("door.position", 224, 0, 49.0),
            choice("task.min_steps", 100, 15, 25.0),
            color("target.color", [0.0, 255.0, 0.0]),
            scalar("target.radius", 7.0, 14.0, 7.0),
            position_factor("target.position", [164.0, 112.0]),
            choice("rendering.render_target", 2, 0, 0.0),
        ],
        &["agent.position", "target.position"],
    )
    .constrain("agent.position", "the agent does not touch the wall between the rooms", |values| {
        let layout = layout(values);
        (values.get("agent.position")[layout.across] - WALL_CENTER).abs() > layout.contact_depth()
    })
    .constrain("door.size", "at least one door is 1.1 times as wide as the agent", |values| {
        let (doors, radius) = (doors(values), values.scalar("agent.radius"));
        doors.iter().any(|[_, size]| *size >= 1.1 * radius)
    })
}

/// Returns centre and half-width of every existing door, along the wall, in pixels.
fn doors(factors: &FactorValues) -> Vec<[f64; 2]> {
    let pairs = factors.get("door.position").iter().zip(factors.get("door.size"));
    let count = usize::try_from(factors.integer("door.number")).unwrap_or(0);
    pairs.take(count).map(|(&center, &size)| [center, size]).collect()
}

/// Returns the layout that the factors describe.
fn layout(factors: &FactorValues) -> Layout {
    let mut openings = [[0.0; 2]; MAX_DOORS];
    for (opening, [center, size]) in openings.iter_mut().zip(doors(factors)) {
        *opening = Layout::opening(center, size);
    }
    Layout {
        across: usize::from(factors.integer("wall.axis") == 0),
        half_thickness: (factors.scalar("wall.thickness") / 2.0).floor(),
        radius: factors.scalar("agent.radius"),
        speed: factors.scalar("agent.speed"),
        doors: openings,
    }
}
