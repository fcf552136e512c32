//! [`ClassicEnv`]: the [`Env`] of any [`ControlTask`].

use super::factors::{color_swaps, physics, variation_space};
use super::frame::FrameRenderer;
use super::task::ControlTask;
use rand::Rng as _;
use rand::seq::IndexedRandom as _;
use swm_core::columns::{GOAL_STATE, STATE};
use swm_core::factors::{from_row, parse_snapshot, snapshot, wrong_snapshot};
use swm_core::{
    Action, ColumnSpec, DType, Env, EnvSpec, Error, FactorValues, FrameMut, Key, ResetOptions, Result, Rng, RowMut,
    RowRef, Snapshot, Space, Transition, VariationRequest,
};

/// The maximal number of rollouts in which [`Env::sample_goal`] searches for a goal.
const GOAL_TRIES: u64 = 16;
/// Fraction of random actions in the expert's rollouts. Without them, all rollouts from one state would be equal, and
/// sampled goals would come from a single trajectory.
const RANDOM_FRACTION: f64 = 0.02;
/// The maximal number of steps of a rollout.
const GOAL_STEPS: usize = 200;
/// The maximal number of values in a `state` column.
const MAX_STATE_LEN: usize = 8;

/// Indices in [`EnvSpec::columns`].
mod index {
    pub const STATE: usize = 0;
    pub const GOAL_STATE: usize = 1;
    pub const PHYSICS: usize = 2;
}

/// A classic-control environment: a task, its state and its goal.
pub struct ClassicEnv<T: ControlTask> {
    spec: EnvSpec,
    factors: FactorValues,
    /// The `physics` column: the values of [`ControlTask::PHYSICS_FACTORS`].
    physics: Vec<f32>,
    task: T,
    state: T::State,
    goal: T::State,
    /// Created when the first frame is drawn.
    renderer: Option<FrameRenderer>,
    /// True while the renderer has the background and colours of this episode.
    is_renderer_current: bool,
}

/// The bounds of a `state` column, rounded to single precision as in the reference.
fn observation_space<T: ControlTask>() -> Space {
    let single = |bound: f64| f64::from(bound as f32);
    let (low, high) = T::STATE_BOUNDS.iter().map(|&(low, high)| (single(low), single(high))).unzip();
    Space::Box { shape: vec![T::STATE_BOUNDS.len()], dtype: DType::Float32, low, high }
}

impl<T: ControlTask> ClassicEnv<T> {
    /// Makes the environment with every factor at its default.
    pub fn new() -> Self {
        let state_len = T::STATE_BOUNDS.len();
        let spec = EnvSpec {
            id: T::ID.to_owned(),
            action_space: T::action_space(),
            columns: vec![
                ColumnSpec::new(STATE, DType::Float32, [state_len]),
                ColumnSpec::new(GOAL_STATE, DType::Float32, [state_len]),
                ColumnSpec::new("physics", DType::Float32, [T::PHYSICS_FACTORS.len()]),
            ],
            observation_space: vec![(STATE, observation_space::<T>())],
            variation_space: variation_space::<T>(),
            max_episode_steps: T::MAX_EPISODE_STEPS,
            cameras: vec![],
            angles: vec![],
        };
        let defaults = VariationRequest { variation: Some(vec![]), ..VariationRequest::default() };
        let factors = spec.variation_space.resolve(&defaults, Key::new(0)).expect("defaults are in their spaces");
        let physics = physics::<T>(&factors);
        let task = T::new(&physics);
        let mut rng = Key::new(0).rng();
        let (state, goal) = (T::sample_start(&mut rng), T::sample_task_goal(&mut rng));
        Self { spec, factors, physics, task, state, goal, renderer: None, is_renderer_current: false }
    }

    /// Starts an episode with these factors, state and goal.
    fn begin(&mut self, factors: FactorValues, state: T::State, goal: T::State) {
        // The renderer's background stays valid if the factors equal those of the previous episode.
        self.is_renderer_current &= factors.iter().eq(self.factors.iter());
        self.physics = physics::<T>(&factors);
        self.task = T::new(&self.physics);
        (self.factors, self.state, self.goal) = (factors, state, goal);
    }

    /// Draws a state into a frame.
    fn draw(&mut self, state: T::State, frame: FrameMut<'_>) {
        let renderer = self.renderer.get_or_insert_with(|| FrameRenderer::new(T::FRAME_SIZE));
        if !self.is_renderer_current {
            renderer.begin_episode(|surface| self.task.draw_background(surface), &color_swaps::<T>(&self.factors));
            self.is_renderer_current = true;
        }
        renderer.draw(|surface| self.task.draw(&state, surface), frame);
    }

    /// Returns the states of a rollout that may serve as goals.
    ///
    /// The first half of the attempts uses the expert's actions, the second half random actions. Terminal states are
    /// excluded unless they reach the task's goal; the last quarter of the attempts includes them.
    fn rollout(&self, rng: &mut Rng, attempt: u64) -> Vec<T::State> {
        let (is_expert, with_terminal) = (attempt < GOAL_TRIES / 2, attempt >= GOAL_TRIES * 3 / 4);
        let (mut state, goal, mut states) = (self.state, T::sample_task_goal(rng), vec![]);
        while states.len() < GOAL_STEPS {
            let action = if is_expert && !rng.random_bool(RANDOM_FRACTION) {
                self.task.control(&state, &goal)
            } else {
                self.spec.action_space.sample(rng)[0]
            };
            let terminated = self.task.step(&mut state, f64::from(action as f32)).terminated;
            let reached = self.task.is_reached(&state, &goal);
            if reached || !terminated || with_terminal {
                states.push(state);
            }
            if (reached && is_expert) || (terminated && !with_terminal) {
                break;
            }
        }
        states
    }

    /// Rounds a state to the precision of the `goal_state` column.
    fn observable(&self, state: &T::State) -> Result<T::State> {
        let mut row = [0.0; MAX_STATE_LEN];
        let len = T::STATE_BOUNDS.len();
        T::observe(state, &mut row[..len]);
        T::parse_state("a sampled goal", &row.map(f64::from)[..len])
    }
}

impl<T: ControlTask> Env for ClassicEnv<T> {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn reset(&mut self, seed: u64, options: &ResetOptions) -> Result<()> {
        let key = Key::new(seed);
        let factors = self.spec.variation_space.resolve(&options.variation, key)?;
        let state = match &options.state {
            Some(state) => T::parse_state(STATE, state)?,
            None => T::sample_start(&mut key.with("start").rng()),
        };
        let goal = match &options.goal_state {
            Some(goal) => T::parse_state(GOAL_STATE, goal)?,
            None => T::sample_task_goal(&mut key.with("task").rng()),
        };
        self.begin(factors, state, goal);
        Ok(())
    }

    fn step(&mut self, action: Action<'_>) -> Result<Transition> {
        let action = match self.spec.action_space {
            Space::Box { .. } => f64::from(action.continuous(1)?[0]),
            _ => action.discrete(&self.spec.action_space)?[0] as f64,
        };
        Ok(self.task.step(&mut self.state, action))
    }

    fn observe(&self, row: &mut RowMut<'_>) {
        T::observe(&self.state, row.at(index::STATE));
        T::observe(&self.goal, row.at(index::GOAL_STATE));
        row.set(index::PHYSICS, &self.physics);
    }

    fn render(&mut self, frame: FrameMut<'_>) -> Result<()> {
        self.draw(self.state, frame);
        Ok(())
    }

    fn render_goal(&mut self, frame: FrameMut<'_>) -> Result<()> {
        self.draw(self.goal, frame);
        Ok(())
    }

    fn factors(&self) -> &FactorValues {
        &self.factors
    }

    fn snapshot(&self) -> Snapshot {
        let values = self.state.as_ref().iter().chain(self.goal.as_ref());
        snapshot(T::ID, &self.factors, values.flat_map(|value| value.to_le_bytes()))
    }

    fn restore(&mut self, snapshot: &Snapshot) -> Result<()> {
        let (factors, bytes) = parse_snapshot(T::ID, &self.spec.variation_space, &self.factors, snapshot)?;
        let (mut state, mut goal) = (T::State::default(), T::State::default());
        let values = state.as_mut().iter_mut().chain(goal.as_mut());
        let (chunks, tail) = bytes.as_chunks();
        if chunks.len() != values.size_hint().0 || !tail.is_empty() {
            return Err(wrong_snapshot(T::ID, format!("{} bytes of state and goal", bytes.len())));
        }
        values.zip(chunks).for_each(|(value, &bytes)| *value = f64::from_le_bytes(bytes));
        match factors {
            Some(factors) => self.begin(factors, state, goal),
            None => (self.state, self.goal) = (state, goal),
        }
        Ok(())
    }

    fn restore_from(&mut self, start: RowRef<'_>, goal: RowRef<'_>) -> Result<()> {
        let state = T::parse_state(STATE, &start.to_f64(STATE)?)?;
        let goal = T::parse_state("goal state", &goal.to_f64(STATE)?)?;
        let factors = from_row(&self.spec.variation_space, &self.factors, start)?;
        self.begin(factors, state, goal);
        Ok(())
    }

    fn sample_goal(&mut self, key: Key) -> Result<()> {
        for attempt in 0..GOAL_TRIES {
            let mut rng = key.at(attempt).rng();
            let mut goals = self.rollout(&mut rng, attempt);
            goals.retain_mut(|goal| match self.observable(goal) {
                Ok(observable) if !self.task.is_reached(&self.state, &observable) => {
                    *goal = observable;
                    true
                }
                _ => false,
            });
            if let Some(&goal) = goals.choose(&mut rng) {
                self.goal = goal;
                return Ok(());
            }
        }
        Err(Error::Unsatisfiable {
            factor: "goal".to_owned(),
            constraint: "on a rollout of the expert or of random actions, and not reached already".to_owned(),
            tries: GOAL_TRIES as usize,
        })
    }

    fn is_success(&self) -> bool {
        self.task.is_reached(&self.state, &self.goal)
    }

    fn goal_distance(&self) -> f64 {
        self.task.goal_distance(&self.state, &self.goal)
    }
}
