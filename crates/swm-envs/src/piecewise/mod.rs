#![doc = include_str!("README.md")]

mod arrows;
mod expert;
mod physics;
mod render;
mod route;

use crate::draw::Disc;
use crate::factors;
use physics::{BORDER, Dynamics, GOAL_RADIUS, Point, SIZE, ZONES, distance};
use render::{Renderer, Scene};
use std::f64::consts::TAU;
use swm_core::{
    Action, ColumnSpec, DType, Env, EnvEntry, EnvSpec, Error, Factor, FactorValues, FrameMut, Key, ResetOptions,
    Result, RowMut, RowRef, Snapshot, Space, Transition, VariationRequest, VariationSpace,
};

/// The registry row.
pub const ENTRY: EnvEntry = EnvEntry {
    id: "swm/Piecewise-v0",
    summary: "walk to the target through zones that each drift their own way",
    options: &[],
    make: |_| Ok(Box::new(Piecewise::new())),
    experts: expert::EXPERTS,
};

/// Samples from which [`Env::sample_goal`] chooses.
const GOAL_TRIES: usize = 256;
/// Names of the zones' factors.
const BIASES: [&str; ZONES] = ["zones.bias_0", "zones.bias_1", "zones.bias_2", "zones.bias_3"];
const COLORS: [&str; ZONES] = ["zones.color_0", "zones.color_1", "zones.color_2", "zones.color_3"];

/// One room in four zones, an agent and a target.
pub struct Piecewise {
    spec: EnvSpec,
    factors: FactorValues,
    dynamics: Dynamics,
    agent: Disc,
    goal: Point,
    scene: Scene,
    renderer: Renderer,
}

impl Piecewise {
    /// The world with every factor at its default.
    pub fn new() -> Self {
        let spec = spec();
        let none = VariationRequest { variation: Some(vec![]), ..VariationRequest::default() };
        let factors = spec.variation_space.resolve(&none, Key::new(0)).expect("defaults are in their spaces");
        let (dynamics, scene) = (dynamics(&factors), scene(&factors));
        let agent = disc(&factors, "agent", point(factors.get("agent.position")));
        let goal = point(factors.get("target.position"));
        Self { spec, factors, dynamics, agent, goal, scene, renderer: Renderer::default() }
    }

    /// Makes the world that of these factors, with agent and target at these places.
    fn arrange(&mut self, factors: FactorValues, agent: Point, goal: Point) {
        self.dynamics = dynamics(&factors);
        self.scene = scene(&factors);
        self.agent = disc(&factors, "agent", agent);
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
}

impl Default for Piecewise {
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
    pub const DYNAMICS: usize = 5;
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
            ColumnSpec::new("observation", DType::Float32, [4]),
            ColumnSpec::new("dynamics", DType::Float32, [Dynamics::LEN]),
        ],
        observation_space: vec![("observation", Space::uniform_box([4], DType::Float32, 0.0, SIZE))],
        variation_space: variation_space(),
        max_episode_steps: 100,
        cameras: vec![],
    }
}

/// Names, bounds, defaults and order are the reference's.
fn variation_space() -> VariationSpace {
    let color = |key, default: [f64; 3]| Factor::new(key, Space::Rgb, default);
    let scalar =
        |key, low, high, default: f64| Factor::new(key, Space::uniform_box([1], DType::Float32, low, high), [default]);
    let place = |key, default: [f64; 2]| {
        Factor::new(key, Space::uniform_box([2], DType::Float32, BORDER, SIZE - BORDER - 1.0), default)
    };
    let choice = |key, n, start, default: f64| Factor::new(key, Space::Discrete { n, start }, [default]);
    let mut factors = vec![
        color("background.color", [255.0; 3]),
        color("border.color", [0.0; 3]),
        color("agent.color", [255.0, 0.0, 0.0]),
        scalar("agent.radius", 7.0, 14.0, 7.0),
        place("agent.position", [60.0, 112.0]),
        scalar("agent.speed", 1.75, 10.5, 5.0),
        choice("task.min_steps", 100, 15, 25.0),
        color("target.color", [0.0, 255.0, 0.0]),
        scalar("target.radius", 7.0, 14.0, 7.0),
        place("target.position", [164.0, 112.0]),
        choice("rendering.render_bias_field", 2, 0, 0.0),
        choice("rendering.render_target", 2, 0, 0.0),
        choice("rendering.render_zones", 2, 0, 0.0),
    ];
    // By default the zones drift right, down, left and up, and wear pale red, lime, cyan and violet.
    let pale = [[255.0, 191.0, 191.0], [223.0, 255.0, 191.0], [191.0, 255.0, 255.0], [223.0, 191.0, 255.0]];
    let drift = Space::uniform_box([2], DType::Float32, -4.0, 4.0);
    for (i, key) in (0_u8..).zip(BIASES) {
        let angle = TAU * f64::from(i) / ZONES as f64;
        let default = [angle.cos(), angle.sin()].map(|v| drift.round(2.0 * v));
        factors.push(Factor::new(key, drift.clone(), default));
    }
    factors.extend(COLORS.into_iter().zip(pale).map(|(key, pale)| color(key, pale)));
    VariationSpace::new(factors, &["agent.position", "target.position"])
}

fn dynamics(factors: &FactorValues) -> Dynamics {
    Dynamics {
        radius: factors.scalar("agent.radius"),
        speed: factors.scalar("agent.speed"),
        drift: BIASES.map(|key| factors.get(key)).map(|value| [value[0], value[1]]),
    }
}

fn scene(factors: &FactorValues) -> Scene {
    let shown = |key| factors.integer(key) == 1;
    Scene {
        background: factors.rgb("background.color"),
        border: factors.rgb("border.color"),
        zones: shown("rendering.render_zones").then(|| COLORS.map(|key| factors.rgb(key))),
        drift: shown("rendering.render_bias_field").then(|| dynamics(factors).drift),
        target: shown("rendering.render_target")
            .then(|| disc(factors, "target", point(factors.get("target.position")))),
    }
}

/// The `agent` or the `target` at a place.
fn disc(factors: &FactorValues, name: &str, center: Point) -> Disc {
    Disc { center, radius: factors.scalar(&format!("{name}.radius")), color: factors.rgb(&format!("{name}.color")) }
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

impl Env for Piecewise {
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
        self.agent.center = self.dynamics.advance(self.agent.center, [action[0], action[1]]);
        Ok(Transition { reward: 0.0, terminated: self.is_success(), truncated: false })
    }

    fn observe(&self, row: &mut RowMut<'_>) {
        let ([x, y], [goal_x, goal_y]) = (self.agent.center, self.goal);
        row.set(columns::STATE, &[x, y]);
        row.set(columns::PROPRIO, &[x, y]);
        row.set(columns::GOAL_STATE, &[goal_x, goal_y]);
        row.set(columns::DISTANCE, &[distance(self.agent.center, self.goal)]);
        row.set(columns::OBSERVATION, &[x, y, goal_x, goal_y]);
        row.set(columns::DYNAMICS, &self.dynamics.to_row());
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
        let [low, high] = self.dynamics.reach();
        let space = Space::uniform_box([2], DType::Float32, low, high);
        let wanted = usize::try_from(self.factors.integer("task.min_steps")).unwrap_or(0);
        let mut longest: Option<(usize, Point)> = None;
        for _ in 0..GOAL_TRIES {
            let mut goal = point(&space.sample(&mut rng));
            let (end, mut steps) = route::walk(&self.dynamics, self.agent.center, goal);
            if steps.is_none() {
                // Out of reach: where the drift holds the agent on its way there may do.
                goal = end;
                steps = route::walk(&self.dynamics, self.agent.center, goal).1;
            }
            let Some(steps) = steps.filter(|&steps| steps > 0) else { continue };
            if longest.is_none_or(|(known, _)| steps > known) {
                longest = Some((steps, goal));
            }
            if steps >= wanted {
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
        let [dx, dy] = [0, 1].map(|i| f64::from(self.agent.center[i]) - f64::from(self.goal[i]));
        dx.hypot(dy)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn all() -> ResetOptions {
        let variation = VariationRequest { variation: Some(vec!["all".to_owned()]), ..VariationRequest::default() };
        ResetOptions { variation, ..ResetOptions::default() }
    }

    #[test]
    fn resets_never_fail_and_goals_are_in_reach() {
        let mut env = Piecewise::new();
        let mut trapped = vec![];
        for seed in 0..10_000 {
            env.reset(seed, &all()).expect("a reset");
            if env.sample_goal(Key::new(seed)).is_err() {
                trapped.push(seed);
                continue;
            }
            assert!(!env.is_success(), "seed {seed}");
            assert!(
                route::walk(&env.dynamics, env.agent.center, env.goal).1.is_some(),
                "seed {seed}: steering leads to {:?}",
                env.goal
            );
        }
        // In these, drift that is stronger than the agent holds it in its corner.
        assert_eq!(trapped, [7732, 9434]);
    }
}
