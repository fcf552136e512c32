#![doc = include_str!("README.md")]

mod expert;
mod physics;
mod render;
mod route;

use crate::factors;
use physics::{Layout, MAX_ACTION, MAX_WALLS, Point, SIZE, Wall, distance};
use render::{Disc, Renderer, Scene};
use route::{Map, Ways};
use std::cell::OnceCell;
use swm_core::{
    Action, ColumnSpec, DType, Env, EnvEntry, EnvSpec, Error, Factor, FactorValues, FrameMut, Key, ResetOptions,
    Result, RowMut, RowRef, Snapshot, Space, Transition, VariationRequest, VariationSpace,
};

/// The registry row.
pub const ENTRY: EnvEntry = EnvEntry {
    id: "swm/SimplePointMaze-v0",
    summary: "walk around rectangular walls to the goal",
    options: &[],
    make: |_| Ok(Box::new(PointMaze::new())),
    experts: expert::EXPERTS,
};

/// Samples from which [`Env::sample_goal`] chooses.
const GOAL_TRIES: usize = 4096;
/// Full steps that it aims for.
const GOAL_STEPS: f64 = 10.0;
/// Worlds drawn at a reset before giving up.
const WORLD_TRIES: usize = 1000;

/// A square with walls in it, an agent and a goal.
pub struct PointMaze {
    spec: EnvSpec,
    factors: FactorValues,
    layout: Layout,
    agent: Disc,
    scene: Scene,
    /// Found when somebody asks for the way: the map of these walls, and the ways to this goal.
    map: OnceCell<Map>,
    ways: OnceCell<Ways>,
    renderer: Renderer,
}

impl PointMaze {
    /// The world with every factor at its default.
    pub fn new() -> Self {
        let spec = spec();
        let none = VariationRequest { variation: Some(vec![]), ..VariationRequest::default() };
        let factors = spec.variation_space.resolve(&none, Key::new(0)).expect("defaults are in their spaces");
        let layout = layout(&factors);
        let agent = disc(&factors, "agent");
        let scene = scene(&factors, layout);
        let (map, ways) = (OnceCell::new(), OnceCell::new());
        Self { spec, factors, layout, agent, scene, map, ways, renderer: Renderer::default() }
    }

    /// Makes the world that of these factors, with agent and goal at these places.
    fn arrange(&mut self, factors: FactorValues, agent: Point, goal: Point) {
        let (layout, before) = (layout(&factors), self.scene.goal.center);
        if layout != self.layout {
            self.map.take();
            self.ways.take();
        }
        self.layout = layout;
        self.scene = scene(&factors, layout);
        self.agent = Disc { center: agent, ..disc(&factors, "agent") };
        self.factors = factors;
        self.scene.goal.center = before;
        self.aim(goal);
    }

    /// Moves the goal.
    fn aim(&mut self, goal: Point) {
        if self.scene.goal.center != goal {
            self.ways.take();
        }
        self.scene.goal.center = goal;
    }

    fn map(&self) -> &Map {
        self.map.get_or_init(|| Map::new(&self.layout))
    }
}

impl Default for PointMaze {
    fn default() -> Self {
        Self::new()
    }
}

/// Places in [`EnvSpec::columns`].
mod columns {
    pub const STATE: usize = 0;
    pub const GOAL_STATE: usize = 1;
    pub const OBSERVATION: usize = 2;
    pub const LAYOUT: usize = 3;
}

fn spec() -> EnvSpec {
    let limit = f64::from(MAX_ACTION);
    EnvSpec {
        id: ENTRY.id.to_owned(),
        action_space: Space::uniform_box([2], DType::Float32, -limit, limit),
        columns: vec![
            ColumnSpec::new("state", DType::Float32, [2]),
            ColumnSpec::new("goal_state", DType::Float32, [2]),
            ColumnSpec::new("observation", DType::Float32, [2]),
            ColumnSpec::new("layout", DType::Float32, [Layout::LEN]),
        ],
        observation_space: vec![("observation", Space::uniform_box([2], DType::Float32, 0.0, 5.0))],
        variation_space: variation_space(),
        max_episode_steps: 100,
        cameras: vec![],
    }
}

/// The default walls: what the reference draws from a generator of its own, least corner and size of each.
#[rustfmt::skip]
const WALLS: [[[f32; 2]; 2]; MAX_WALLS] = [
    [[1.035_264_5, 3.455_474_9], [1.289_385_2, 0.840_687_3]],
    [[3.002_354_6, 3.442_296_5], [1.244_401_8, 1.042_815_8]],
    [[1.534_523_5, 2.916_535_6], [0.659_792_54, 1.363_933_2]],
    [[2.142_178_5, 2.783_088  ], [1.112_480_2, 1.099_487_4]],
    [[1.260_334_3, 3.453_317_9], [0.963_911_95, 0.616_462_47]],
    [[1.504_300_8, 2.397_299_3], [0.714_128_6, 0.655_603_7]],
];

/// Names, bounds, defaults, order and constraints are the reference's.
fn variation_space() -> VariationSpace {
    let single = |v: f32| f64::from(v);
    let color = |key, default: [f64; 3]| Factor::new(key, Space::Rgb, default);
    let scalar = |key, low: f32, high: f32, default: f32| {
        Factor::new(key, Space::uniform_box([], DType::Float32, single(low), single(high)), [single(default)])
    };
    let place =
        |key, default: [f64; 2]| Factor::new(key, Space::uniform_box([2], DType::Float32, 0.0, single(SIZE)), default);
    let walls = |key, low, high, which: usize| {
        let space = Space::uniform_box([MAX_WALLS, 2], DType::Float32, low, high);
        Factor::new(key, space, WALLS.map(|wall| wall[which].map(single)).concat())
    };
    VariationSpace::new(
        vec![
            color("agent.color", [255.0, 0.0, 0.0]),
            place("agent.position", [0.5, 0.5]),
            scalar("agent.radius", 0.05, 0.5, 0.1),
            scalar("agent.speed", 0.05, 2.0, 1.0),
            color("goal.color", [0.0, 255.0, 0.0]),
            place("goal.position", [4.5, 4.5]),
            scalar("goal.radius", 0.05, 0.5, 0.2),
            Factor::new("walls.number", Space::Discrete { n: 3, start: 4 }, [5.0]),
            color("walls.color", [0.0; 3]),
            walls("walls.shape", 0.5, 1.5, 1),
            walls("walls.positions", 0.0, single(SIZE), 0),
            color("background.color", [255.0; 3]),
        ],
        &["agent.position"],
    )
    .constrain("agent.position", "the agent touches no wall", |values| fits(values, "agent"))
    .constrain("goal.position", "the goal touches no wall", |values| fits(values, "goal"))
    .constrain("walls.positions", "walls are inside the square and touch neither agent nor goal", |values| {
        let inside = |wall: &Wall| wall.high.iter().all(|&v| v <= SIZE);
        layout(values).walls().iter().all(inside) && fits(values, "agent") && fits(values, "goal")
    })
}

/// Whether the `agent` or the `goal` touches no wall.
fn fits(factors: &FactorValues, name: &str) -> bool {
    let (position, radius) = match name {
        "agent" => ("agent.position", "agent.radius"),
        _ => ("goal.position", "goal.radius"),
    };
    !layout(factors).touches(point(factors.get(position)), single(factors, radius))
}

#[allow(clippy::cast_possible_truncation)]
fn single(factors: &FactorValues, key: &str) -> f32 {
    factors.scalar(key) as f32
}

fn layout(factors: &FactorValues) -> Layout {
    let pairs = |key| factors.get(key).as_chunks::<2>().0.iter().map(|pair| point(pair));
    let number = usize::try_from(factors.integer("walls.number")).unwrap_or(0);
    let walls = pairs("walls.positions").zip(pairs("walls.shape")).take(number);
    let walls = walls.map(|(low, size)| Wall { low, high: [low[0] + size[0], low[1] + size[1]] });
    Layout::new(single(factors, "agent.radius"), single(factors, "agent.speed"), walls)
}

fn scene(factors: &FactorValues, layout: Layout) -> Scene {
    Scene {
        background: factors.rgb("background.color"),
        wall: factors.rgb("walls.color"),
        layout,
        goal: disc(factors, "goal"),
    }
}

/// The `agent` or the `goal` where the factors put it.
fn disc(factors: &FactorValues, name: &str) -> Disc {
    Disc {
        center: point(factors.get(&format!("{name}.position"))),
        radius: single(factors, &format!("{name}.radius")),
        color: factors.rgb(&format!("{name}.color")),
    }
}

#[allow(clippy::cast_possible_truncation)]
fn point(value: &[f64]) -> Point {
    [value[0] as f32, value[1] as f32]
}

/// A place somebody asks for, in the layout of the `state` column.
fn checked(what: &str, value: &[f64]) -> Result<Point> {
    Space::uniform_box([2], DType::Float32, 0.0, f64::from(SIZE)).check(what, value)?;
    Ok(point(value))
}

impl Env for PointMaze {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn reset(&mut self, seed: u64, options: &ResetOptions) -> Result<()> {
        // Factors sampled after a position, such as a radius, may bring it to a wall: then another world is drawn.
        let key = |tried: u64| if tried == 0 { Key::new(seed) } else { Key::new(seed).with("another world").at(tried) };
        let mut worlds = (0..WORLD_TRIES as u64).map(|i| self.spec.variation_space.resolve(&options.variation, key(i)));
        let fitting =
            worlds.find(|world| world.as_ref().map_or(true, |world| fits(world, "agent") && fits(world, "goal")));
        let factors = fitting.unwrap_or_else(|| {
            Err(Error::Unsatisfiable {
                factor: "walls.positions".to_owned(),
                constraint: "neither agent nor goal touches a wall".to_owned(),
                tries: WORLD_TRIES,
            })
        })?;
        let place = |what, asked: &Option<Vec<f64>>, factor| match asked {
            Some(value) => checked(what, value),
            None => Ok(point(factors.get(factor))),
        };
        let agent = place("state", &options.state, "agent.position")?;
        let goal = place("goal_state", &options.goal_state, "goal.position")?;
        self.arrange(factors, agent, goal);
        Ok(())
    }

    fn step(&mut self, action: Action<'_>) -> Result<Transition> {
        let action = action.continuous(2)?;
        self.agent.center = self.layout.advance(self.agent.center, [action[0], action[1]]);
        let terminated = self.is_success();
        Ok(Transition { reward: if terminated { 1.0 } else { -0.01 }, terminated, truncated: false })
    }

    fn observe(&self, row: &mut RowMut<'_>) {
        row.set(columns::STATE, &self.agent.center);
        row.set(columns::GOAL_STATE, &self.scene.goal.center);
        row.set(columns::OBSERVATION, &self.agent.center);
        row.set(columns::LAYOUT, &self.layout.to_row());
    }

    fn render(&mut self, frame: FrameMut<'_>) -> Result<()> {
        self.renderer.draw(&self.scene, &self.agent, frame);
        Ok(())
    }

    fn render_goal(&mut self, frame: FrameMut<'_>) -> Result<()> {
        self.renderer.draw(&self.scene, &Disc { center: self.scene.goal.center, ..self.agent }, frame);
        Ok(())
    }

    fn factors(&self) -> &FactorValues {
        &self.factors
    }

    fn snapshot(&self) -> Snapshot {
        factors::snapshot(ENTRY.id, &self.factors, factors::places_to_bytes(self.agent.center, self.scene.goal.center))
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
        let space = Space::uniform_box([2], DType::Float32, 0.0, f64::from(SIZE));
        let (radius, reach) = (self.layout.radius, self.scene.goal.radius);
        let wanted = GOAL_STEPS * f64::from(MAX_ACTION * self.layout.speed);
        // Ways are as long in either direction.
        let map = self.map();
        let ways = map.ways(self.agent.center.map(f64::from));
        let mut longest: Option<(f64, Point)> = None;
        // The goal touches no wall, as at a reset; only if there is no such place, it is enough that the agent does not.
        for clear in [radius.max(reach), radius] {
            for _ in 0..GOAL_TRIES {
                let goal = point(&space.sample(&mut rng));
                if self.layout.touches(goal, clear) || distance(self.agent.center, goal) < reach {
                    continue;
                }
                let Some((_, length)) = map.next(goal.map(f64::from), &ways) else { continue };
                if longest.is_none_or(|(known, _)| length > known) {
                    longest = Some((length, goal));
                }
                if length >= wanted {
                    break;
                }
            }
            if longest.is_some() {
                break;
            }
        }
        let Some((_, goal)) = longest else {
            return Err(Error::Unsatisfiable {
                factor: "goal".to_owned(),
                constraint: "reachable and not reached already".to_owned(),
                tries: 2 * GOAL_TRIES,
            });
        };
        self.aim(goal);
        Ok(())
    }

    fn is_success(&self) -> bool {
        distance(self.agent.center, self.scene.goal.center) < self.scene.goal.radius
    }

    fn goal_distance(&self) -> f64 {
        let [from, to] = [self.agent.center, self.scene.goal.center].map(|place| place.map(f64::from));
        let ways = self.ways.get_or_init(|| self.map().ways(to));
        // A goal that no way leads to is told by the straight line.
        self.map().next(from, ways).map_or_else(|| (from[0] - to[0]).hypot(from[1] - to[1]), |(_, length)| length)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use swm_core::{Batch, Schema};

    fn vary(keys: &[&str]) -> ResetOptions {
        let variation = Some(keys.iter().map(|&key| key.to_owned()).collect());
        ResetOptions {
            variation: VariationRequest { variation, ..VariationRequest::default() },
            ..ResetOptions::default()
        }
    }

    #[test]
    fn resets_and_goals_never_fail() {
        let mut env = PointMaze::new();
        for seed in 0..10_000 {
            env.reset(seed, &vary(&["all"])).expect("a reset");
            assert!(!env.layout.touches(env.agent.center, env.layout.radius), "seed {seed}");
            env.sample_goal(Key::new(seed)).expect("a goal");
            assert!(!env.is_success(), "seed {seed}");
        }
    }

    #[test]
    fn whatever_varies_nothing_touches_a_wall() {
        let mut env = PointMaze::new();
        let keys = ["agent", "goal", "walls", "agent.radius", "walls.shape", "walls.number"];
        for (i, seed) in (0..1200).enumerate() {
            let options = vary(&[keys[i % 6], keys[i / 6 % 6], "agent.position"]);
            env.reset(seed, &options).expect("a reset");
            let (agent, goal) = (env.agent, env.scene.goal);
            assert!(!env.layout.touches(agent.center, agent.radius), "{options:?}, seed {seed}");
            assert!(!env.layout.touches(goal.center, goal.radius), "{options:?}, seed {seed}");
        }
    }

    #[test]
    fn the_distance_falls_along_the_way() {
        let mut env = PointMaze::new();
        let mut row = Batch::zeros(&Schema::new(env.spec.columns.clone()).expect("a schema"), 1);
        let mut around = 0;
        for seed in 0..200 {
            env.reset(seed, &vary(&["all"])).expect("a reset");
            env.sample_goal(Key::new(seed)).expect("a goal");
            let mut expert = (ENTRY.experts[0].make)();
            let straight = f64::from(distance(env.agent.center, env.scene.goal.center));
            let mut left = env.goal_distance();
            assert!(left >= straight - 1e-6, "seed {seed}: no way is shorter than the straight line");
            around += u32::from(left > straight + 0.01);
            while !env.is_success() {
                env.observe(&mut row.row_mut(0));
                let mut action = [0.0; 2];
                expert.act(row.row(0), &mut action).expect("an action");
                let before = env.agent.center;
                env.step(Action::Continuous(&action.map(|v| v as f32))).expect("a step");
                let walked = f64::from(distance(before, env.agent.center));
                let now = env.goal_distance();
                // The polygons around round corners are a little longer than what one can walk.
                assert!(now < left - walked + 1e-5, "seed {seed}: {left}, {walked} walked, {now} left");
                assert!(walked > 0.0 && left - walked - now < 0.02, "seed {seed}: {left}, {walked} walked, {now} left");
                left = now;
            }
        }
        assert!(around > 50, "{around} ways lead around walls");
        env.aim(env.agent.center);
        assert_eq!(env.goal_distance(), 0.0);
    }
}
