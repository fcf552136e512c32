//! [`PointAgentEnv`]: the [`Env`] of any [`PointTask`]. It holds the agent and goal positions, and implements resets,
//! snapshots and goals once for all point-agent environments.

use super::position::{Position, position};
use super::task::PointTask;
use swm_core::columns::{GOAL_STATE, STATE};
use swm_core::factors::{from_row, parse_snapshot, snapshot, wrong_snapshot};
use swm_core::{
    Action, DType, Env, EnvSpec, Error, FactorValues, FrameMut, Key, ResetOptions, Result, RowMut, RowRef, Snapshot,
    Space, Transition, VariationRequest,
};

/// A point-agent environment: a task, an agent and a goal.
pub struct PointAgentEnv<T: PointTask> {
    pub(crate) spec: EnvSpec,
    factors: FactorValues,
    pub(crate) task: T,
    pub(crate) agent: Position,
    pub(crate) goal: Position,
    renderer: T::Renderer,
}

impl<T: PointTask> PointAgentEnv<T> {
    /// Makes the environment with every factor at its default.
    pub fn new() -> Self {
        let spec = T::spec();
        let defaults = VariationRequest { variation: Some(vec![]), ..VariationRequest::default() };
        let factors = spec.variation_space.resolve(&defaults, Key::new(0)).expect("defaults are in their spaces");
        let (agent, goal) = (position(factors.get("agent.position")), position(factors.get(T::GOAL_FACTOR)));
        Self { task: T::new(&factors), spec, factors, agent, goal, renderer: T::Renderer::default() }
    }

    /// Starts an episode with these factors and positions.
    fn begin(&mut self, factors: FactorValues, agent: Position, goal: Position) {
        self.task.set_factors(&factors);
        self.factors = factors;
        self.agent = agent;
        self.set_goal(goal);
    }

    /// Moves the goal.
    pub(crate) fn set_goal(&mut self, goal: Position) {
        self.goal = goal;
        self.task.set_goal(goal);
    }
}

/// Checks a position that a caller gave, in the layout of the `state` column.
fn checked<T: PointTask>(what: &str, value: &[f64]) -> Result<Position> {
    Space::uniform_box([2], DType::Float32, 0.0, T::SIZE).check(what, value)?;
    Ok(position(value))
}

/// Reads the positions of agent and goal from the end of a snapshot.
fn read_positions(id: &str, bytes: &[u8]) -> Result<[Position; 2]> {
    match bytes.as_chunks() {
        (&[ax, ay, gx, gy], []) => Ok([[ax, ay], [gx, gy]].map(|position| position.map(f32::from_le_bytes))),
        _ => Err(wrong_snapshot(id, format!("{} bytes of positions", bytes.len()))),
    }
}

impl<T: PointTask> Env for PointAgentEnv<T> {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn reset(&mut self, seed: u64, options: &ResetOptions) -> Result<()> {
        let factors = T::resolve_factors(&self.spec.variation_space, &options.variation, seed)?;
        let start = |what, given: &Option<Vec<f64>>, factor| match given {
            Some(value) => checked::<T>(what, value),
            None => Ok(position(factors.get(factor))),
        };
        let agent = start(STATE, &options.state, "agent.position")?;
        let goal = start(GOAL_STATE, &options.goal_state, T::GOAL_FACTOR)?;
        self.begin(factors, agent, goal);
        Ok(())
    }

    fn step(&mut self, action: Action<'_>) -> Result<Transition> {
        let action = action.continuous(2)?;
        self.agent = self.task.advance(self.agent, [action[0], action[1]]);
        let terminated = self.is_success();
        Ok(Transition { reward: self.task.reward(terminated), terminated, truncated: false })
    }

    fn observe(&self, row: &mut RowMut<'_>) {
        self.task.observe(self.agent, self.goal, row);
    }

    fn render(&mut self, frame: FrameMut<'_>) -> Result<()> {
        self.task.draw(self.agent, &mut self.renderer, frame);
        Ok(())
    }

    fn render_goal(&mut self, frame: FrameMut<'_>) -> Result<()> {
        self.task.draw(self.goal, &mut self.renderer, frame);
        Ok(())
    }

    fn factors(&self) -> &FactorValues {
        &self.factors
    }

    fn snapshot(&self) -> Snapshot {
        let positions = self.agent.into_iter().chain(self.goal);
        snapshot(T::ID, &self.factors, positions.flat_map(f32::to_le_bytes))
    }

    fn restore(&mut self, snapshot: &Snapshot) -> Result<()> {
        let (factors, bytes) = parse_snapshot(T::ID, &self.spec.variation_space, &self.factors, snapshot)?;
        let [agent, goal] = read_positions(T::ID, bytes)?;
        match factors {
            Some(factors) => self.begin(factors, agent, goal),
            None => {
                self.agent = agent;
                self.set_goal(goal);
            }
        }
        Ok(())
    }

    fn restore_from(&mut self, start: RowRef<'_>, goal: RowRef<'_>) -> Result<()> {
        let agent = checked::<T>(STATE, &start.to_f64(STATE)?)?;
        let goal = checked::<T>("goal state", &goal.to_f64(STATE)?)?;
        let factors = from_row(&self.spec.variation_space, &self.factors, start)?;
        self.begin(factors, agent, goal);
        Ok(())
    }

    fn sample_goal(&mut self, key: Key) -> Result<()> {
        let Some(goal) = self.task.find_goal(&self.factors, self.agent, &mut key.rng()) else {
            return Err(Error::Unsatisfiable {
                factor: "goal".to_owned(),
                constraint: "reachable and not reached already".to_owned(),
                tries: T::GOAL_TRIES,
            });
        };
        self.set_goal(goal);
        Ok(())
    }

    fn is_success(&self) -> bool {
        self.task.is_reached(self.agent, self.goal)
    }

    fn goal_distance(&self) -> f64 {
        self.task.goal_distance(self.agent, self.goal)
    }
}
