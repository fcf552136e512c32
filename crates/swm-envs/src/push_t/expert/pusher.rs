//! Pushes planned with the world's own physics.
//!
//! A plan is a way around the block to a place beside it, and a push from there: a direction, a strength, and for
//! how many steps. Every place around the block is tried in a copy of the world, and the push that leaves the block
//! nearest to its goal wins. When the block is in place, the agent walks to its own goal.

use super::route::route;
use crate::push_t::physics::{AGENT, BLOCK, Pose, Vec2, World};
use crate::push_t::shapes::Design;
use crate::push_t::{State, TABLE, advance, assemble, place, state_of, turn};
use rand::Rng as _;
use swm_core::policy::Expert;
use swm_core::{Key, Result, Rng, RowRef};

/// Pixels between two places from which a push may start.
const SPACING: f64 = 20.0;
/// Pixels between agent and block where a push starts.
const GAP: f64 = 4.0;
/// Strengths of pushes, and how far their directions lean from the block's normal, in radians.
const STRENGTHS: [f64; 2] = [0.3, 0.8];
const LEANS: [f64; 3] = [0.0, -0.45, 0.45];
/// The longest push, in steps.
const MAX_STEPS: usize = 6;
/// What a radian costs, in pixels.
const RADIAN: f64 = 50.0;
/// What a step of a push costs, and a pixel of the way to it, in pixels.
const STEP_COST: f64 = 0.4;
const WAY_COST: f64 = 0.012;
/// A push should bring the block nearer by this, else one is chosen at random among the better ones.
const PROGRESS: f64 = 0.5;
/// The block is left alone when it is nearer to its goal than this, in pixels and radians.
const IN_PLACE: (f64, f64) = (9.0, 0.2);
/// The agent stays this far from the edge of the table, in pixels.
const MARGIN: f64 = 10.0;
/// A place on the way is reached at this distance, in pixels.
const ARRIVED: f64 = 5.0;
/// After this many steps a plan that has not ended is given up.
const PATIENCE: usize = 40;

/// The expert.
pub struct Pusher {
    /// What the world makes of an action.
    snap: fn([f64; 2]) -> [f64; 2],
    rng: Rng,
    model: Option<Model>,
    plan: Plan,
}

/// What to do next.
#[derive(Default)]
struct Plan {
    /// Places to go to first, the next one last.
    way: Vec<Vec2>,
    push: [f64; 2],
    /// Steps of the push.
    steps: usize,
    /// Steps until the plan is given up.
    patience: usize,
}

/// The world, to try pushes in.
struct Model {
    shapes: [f64; 4],
    designs: [Design; 2],
    /// Where nothing has happened yet.
    fresh: World,
    world: World,
}

impl Pusher {
    /// An expert for a world that turns every action into `snap` of it.
    pub fn new(snap: fn([f64; 2]) -> [f64; 2]) -> Self {
        Self { snap, rng: Key::new(0).rng(), model: None, plan: Plan::default() }
    }
}

impl Expert for Pusher {
    fn begin(&mut self, key: Key) {
        self.rng = key.rng();
        self.plan = Plan::default();
    }

    fn act(&mut self, row: RowRef<'_>, action: &mut [f64]) -> Result<()> {
        let numbers = |column| row.to_f64(column);
        let state = crate::push_t::checked(&numbers("state")?, "state")?;
        let goal = crate::push_t::checked(&numbers("goal_state")?, "goal_state")?;
        let shapes: [f64; 4] = row.get::<f64>("shapes")?.try_into().unwrap_or_default();
        let model = match self.model.take() {
            Some(model) if model.shapes == shapes => model,
            _ => Model::new(shapes),
        };
        let model = self.model.insert(model);
        let agent = Vec2::new(state[0], state[1]);
        while let Some(&next) = self.plan.way.last()
            && (next - agent).length() < ARRIVED
        {
            self.plan.way.pop();
        }
        if (self.plan.way.is_empty() && self.plan.steps == 0) || self.plan.patience == 0 {
            self.plan = model.plan(&state, &goal, self.snap, &mut self.rng);
        }
        self.plan.patience = self.plan.patience.saturating_sub(1);
        let wanted = match self.plan.way.last() {
            Some(&next) => approach(agent, Vec2::new(state[5], state[6]), next),
            None if self.plan.steps > 0 => {
                self.plan.steps -= 1;
                self.plan.push
            }
            None => [0.0; 2],
        };
        action.copy_from_slice(&wanted);
        Ok(())
    }
}

/// The action that brings the agent to a place in one step, as far as actions go.
fn approach(agent: Vec2, velocity: Vec2, to: Vec2) -> [f64; 2] {
    // A critically damped spring of 10 / s after 0.1 s: 1 - 2 / e of the way, and velocity / 10 e of drift.
    let pull = 1.0 - 2.0 * (-1.0f64).exp();
    let drift = velocity * (0.1 * (-1.0f64).exp());
    let wanted = (to - agent - drift) * (1.0 / (100.0 * pull));
    let strength = wanted.x.abs().max(wanted.y.abs()).max(1.0);
    [wanted.x / strength, wanted.y / strength]
}

/// A push that was tried.
struct Try {
    from: Vec2,
    push: [f64; 2],
    steps: usize,
    /// How far the block is from its goal afterwards.
    error: f64,
    /// The same with the price of the way and the push.
    cost: f64,
}

impl Model {
    fn new(shapes: [f64; 4]) -> Self {
        #[allow(clippy::cast_possible_truncation)]
        let designs = [0, 2].map(|i| Design::new(shapes[i] as i64, shapes[i + 1]));
        let fresh = assemble(&designs, [designs[AGENT].body(), designs[BLOCK].body()]);
        Self { shapes, designs, world: fresh.clone(), fresh }
    }

    /// How far the block is from its goal: pixels, and radians, and both in one number.
    fn errors(&self, state: &State, goal: &State) -> (f64, f64, f64) {
        let apart = Vec2::new(state[2] - goal[2], state[3] - goal[3]).length();
        #[allow(clippy::cast_possible_truncation)]
        let turn = turn(self.shapes[2] as i64, state[4], goal[4]);
        (apart, turn, apart + RADIAN * turn)
    }

    /// The rectangles of the block, in the world.
    fn rects(&self, state: &State) -> Vec<[Vec2; 4]> {
        let mut body = self.designs[BLOCK].body();
        body.set_angle(state[4]);
        body.set_position(Vec2::new(state[2], state[3]));
        let pose: Pose = body.pose;
        self.designs[BLOCK].rects.iter().map(|rect| rect.map(|corner| pose.point(corner))).collect()
    }

    fn plan(&mut self, state: &State, goal: &State, snap: fn([f64; 2]) -> [f64; 2], rng: &mut Rng) -> Plan {
        let agent = Vec2::new(state[0], state[1]);
        let rects = self.rects(state);
        let reach = self.designs[AGENT].reach();
        let (apart, turn, error) = self.errors(state, goal);
        if apart < IN_PLACE.0 && turn < IN_PLACE.1 {
            let way = route(&rects, reach, agent, Vec2::new(goal[0], goal[1]));
            return Plan { way, patience: PATIENCE, ..Plan::default() };
        }
        let mut tries: Vec<Try> = vec![];
        for (from, inward) in places(&rects, reach) {
            for (strength, lean) in STRENGTHS.iter().flat_map(|&s| LEANS.map(|lean| (s, lean))) {
                let (sin, cos) = lean.sin_cos();
                let direction = inward * cos + inward.perp() * sin;
                let push = snap([direction.x * strength, direction.y * strength]);
                let tried = self.attempt(state, goal, from, push);
                let cost = tried.cost + WAY_COST * (from - agent).length();
                tries.push(Try { cost, ..tried });
            }
        }
        tries.sort_by(|a, b| a.cost.total_cmp(&b.cost));
        let best = tries.first().is_some_and(|best| best.error < error - PROGRESS);
        let choice = if best { 0 } else { rng.random_range(0..tries.len().div_ceil(4).max(1)) };
        match tries.get(choice) {
            Some(Try { from, push, steps, .. }) => {
                let way = route(&rects, reach, agent, *from);
                Plan { way, push: *push, steps: *steps, patience: PATIENCE }
            }
            // Nowhere to push from: wait for a better idea in the middle of the table.
            None => Plan { way: vec![Vec2::new(TABLE / 2.0, TABLE / 2.0)], patience: PATIENCE, ..Plan::default() },
        }
    }

    /// Pushes from a place in a copy of the world; keeps the best number of steps.
    fn attempt(&mut self, state: &State, goal: &State, from: Vec2, push: [f64; 2]) -> Try {
        let mut start = *state;
        [start[0], start[1], start[5], start[6]] = [from.x, from.y, 0.0, 0.0];
        self.world.copy_from(&self.fresh);
        place(&mut self.world, &start);
        let mut best = Try { from, push, steps: 1, error: f64::INFINITY, cost: f64::INFINITY };
        #[allow(clippy::cast_possible_truncation)]
        let action = push.map(|v| v as f32);
        let mut price = 0.0;
        for steps in 1..=MAX_STEPS {
            price += STEP_COST;
            advance(&mut self.world, action);
            let (_, _, error) = self.errors(&state_of(&self.world), goal);
            if error + price < best.cost {
                best = Try { steps, error, cost: error + price, ..best };
            }
        }
        best
    }
}

/// Places beside the block from which it can be pushed, with the direction into it.
fn places(rects: &[[Vec2; 4]], reach: f64) -> Vec<(Vec2, Vec2)> {
    let mut places = vec![];
    for rect in rects {
        for i in 0..4 {
            let (a, b) = (rect[i], rect[(i + 1) % 4]);
            let outward = (b - a).rperp().normalized();
            #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
            let count = ((b - a).length() / SPACING).ceil().max(1.0) as usize;
            for k in 0..count {
                #[allow(clippy::cast_precision_loss)]
                let on_edge = a.lerp(b, (k as f64 + 0.5) / count as f64);
                let from = on_edge + outward * (reach + GAP);
                let inside = |v: f64| (MARGIN + reach..=TABLE - MARGIN - reach).contains(&v);
                if inside(from.x) && inside(from.y) && super::route::clearance(rects, from) > reach + GAP / 2.0 {
                    places.push((from, -outward));
                }
            }
        }
    }
    places
}
