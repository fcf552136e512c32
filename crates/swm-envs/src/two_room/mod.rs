#![doc = include_str!("README.md")]

mod expert;
mod physics;
mod render;
mod route;

use crate::draw::Disc;
use crate::factors;
use physics::{BORDER, GOAL_RADIUS, Layout, MAX_DOORS, Point, SIZE, distance};
use render::{Renderer, Scene};
use swm_core::{
    Action, ColumnSpec, DType, Env, EnvEntry, EnvSpec, Error, Factor, FactorValues, FrameMut, Key, ResetOptions,
    Result, RowMut, RowRef, Snapshot, Space, Transition, VariationRequest, VariationSpace,
};

/// The registry row.
pub const ENTRY: EnvEntry = EnvEntry {
    id: "swm/TwoRoom-v1",
    summary: "walk from room to room through the doors of the wall between them, to the target",
    options: &[],
    make: |_| Ok(Box::new(TwoRoom::new())),
    experts: expert::EXPERTS,
};

/// Samples from which [`Env::sample_goal`] chooses.
const GOAL_TRIES: usize = 256;

/// Two rooms, a wall with doors between them, an agent and a target.
pub struct TwoRoom {
    spec: EnvSpec,
    factors: FactorValues,
    layout: Layout,
    agent: Disc,
    goal: Point,
    scene: Scene,
    renderer: Renderer,
}

impl TwoRoom {
    /// The world with every factor at its default.
    pub fn new() -> Self {
        let spec = spec();
        let none = VariationRequest { variation: Some(vec![]), ..VariationRequest::default() };
        let factors = spec.variation_space.resolve(&none, Key::new(0)).expect("defaults are in their spaces");
        let (layout, scene) = (layout(&factors), scene(&factors));
        let agent = Disc {
            center: point(factors.get("agent.position")),
            radius: layout.radius,
            color: factors.rgb("agent.color"),
        };
        let goal = point(factors.get("target.position"));
        Self { spec, factors, layout, agent, goal, scene, renderer: Renderer::default() }
    }

    /// Makes the world that of these factors, with agent and target at these places.
    fn arrange(&mut self, factors: FactorValues, agent: Point, goal: Point) {
        self.layout = layout(&factors);
        self.scene = scene(&factors);
        self.agent = Disc { center: agent, radius: self.layout.radius, color: factors.rgb("agent.color") };
        self.factors = factors;
        self.aim(goal);
    }

    /// Moves the target.
    fn aim(&mut self, goal: Point) {
        self.goal = goal;
        if let Some(target) = &mut self.scene.target {
            target.center = goal;
        }
    }

    /// The numbers of the `observation` column: agent, target, and the middle of every door.
    #[allow(clippy::cast_possible_truncation)]
    fn observation(&self) -> [f32; 4 + 2 * MAX_DOORS] {
        let mut numbers = [0.0; 4 + 2 * MAX_DOORS];
        numbers[..2].copy_from_slice(&self.agent.center);
        numbers[2..4].copy_from_slice(&self.goal);
        for (slot, &[middle, _]) in numbers[4..].as_chunks_mut::<2>().0.iter_mut().zip(&self.scene.doors) {
            slot[self.layout.across] = physics::CENTER as f32;
            slot[1 - self.layout.across] = middle as f32;
        }
        numbers
    }
}

impl Default for TwoRoom {
    fn default() -> Self {
        Self::new()
    }
}

/// Places in [`EnvSpec::columns`].
mod columns {
    pub const STATE: usize = 0;
    pub const PROPRIO: usize = 1;
    pub const GOAL_STATE: usize = 2;
    pub const DISTANCE: usize = 3;
    pub const OBSERVATION: usize = 4;
    pub const LAYOUT: usize = 5;
}

fn spec() -> EnvSpec {
    EnvSpec {
        id: ENTRY.id.to_owned(),
        action_space: Space::uniform_box([2], DType::Float32, -1.0, 1.0),
        columns: vec![
            ColumnSpec::new("state", DType::Float32, [2]),
            ColumnSpec::new("proprio", DType::Float32, [2]),
            ColumnSpec::new("goal_state", DType::Float32, [2]),
            ColumnSpec::new("distance_to_target", DType::Float32, []),
            ColumnSpec::new("observation", DType::Float32, [4 + 2 * MAX_DOORS]),
            ColumnSpec::new("layout", DType::Float32, [Layout::LEN]),
        ],
        observation_space: vec![("observation", Space::uniform_box([4 + 2 * MAX_DOORS], DType::Float32, 0.0, SIZE))],
        variation_space: variation_space(),
        max_episode_steps: 100,
        cameras: vec![],
    }
}

/// Names, bounds, defaults, order and constraints are the reference's.
fn variation_space() -> VariationSpace {
    let color = |key, default: [f64; 3]| Factor::new(key, Space::Rgb, default);
    let scalar =
        |key, low, high, default: f64| Factor::new(key, Space::uniform_box([1], DType::Float32, low, high), [default]);
    let place = |key, default: [f64; 2]| {
        Factor::new(key, Space::uniform_box([2], DType::Float32, BORDER, SIZE - BORDER - 1.0), default)
    };
    let choice = |key, n, start, default: f64| Factor::new(key, Space::Discrete { n, start }, [default]);
    let doors = |key, n: i64, start: i64, default: f64| {
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
            place("agent.position", [60.0, 112.0]),
            scalar("agent.speed", 1.75, 10.5, 5.0),
            color("door.color", white),
            choice("door.number", 3, 1, 1.0),
            doors("door.size", 21, 1, 14.0),
            doors("door.position", 224, 0, 49.0),
            choice("task.min_steps", 100, 15, 25.0),
            color("target.color", [0.0, 255.0, 0.0]),
            scalar("target.radius", 7.0, 14.0, 7.0),
            place("target.position", [164.0, 112.0]),
            choice("rendering.render_target", 2, 0, 0.0),
        ],
        &["agent.position", "target.position"],
    )
    .constrain("agent.position", "the agent does not touch the wall between the rooms", |values| {
        let layout = layout(values);
        (values.get("agent.position")[layout.across] - physics::CENTER).abs() > layout.touch()
    })
    .constrain("door.size", "at least one door is 1.1 times as wide as the agent", |values| {
        let (doors, radius) = (doors_of(values), values.scalar("agent.radius"));
        doors.iter().any(|[_, size]| *size >= 1.1 * radius)
    })
}

/// Middle and half-width of every door that is there.
fn doors_of(factors: &FactorValues) -> Vec<[f64; 2]> {
    let pairs = factors.get("door.position").iter().zip(factors.get("door.size"));
    let number = usize::try_from(factors.integer("door.number")).unwrap_or(0);
    pairs.take(number).map(|(&middle, &size)| [middle, size]).collect()
}

fn layout(factors: &FactorValues) -> Layout {
    let mut doors = [[0.0; 2]; MAX_DOORS];
    for (door, [middle, size]) in doors.iter_mut().zip(doors_of(factors)) {
        *door = Layout::door(middle, size);
    }
    Layout {
        across: usize::from(factors.integer("wall.axis") == 0),
        half: (factors.scalar("wall.thickness") / 2.0).floor(),
        radius: factors.scalar("agent.radius"),
        speed: factors.scalar("agent.speed"),
        doors,
    }
}

fn scene(factors: &FactorValues) -> Scene {
    let layout = layout(factors);
    Scene {
        floor: factors.rgb("background.color"),
        wall: factors.rgb("wall.color"),
        border: factors.rgb("wall.border_color"),
        door: factors.rgb("door.color"),
        across: layout.across,
        half: layout.half,
        doors: doors_of(factors),
        target: (factors.integer("rendering.render_target") == 1).then(|| Disc {
            center: point(factors.get("target.position")),
            radius: factors.scalar("target.radius"),
            color: factors.rgb("target.color"),
        }),
    }
}

#[allow(clippy::cast_possible_truncation)]
fn point(value: &[f64]) -> Point {
    [value[0] as f32, value[1] as f32]
}

/// A place somebody asks for, in the layout of the `state` column.
fn checked(what: &str, value: &[f64]) -> Result<Point> {
    Space::uniform_box([2], DType::Float32, 0.0, SIZE).check(what, value)?;
    Ok(point(value))
}

impl Env for TwoRoom {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn reset(&mut self, seed: u64, options: &ResetOptions) -> Result<()> {
        let factors = self.spec.variation_space.resolve(&options.variation, Key::new(seed))?;
        let place = |what, asked: &Option<Vec<f64>>, factor| match asked {
            Some(value) => checked(what, value),
            None => Ok(point(factors.get(factor))),
        };
        let agent = place("state", &options.state, "agent.position")?;
        let goal = place("goal_state", &options.goal_state, "target.position")?;
        self.arrange(factors, agent, goal);
        Ok(())
    }

    fn step(&mut self, action: Action<'_>) -> Result<Transition> {
        let action = action.continuous(2)?;
        self.agent.center = self.layout.advance(self.agent.center, [action[0], action[1]]);
        Ok(Transition { reward: 0.0, terminated: self.is_success(), truncated: false })
    }

    fn observe(&self, row: &mut RowMut<'_>) {
        row.set(columns::STATE, &self.agent.center);
        row.set(columns::PROPRIO, &self.agent.center);
        row.set(columns::GOAL_STATE, &self.goal);
        row.set(columns::DISTANCE, &[distance(self.agent.center, self.goal)]);
        row.set(columns::OBSERVATION, &self.observation());
        row.set(columns::LAYOUT, &self.layout.to_row());
    }

    fn render(&mut self, frame: FrameMut<'_>) -> Result<()> {
        self.renderer.draw(&self.scene, &self.agent, frame);
        Ok(())
    }

    fn render_goal(&mut self, frame: FrameMut<'_>) -> Result<()> {
        self.renderer.draw(&self.scene, &Disc { center: self.goal, ..self.agent }, frame);
        Ok(())
    }

    fn factors(&self) -> &FactorValues {
        &self.factors
    }

    fn snapshot(&self) -> Snapshot {
        factors::snapshot(ENTRY.id, &self.factors, factors::places_to_bytes(self.agent.center, self.goal))
    }

    fn restore(&mut self, snapshot: &Snapshot) -> Result<()> {
        let (factors, places) = factors::restored(ENTRY.id, &self.spec.variation_space, &self.factors, snapshot)?;
        let [agent, goal] = factors::places_from_bytes(ENTRY.id, places)?;
        match factors {
            Some(factors) => self.arrange(factors, agent, goal),
            None => {
                self.agent.center = agent;
                self.aim(goal);
            }
        }
        Ok(())
    }

    fn restore_from(&mut self, start: RowRef<'_>, goal: RowRef<'_>) -> Result<()> {
        let agent = checked("state", &start.to_f64("state")?)?;
        let goal = checked("goal state", &goal.to_f64("state")?)?;
        let factors = factors::from_row(&self.spec.variation_space, &self.factors, start)?;
        self.arrange(factors, agent, goal);
        Ok(())
    }

    fn sample_goal(&mut self, key: Key) -> Result<()> {
        let mut rng = key.rng();
        let [low, high] = self.layout.reach();
        let space = Space::uniform_box([2], DType::Float32, low, high);
        let start = self.agent.center.map(f64::from);
        let wanted = self.factors.scalar("task.min_steps") * self.layout.speed;
        let mut longest: Option<(f64, Point)> = None;
        for _ in 0..GOAL_TRIES {
            let place = space.sample(&mut rng);
            let goal = point(&place);
            if !self.layout.is_free(goal) || distance(self.agent.center, goal) < GOAL_RADIUS {
                continue;
            }
            let Some(length) = route::length(&self.layout, start, [place[0], place[1]]) else { continue };
            if longest.is_none_or(|(known, _)| length > known) {
                longest = Some((length, goal));
            }
            if length >= wanted {
                break;
            }
        }
        let Some((_, goal)) = longest else {
            return Err(Error::Unsatisfiable {
                factor: "goal".to_owned(),
                constraint: "reachable and not reached already".to_owned(),
                tries: GOAL_TRIES,
            });
        };
        self.aim(goal);
        Ok(())
    }

    fn is_success(&self) -> bool {
        distance(self.agent.center, self.goal) < GOAL_RADIUS
    }

    fn goal_distance(&self) -> f64 {
        let [from, to] = [self.agent.center, self.goal].map(|place| place.map(f64::from));
        // A target behind a wall without a passable door is told by the straight line.
        route::length(&self.layout, from, to).unwrap_or_else(|| (from[0] - to[0]).hypot(from[1] - to[1]))
    }
}
