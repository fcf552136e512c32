#![doc = include_str!("README.md")]

mod expert;
mod factors;
mod paths;
mod physics;
mod render;

use crate::point_agent::{PointAgentEnv, PointTask, Position, distance64, farthest_goal, position, widen};
use factors::{disc, fits, layout, variation_space};
use paths::{ShortestPaths, VisibilityGraph};
use physics::{Layout, MAX_ACTION, SIZE, distance};
use render::{Disc, MazeAppearance, MazeRenderer};
use std::cell::OnceCell;
use swm_core::columns::{GOAL_STATE, STATE};
use swm_core::{
    ColumnSpec, DType, EnvEntry, EnvSpec, Error, FactorValues, FrameMut, Key, Result, Rng, RowMut, Space,
    VariationRequest, VariationSpace,
};

/// The registry row of this environment.
pub const ENTRY: EnvEntry = EnvEntry {
    id: PointMaze::ID,
    summary: "walk around rectangular walls to the goal",
    options: &[],
    make: |_| Ok(Box::new(PointAgentEnv::<PointMaze>::new())),
    experts: expert::EXPERTS,
};

/// Goal candidates per clearance that [`PointTask::find_goal`] tries.
const TRIES_PER_CLEARANCE: usize = 4096;
/// Desired length of the path to a sampled goal, in steps at full speed.
const GOAL_STEPS: f64 = 10.0;
/// The maximal number of times that a reset draws the factors.
const RESOLVE_TRIES: usize = 1000;

/// Indices of the columns of [`PointTask::spec`].
mod index {
    pub const STATE: usize = 0;
    pub const GOAL_STATE: usize = 1;
    pub const OBSERVATION: usize = 2;
    pub const LAYOUT: usize = 3;
}

/// A square maze with rectangular walls.
struct PointMaze {
    layout: Layout,
    appearance: MazeAppearance,
    /// The agent's disc, of which only radius and colour are used.
    agent: Disc,
    /// The visibility graph of the walls, built at the first use.
    graph: OnceCell<VisibilityGraph>,
    /// The shortest paths to the goal, found at the first use.
    to_goal: OnceCell<ShortestPaths>,
}

impl PointMaze {
    fn graph(&self) -> &VisibilityGraph {
        self.graph.get_or_init(|| VisibilityGraph::new(&self.layout))
    }
}

impl PointTask for PointMaze {
    const ID: &'static str = "swm/SimplePointMaze-v0";
    const SIZE: f64 = SIZE as f64;
    const GOAL_FACTOR: &'static str = "goal.position";
    const GOAL_TRIES: usize = 2 * TRIES_PER_CLEARANCE;

    type Renderer = MazeRenderer;

    fn spec() -> EnvSpec {
        let limit = f64::from(MAX_ACTION);
        let column = |name: &str, len: usize| ColumnSpec::new(name, DType::Float32, [len]);
        EnvSpec {
            id: Self::ID.to_owned(),
            action_space: Space::uniform_box([2], DType::Float32, -limit, limit),
            columns: vec![
                column(STATE, 2),
                column(GOAL_STATE, 2),
                column("observation", 2),
                column("layout", Layout::LEN),
            ],
            observation_space: vec![("observation", Space::uniform_box([2], DType::Float32, 0.0, Self::SIZE))],
            variation_space: variation_space(),
            max_episode_steps: 100,
            cameras: vec![],
            angles: vec![],
        }
    }

    fn new(factors: &FactorValues) -> Self {
        let layout = layout(factors);
        Self {
            layout,
            appearance: MazeAppearance::new(factors, layout),
            agent: disc(factors, "agent"),
            graph: OnceCell::new(),
            to_goal: OnceCell::new(),
        }
    }

    /// Keeps the cached visibility graph and paths if the layout is unchanged.
    fn set_factors(&mut self, factors: &FactorValues) {
        let (layout, goal) = (layout(factors), self.appearance.goal.center);
        if layout != self.layout {
            self.graph.take();
            self.to_goal.take();
        }
        self.layout = layout;
        self.appearance = MazeAppearance::new(factors, layout);
        self.appearance.goal.center = goal;
        self.agent = disc(factors, "agent");
    }

    fn resolve_factors(space: &VariationSpace, request: &VariationRequest, seed: u64) -> Result<FactorValues> {
        // A factor sampled after a position, such as a radius, may make the disc touch a wall. All factors are then
        // drawn again.
        let key = |tried: u64| if tried == 0 { Key::new(seed) } else { Key::new(seed).with("another world").at(tried) };
        let mut draws = (0..RESOLVE_TRIES as u64).map(|tried| space.resolve(request, key(tried)));
        let fitting =
            draws.find(|draw| draw.as_ref().map_or(true, |values| fits(values, "agent") && fits(values, "goal")));
        fitting.unwrap_or_else(|| {
            Err(Error::Unsatisfiable {
                factor: "walls.positions".to_owned(),
                constraint: "neither agent nor goal touches a wall".to_owned(),
                tries: RESOLVE_TRIES,
            })
        })
    }

    fn advance(&self, from: Position, action: [f32; 2]) -> Position {
        self.layout.advance(from, action)
    }

    fn is_reached(&self, agent: Position, goal: Position) -> bool {
        distance(agent, goal) < self.appearance.goal.radius
    }

    fn reward(&self, reached: bool) -> f64 {
        if reached { 1.0 } else { -0.01 }
    }

    fn observe(&self, agent: Position, goal: Position, row: &mut RowMut<'_>) {
        row.set(index::STATE, &agent);
        row.set(index::GOAL_STATE, &goal);
        row.set(index::OBSERVATION, &agent);
        row.set(index::LAYOUT, &self.layout.to_row());
    }

    fn set_goal(&mut self, goal: Position) {
        if self.appearance.goal.center != goal {
            self.to_goal.take();
        }
        self.appearance.goal.center = goal;
    }

    fn draw(&self, agent: Position, renderer: &mut MazeRenderer, frame: FrameMut<'_>) {
        renderer.draw(&self.appearance, &Disc { center: agent, ..self.agent }, frame);
    }

    fn find_goal(&self, _factors: &FactorValues, agent: Position, rng: &mut Rng) -> Option<Position> {
        let space = Space::uniform_box([2], DType::Float32, 0.0, Self::SIZE);
        let wanted = GOAL_STEPS * f64::from(MAX_ACTION * self.layout.speed);
        // A path has the same length in both directions, so the paths to the agent give the lengths for all candidates.
        let graph = self.graph();
        let paths = graph.shortest_paths(widen(agent));
        // As at a reset, the goal disc must not touch a wall. If no such position is found, positions at which only the
        // agent fits are accepted.
        [self.layout.radius.max(self.appearance.goal.radius), self.layout.radius].into_iter().find_map(|clearance| {
            farthest_goal(TRIES_PER_CLEARANCE, wanted, || {
                let goal = position(&space.sample(rng));
                if self.layout.touches(goal, clearance) || self.is_reached(agent, goal) {
                    return None;
                }
                let (_, length) = graph.next(widen(goal), &paths)?;
                Some((length, goal))
            })
        })
    }

    fn goal_distance(&self, agent: Position, goal: Position) -> f64 {
        let (from, to) = (widen(agent), widen(goal));
        let paths = self.to_goal.get_or_init(|| self.graph().shortest_paths(to));
        // Without a path to the goal, the length of the straight line is used.
        self.graph().next(from, paths).map_or_else(|| distance64(from, to), |(_, length)| length)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use swm_core::{Action, Batch, Env as _, ResetOptions, Schema};

    fn vary(keys: &[&str]) -> ResetOptions {
        let variation = Some(keys.iter().map(|&key| key.to_owned()).collect());
        ResetOptions {
            variation: VariationRequest { variation, ..VariationRequest::default() },
            ..ResetOptions::default()
        }
    }

    #[test]
    fn resets_and_goal_sampling_succeed_for_10000_seeds() {
        let mut env = PointAgentEnv::<PointMaze>::new();
        for seed in 0..10_000 {
            env.reset(seed, &vary(&["all"])).expect("resetting the environment");
            assert!(!env.task.layout.touches(env.agent, env.task.layout.radius), "seed {seed}");
            env.sample_goal(Key::new(seed)).expect("sampling a goal");
            assert!(!env.is_success(), "seed {seed}");
        }
    }

    #[test]
    fn agent_and_goal_touch_no_wall_for_any_factors() {
        let mut env = PointAgentEnv::<PointMaze>::new();
        let keys = ["agent", "goal", "walls", "agent.radius", "walls.shape", "walls.number"];
        for (i, seed) in (0..1200).enumerate() {
            let options = vary(&[keys[i % 6], keys[i / 6 % 6], "agent.position"]);
            env.reset(seed, &options).expect("resetting the environment");
            let (layout, goal_radius) = (&env.task.layout, env.task.appearance.goal.radius);
            assert!(!layout.touches(env.agent, layout.radius), "{options:?}, seed {seed}");
            assert!(!layout.touches(env.goal, goal_radius), "{options:?}, seed {seed}");
        }
    }

    #[test]
    fn goal_distance_decreases_along_the_expert_path() {
        let mut env = PointAgentEnv::<PointMaze>::new();
        let mut row = Batch::zeros(&Schema::new(env.spec.columns.clone()).expect("creating the schema"), 1);
        let mut detours = 0;
        for seed in 0..200 {
            env.reset(seed, &vary(&["all"])).expect("resetting the environment");
            env.sample_goal(Key::new(seed)).expect("sampling a goal");
            let mut expert = (ENTRY.experts[0].make)();
            let straight = f64::from(distance(env.agent, env.goal));
            let mut remaining = env.goal_distance();
            assert!(remaining >= straight - 1e-6, "seed {seed}: no path is shorter than the straight line");
            detours += u32::from(remaining > straight + 0.01);
            while !env.is_success() {
                env.observe(&mut row.row_mut(0));
                let mut action = [0.0; 2];
                expert.act(row.row(0), &mut action).expect("choosing the expert's action");
                let before = env.agent;
                env.step(Action::Continuous(&action.map(|v| v as f32))).expect("stepping the environment");
                let walked = f64::from(distance(before, env.agent));
                let now = env.goal_distance();
                // Paths along the polygons around round corners are a little longer than the agent's shortest path.
                assert!(now < remaining - walked + 1e-5, "seed {seed}: from {remaining} to {now} by walking {walked}");
                assert!(
                    walked > 0.0 && remaining - walked - now < 0.02,
                    "seed {seed}: from {remaining} to {now} by walking {walked}"
                );
                remaining = now;
            }
        }
        assert!(detours > 50, "{detours} paths lead around walls");
        env.set_goal(env.agent);
        assert_eq!(env.goal_distance(), 0.0);
    }
}
