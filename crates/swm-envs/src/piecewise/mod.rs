#![doc = include_str!("README.md")]

mod arrows;
mod expert;
mod paths;
mod physics;
mod render;

use crate::draw::{Rgb, SoftDisc};
use crate::point_agent::room::{self, GOAL_RADIUS, SIZE, choice, color, position_factor, scalar};
use crate::point_agent::{PointAgentEnv, PointTask, Position, distance64, farthest_goal, position, widen};
use physics::{Dynamics, ZONES};
use render::{ZonesAppearance, ZonesRenderer};
use std::f64::consts::TAU;
use swm_core::{DType, EnvEntry, EnvSpec, Factor, FactorValues, FrameMut, Rng, RowMut, Space, VariationSpace};

/// The registry row of this environment.
pub const ENTRY: EnvEntry = EnvEntry {
    id: Piecewise::ID,
    summary: "walk to the target through zones, each of which drifts in its own direction",
    options: &[],
    make: |_| Ok(Box::new(PointAgentEnv::<Piecewise>::new())),
    experts: expert::EXPERTS,
};

/// The factors with the drift of each zone.
const DRIFT_FACTORS: [&str; ZONES] = ["zones.bias_0", "zones.bias_1", "zones.bias_2", "zones.bias_3"];
/// The factors with the colour of each zone.
const COLOR_FACTORS: [&str; ZONES] = ["zones.color_0", "zones.color_1", "zones.color_2", "zones.color_3"];

/// One room divided into four zones, each with its own drift.
struct Piecewise {
    dynamics: Dynamics,
    agent_color: Rgb,
    appearance: ZonesAppearance,
}

impl PointTask for Piecewise {
    const ID: &'static str = "swm/Piecewise-v0";
    const SIZE: f64 = SIZE;
    const GOAL_FACTOR: &'static str = "target.position";
    const GOAL_TRIES: usize = room::GOAL_TRIES;

    type Renderer = ZonesRenderer;

    fn spec() -> EnvSpec {
        room::spec(Self::ID, 4, ("dynamics", Dynamics::LEN), variation_space())
    }

    fn new(factors: &FactorValues) -> Self {
        let dynamics = Dynamics {
            radius: factors.scalar("agent.radius"),
            speed: factors.scalar("agent.speed"),
            drift: DRIFT_FACTORS.map(|key| factors.get(key)).map(|value| [value[0], value[1]]),
        };
        let is_rendered = |key| factors.integer(key) == 1;
        let appearance = ZonesAppearance {
            background: factors.rgb("background.color"),
            border: factors.rgb("border.color"),
            zones: is_rendered("rendering.render_zones").then(|| COLOR_FACTORS.map(|key| factors.rgb(key))),
            drift: is_rendered("rendering.render_bias_field").then_some(dynamics.drift),
            target: room::target_disc(factors),
        };
        Self { dynamics, agent_color: factors.rgb("agent.color"), appearance }
    }

    fn advance(&self, from: Position, action: [f32; 2]) -> Position {
        self.dynamics.advance(from, action)
    }

    fn is_reached(&self, agent: Position, goal: Position) -> bool {
        room::distance(agent, goal) < GOAL_RADIUS
    }

    fn reward(&self, _reached: bool) -> f64 {
        0.0
    }

    fn observe(&self, agent: Position, goal: Position, row: &mut RowMut<'_>) {
        let observation = [agent[0], agent[1], goal[0], goal[1]];
        room::observe(agent, goal, &observation, &self.dynamics.to_row(), row);
    }

    fn set_goal(&mut self, goal: Position) {
        if let Some(target) = &mut self.appearance.target {
            target.center = goal;
        }
    }

    fn draw(&self, agent: Position, renderer: &mut ZonesRenderer, frame: FrameMut<'_>) {
        let agent = SoftDisc { center: agent, radius: self.dynamics.radius, color: self.agent_color };
        renderer.draw(&self.appearance, &agent, frame);
    }

    fn find_goal(&self, factors: &FactorValues, agent: Position, rng: &mut Rng) -> Option<Position> {
        let [low, high] = self.dynamics.reach();
        let space = Space::uniform_box([2], DType::Float32, low, high);
        let wanted = usize::try_from(factors.integer("task.min_steps")).unwrap_or(0);
        farthest_goal(Self::GOAL_TRIES, wanted, || {
            let mut goal = position(&space.sample(rng));
            let (end, mut steps) = paths::steer_to(&self.dynamics, agent, goal);
            if steps.is_none() {
                // The goal is out of reach. The next candidate is the position at which the drift stops the agent on
                // the way.
                goal = end;
                steps = paths::steer_to(&self.dynamics, agent, goal).1;
            }
            let steps = steps.filter(|&steps| steps > 0)?;
            Some((steps, goal))
        })
    }

    fn goal_distance(&self, agent: Position, goal: Position) -> f64 {
        distance64(widen(agent), widen(goal))
    }
}

/// Returns the variation space, with names, bounds, defaults and order of the reference.
fn variation_space() -> VariationSpace {
    let mut factors = vec![
        color("background.color", [255.0; 3]),
        color("border.color", [0.0; 3]),
        color("agent.color", [255.0, 0.0, 0.0]),
        scalar("agent.radius", 7.0, 14.0, 7.0),
        position_factor("agent.position", [60.0, 112.0]),
        scalar("agent.speed", 1.75, 10.5, 5.0),
        choice("task.min_steps", 100, 15, 25.0),
        color("target.color", [0.0, 255.0, 0.0]),
        scalar("target.radius", 7.0, 14.0, 7.0),
        position_factor("target.position", [164.0, 112.0]),
        choice("rendering.render_bias_field", 2, 0, 0.0),
        choice("rendering.render_target", 2, 0, 0.0),
        choice("rendering.render_zones", 2, 0, 0.0),
    ];
    // By default the zones drift right, down, left and up; their colours are pale red, lime, cyan and violet.
    let pale = [[255.0, 191.0, 191.0], [223.0, 255.0, 191.0], [191.0, 255.0, 255.0], [223.0, 191.0, 255.0]];
    let drift = Space::uniform_box([2], DType::Float32, -4.0, 4.0);
    for (i, key) in (0_u8..).zip(DRIFT_FACTORS) {
        let angle = TAU * f64::from(i) / ZONES as f64;
        let default = [angle.cos(), angle.sin()].map(|v| drift.round(2.0 * v));
        factors.push(Factor::new(key, drift.clone(), default));
    }
    factors.extend(COLOR_FACTORS.into_iter().zip(pale).map(|(key, pale)| color(key, pale)));
    VariationSpace::new(factors, &["agent.position", "target.position"])
}

#[cfg(test)]
mod tests {
    use super::*;
    use swm_core::{Env as _, Key, ResetOptions, VariationRequest};

    #[test]
    fn resets_never_fail_and_sampled_goals_are_reachable() {
        let variation = VariationRequest { variation: Some(vec!["all".to_owned()]), ..VariationRequest::default() };
        let all = ResetOptions { variation, ..ResetOptions::default() };
        let mut env = PointAgentEnv::<Piecewise>::new();
        let mut trapped = vec![];
        for seed in 0..10_000 {
            env.reset(seed, &all).expect("resetting the environment");
            if env.sample_goal(Key::new(seed)).is_err() {
                trapped.push(seed);
                continue;
            }
            assert!(!env.is_success(), "seed {seed}");
            let (_, steps) = paths::steer_to(&env.task.dynamics, env.agent, env.goal);
            assert!(steps.is_some(), "seed {seed}: steering leads to {:?}", env.goal);
        }
        // In the episodes of these two seeds, a drift stronger than the agent holds the agent in a corner.
        assert_eq!(trapped, [7732, 9434]);
    }
}
