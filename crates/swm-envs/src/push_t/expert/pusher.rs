//! Pushes planned with the world's own physics.
//!
//! A plan is a way around the block to a place beside it, and a push from there: a direction, a strength, and for
//! how many steps. Every place around the block is tried in a copy of the world, and the push that brings the block
//! nearer to its goal fastest wins. Where none does, a push is looked for that makes another one possible. When the block
//! is in place, the agent walks to its own goal.

use super::model::{Choices, Model, Push, Situation};
use super::route::Ways;
use crate::push_t::physics::Vec2;
use crate::push_t::{State, TABLE, checked};
use swm_core::policy::Expert;
use swm_core::{Key, Result, Rng, RowRef};

/// The pushes tried first, and the coarser ones tried after each of some random pushes.
const FINE: Choices<'_> = Choices { spacing: 20.0, leans: &[0.0, -0.45, 0.45], strengths: &[0.3, 1.0] };
const COARSE: Choices<'_> = Choices { spacing: 40.0, leans: &[0.0], strengths: &[1.0] };
/// How many random pushes.
const DETOURS: usize = 40;
/// A push should bring the block nearer by this many pixels, and by this many in a step.
const PROGRESS: f64 = 0.5;
const PACE: f64 = 0.1;
/// The block is left alone when it is nearer to its goal than this, in pixels and radians.
const IN_PLACE: (f64, f64) = (12.0, 0.28);
/// A place on the way is passed at the first distance, in pixels; a push begins at the second.
const PASSED: f64 = 5.0;
const ARRIVED: f64 = 2.0;
/// After this many steps a plan that has not ended is given up.
const PATIENCE: usize = 60;

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
    /// The action of the push, and how many steps of it are left.
    push: [f64; 2],
    steps: usize,
    /// Steps until the plan is given up.
    patience: usize,
}

impl From<Push> for Plan {
    fn from(push: Push) -> Self {
        Self { way: push.way, push: push.action, steps: push.steps, patience: PATIENCE }
    }
}

impl Plan {
    fn walk(way: Vec<Vec2>) -> Self {
        Self { way, patience: PATIENCE, ..Self::default() }
    }

    /// Forgets the places of the way that are reached.
    fn pass(&mut self, agent: Vec2) {
        while let Some(&next) = self.way.last() {
            let near = if self.way.len() == 1 && self.steps > 0 { ARRIVED } else { PASSED };
            if (next - agent).length() >= near {
                break;
            }
            self.way.pop();
        }
    }

    fn is_over(&self) -> bool {
        (self.way.is_empty() && self.steps == 0) || self.patience == 0
    }
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
        let state = checked(row.get::<f64>("state")?, "state")?;
        let goal = checked(row.get::<f64>("goal_state")?, "goal_state")?;
        let shapes: [f64; 4] = row.get::<f64>("shapes")?.try_into().unwrap_or_default();
        let now = Situation { state, angle: row.get::<f64>("agent_pose")?[2] };
        let known = self.model.take().filter(|model| model.shapes == shapes);
        let model = self.model.insert(known.unwrap_or_else(|| Model::new(shapes, self.snap)));
        self.plan.pass(now.agent());
        if self.plan.is_over() {
            self.plan = plan(model, &now, &goal, &mut self.rng);
            self.plan.pass(now.agent());
        }
        self.plan.patience = self.plan.patience.saturating_sub(1);
        let wanted = match self.plan.way.last() {
            Some(&next) => model.approach(&now, next),
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

/// What to do now.
fn plan(model: &mut Model, now: &Situation, goal: &State, rng: &mut Rng) -> Plan {
    let (apart, turn) = model.apart(&now.state, goal);
    if apart < IN_PLACE.0 && turn < IN_PLACE.1 {
        let room = model.room(now);
        let ways = Ways::from(&room, now.agent());
        let home = Vec2::new(goal[0], goal[1]);
        return Plan::walk(ways.to(home).map_or_else(|| vec![home], |(_, node)| ways.places(home, node)));
    }
    let wanted = model.error(&now.state, goal) - PROGRESS;
    let good = |push: &Push| push.error < wanted && push.rate > PACE;
    if let Some(push) = model.best_push(now, goal, &FINE).filter(good) {
        return push.into();
    }
    match model.best_detour(now, goal, DETOURS, &COARSE, rng) {
        Some(push) => push.into(),
        // Nowhere to push from: perhaps from the middle of the table.
        None => Plan::walk(vec![Vec2::new(TABLE / 2.0, TABLE / 2.0)]),
    }
}
