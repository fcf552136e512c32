//! The world in an expert's head, to try pushes in.

use super::room::Room;
use super::route::Ways;
use crate::push_t::physics::{AGENT, BLOCK, Pose, Vec2, World};
use crate::push_t::shapes::Design;
use crate::push_t::{ACTION_SCALE, State, advance, assemble, place, state_of, turn};
use rand::Rng as _;
use std::f64::consts::{PI, TAU};
use swm_core::Rng;

/// Pixels between agent and block where a push starts.
const GAP: f64 = 4.0;
/// Corners of the polygon that stands for a round agent.
const ROUND: usize = 16;
/// What a radian between the block and its goal counts, in units of the block's radius of gyration. Pushing it at that
/// radius turns it by a radian for every two radii pushed.
const RADIAN: f64 = 1.6;
/// Steps that any push costs on top, so that a few long ones are preferred to many short ones.
const PAUSE: f64 = 30.0;
/// A push that does not bring the block nearer for so many steps is over.
const HOPE: usize = 3;

/// Where everything is.
pub struct Situation {
    pub state: State,
    /// The agent's angle, which `state` lacks.
    pub angle: f64,
}

impl Situation {
    /// The agent's place.
    pub fn agent(&self) -> Vec2 {
        Vec2::new(self.state[0], self.state[1])
    }
}

/// A push that was tried.
pub struct Push {
    /// Places to pass on the way there, the next one last.
    pub way: Vec<Vec2>,
    pub action: [f64; 2],
    pub steps: usize,
    /// How far the block is from its goal afterwards, in pixels.
    pub error: f64,
    /// Steps of the way and the push.
    pub time: f64,
    /// How much nearer the block gets in a step.
    pub rate: f64,
}

/// Which pushes are tried.
pub struct Choices<'a> {
    /// Pixels between two places from which they start.
    pub spacing: f64,
    /// How far they lean from the direction into the block, in radians.
    pub leans: &'a [f64],
    /// Shares of the full strength.
    pub strengths: &'a [f64],
}

/// The world and what is known of how its agent moves.
pub struct Model {
    /// Agent shape and scale, block shape and scale.
    pub shapes: [f64; 4],
    /// What the world makes of an action.
    snap: fn([f64; 2]) -> [f64; 2],
    designs: [Design; 2],
    /// Where nothing has happened yet.
    fresh: World,
    world: World,
    /// Pixels that an action of 1 brings in a step.
    pace: f64,
    /// Seconds for which the agent keeps its velocity.
    drift: f64,
    /// What a radian counts, in pixels.
    radian: f64,
    /// The longest push, in steps.
    pub max_steps: usize,
}

impl Model {
    /// The world of these shapes.
    pub fn new(shapes: [f64; 4], snap: fn([f64; 2]) -> [f64; 2]) -> Self {
        #[allow(clippy::cast_possible_truncation)]
        let designs = [0, 2].map(|i| Design::new(shapes[i] as i64, shapes[i + 1]));
        let bodies = [designs[AGENT].body(), designs[BLOCK].body()];
        let gyration = bodies[BLOCK].inverse_inertia.sqrt().recip();
        let e = (-1.0f64).exp();
        // A round agent is a critically damped spring of 10 / s for 0.1 s: it gets 1 - 2 / e of the way, and velocity / 10 e
        // further. Others lose their velocity in every physics step: each takes them a hundredth of what is left.
        let (pull, drift, max_steps) =
            if designs[AGENT].is_circle() { (1.0 - 2.0 * e, 0.1 * e, 6) } else { (1.0 - 0.99f64.powi(10), 0.0, 24) };
        let fresh = assemble(&designs, bodies);
        let pace = pull * f64::from(ACTION_SCALE);
        Self { shapes, snap, designs, world: fresh.clone(), fresh, pace, drift, radian: RADIAN * gyration, max_steps }
    }

    /// The action that brings the agent to a place in one step, as far as actions go.
    pub fn approach(&self, now: &Situation, to: Vec2) -> [f64; 2] {
        let drift = Vec2::new(now.state[5], now.state[6]) * self.drift;
        let wanted = (to - now.agent() - drift) * (1.0 / self.pace);
        let strength = wanted.x.abs().max(wanted.y.abs()).max(1.0);
        [wanted.x / strength, wanted.y / strength]
    }

    /// How far the block is from its goal: pixels of its origin, and radians.
    pub fn apart(&self, state: &State, goal: &State) -> (f64, f64) {
        #[allow(clippy::cast_possible_truncation)]
        let turn = turn(self.shapes[2] as i64, state[4], goal[4]);
        (Vec2::new(state[2] - goal[2], state[3] - goal[3]).length(), turn)
    }

    /// Both in one number of pixels, those of the centre of gravity: it is what turning leaves in place.
    pub fn error(&self, state: &State, goal: &State) -> f64 {
        let centre =
            |state: &State| Pose::new(Vec2::new(state[2], state[3]), state[4], -self.designs[BLOCK].cog).origin;
        (centre(state) - centre(goal)).length() + self.radian * self.apart(state, goal).1
    }

    /// The table as the agent sees it.
    pub fn room(&self, now: &Situation) -> Room {
        let [agent, block] = &self.designs;
        let mut body = block.body();
        body.set_angle(now.state[4]);
        body.set_position(Vec2::new(now.state[2], now.state[3]));
        let block: Vec<[Vec2; 4]> = block.rects.iter().map(|rect| rect.map(|corner| body.pose.point(corner))).collect();
        if !agent.is_circle() {
            let pose = Pose::new(Vec2::ZERO, now.angle, Vec2::ZERO);
            let parts: Vec<_> = agent.rects.iter().map(|rect| rect.map(|corner| pose.point(corner)).to_vec()).collect();
            return Room::new(&parts, &block);
        }
        #[allow(clippy::cast_precision_loss)]
        let corner = |i: usize| {
            let (sin, cos) = (i as f64 * TAU / ROUND as f64).sin_cos();
            Vec2::new(cos, sin) * (agent.radius / (PI / ROUND as f64).cos())
        };
        Room::new(&[(0..ROUND).map(corner).collect()], &block)
    }

    /// The push that brings the block nearer fastest, if there is a place to push from.
    pub fn best_push(&mut self, now: &Situation, goal: &State, choices: &Choices<'_>) -> Option<Push> {
        let room = self.room(now);
        let ways = Ways::from(&room, now.agent());
        let before = self.error(&now.state, goal);
        let mut best: Option<(Push, Vec2, usize)> = None;
        for (from, inward) in room.beside(GAP, choices.spacing) {
            let Some((length, node)) = ways.to(from) else { continue };
            for (&strength, &lean) in choices.strengths.iter().flat_map(|s| choices.leans.iter().map(move |l| (s, l))) {
                let action = self.action(inward, lean, strength);
                let push = self.attempt(now, goal, from, action, before, length / self.pace);
                if best.as_ref().is_none_or(|(best, ..)| push.rate > best.rate) {
                    best = Some((push, from, node));
                }
            }
        }
        best.map(|(push, from, node)| Push { way: ways.places(from, node), ..push })
    }

    /// The best of some random pushes that do not help by themselves, by what the next push achieves. Its error and rate
    /// are those after both.
    pub fn best_detour(
        &mut self,
        now: &Situation,
        goal: &State,
        samples: usize,
        choices: &Choices<'_>,
        rng: &mut Rng,
    ) -> Option<Push> {
        let room = self.room(now);
        let ways = Ways::from(&room, now.agent());
        let before = self.error(&now.state, goal);
        let mut places = room.beside(GAP, choices.spacing);
        places.retain(|&(from, _)| ways.to(from).is_some());
        let mut best: Option<Push> = None;
        for _ in 0..if places.is_empty() { 0 } else { samples } {
            let (from, inward) = places[rng.random_range(0..places.len())];
            let action = self.action(inward, rng.random_range(-0.8..0.8), 1.0);
            let steps = rng.random_range(2..=self.max_steps);
            self.set(now, from);
            (0..steps).for_each(|_| self.advance(action));
            let then = Situation { state: state_of(&self.world), angle: self.world.bodies[AGENT].angle };
            let (Some((length, node)), Some(next)) = (ways.to(from), self.best_push(&then, goal, choices)) else {
                continue;
            };
            #[allow(clippy::cast_precision_loss)]
            let time = length / self.pace + steps as f64 + next.time;
            let rate = (before - next.error) / (time + PAUSE);
            if best.as_ref().is_none_or(|best| rate > best.rate) {
                best = Some(Push { way: ways.places(from, node), action, steps, error: next.error, time, rate });
            }
        }
        best
    }

    /// The action of a push.
    fn action(&self, inward: Vec2, lean: f64, strength: f64) -> [f64; 2] {
        let (sin, cos) = lean.sin_cos();
        let direction = inward * cos + inward.perp() * sin;
        let scale = strength / direction.x.abs().max(direction.y.abs());
        (self.snap)([direction.x * scale, direction.y * scale])
    }

    /// Puts the world in a situation, but for the agent, which is elsewhere.
    fn set(&mut self, now: &Situation, from: Vec2) {
        let mut start = now.state;
        [start[0], start[1], start[5], start[6]] = [from.x, from.y, 0.0, 0.0];
        self.world.copy_from(&self.fresh);
        if self.world.bodies[AGENT].is_dynamic() {
            self.world.bodies[AGENT].set_angle(now.angle);
        }
        place(&mut self.world, &start);
    }

    #[allow(clippy::cast_possible_truncation)]
    fn advance(&mut self, action: [f64; 2]) {
        advance(&mut self.world, action.map(|v| v as f32));
    }

    /// Pushes from a place; keeps the best number of steps. `before` is the error now, `way` are the steps it takes to
    /// get there.
    fn attempt(&mut self, now: &Situation, goal: &State, from: Vec2, action: [f64; 2], before: f64, way: f64) -> Push {
        self.set(now, from);
        let mut best = Push { way: vec![], action, steps: 1, error: before, time: way, rate: f64::NEG_INFINITY };
        for steps in 1..=self.max_steps {
            self.advance(action);
            let error = self.error(&state_of(&self.world), goal);
            #[allow(clippy::cast_precision_loss)]
            let time = way + steps as f64;
            let rate = (before - error) / (time + PAUSE);
            if rate > best.rate {
                best = Push { steps, error, time, rate, ..best };
            } else if steps > best.steps + HOPE {
                break;
            }
        }
        best
    }
}
