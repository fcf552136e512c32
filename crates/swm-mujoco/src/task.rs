//! [`Task`]: the trait that an environment family implements to run inside [`MujocoEnv`](crate::env::MujocoEnv).

use crate::Physics;
use crate::render::Camera;
use mujoco_rs::wrappers::MjModel;
use swm_core::{FactorValues, Key, Result, RowMut, VariationRequest};

/// The index of a task's first column; `state` and `unstable` precede it.
pub(crate) const FIRST_TASK_COLUMN: usize = 2;

/// The result of one control step.
pub(crate) struct StepOutcome {
    /// The reward.
    pub reward: f64,
    /// Whether the episode terminates.
    pub terminated: bool,
}

/// The part of an environment that differs between families: start, step, observation, reward and goal.
///
/// The *task state* contains the values of a task that are not part of the physics, such as a score; it is part of the
/// `state` column. The *goal values* are stored in snapshots only, because the `state` column does not contain the
/// goal.
pub(crate) trait Task: Send {
    /// Edits the model for these factors of variation. Earlier edits are undone before the call, unless
    /// [`Task::overwrites_edits`]. The method is called only when the factors change.
    ///
    /// # Errors
    /// When the model lacks an element, or cannot be compiled for these factors.
    fn apply_factors(&mut self, physics: &mut Physics, factors: &FactorValues) -> Result<()>;

    /// Whether [`Task::apply_factors`] sets every value of the model that the task ever edits. Earlier edits are then
    /// not undone before the call, because undoing them is slow for models with many meshes.
    fn overwrites_edits(&self) -> bool {
        false
    }

    /// Receives the factor request of a reset before [`Task::start`], for tasks that draw the factors that were not
    /// requested.
    fn receive_request(&mut self, _request: &VariationRequest) {}

    /// Starts an episode. Before the call, the state is the model's initial state ([`Physics::reset`]); derived
    /// quantities must be up to date on return.
    ///
    /// # Errors
    /// When no valid start was found.
    fn start(&mut self, physics: &mut Physics, factors: &FactorValues, key: Key) -> Result<()>;

    /// Applies one action of finite values.
    fn step(&mut self, physics: &mut Physics, action: &[f32]) -> StepOutcome;

    /// Writes the task's columns, from [`FIRST_TASK_COLUMN`] on.
    fn observe(&self, physics: &Physics, row: &mut RowMut<'_>);

    /// The length of the task state, the same for all episodes.
    fn task_state_len(&self, model: &MjModel) -> usize;

    /// Writes the task state.
    fn save_task_state(&self, into: &mut [f64]);

    /// Restores the task state. The model has the edits of the factors; the state of the physics is set afterwards.
    fn load_task_state(&mut self, physics: &mut Physics, task_state: &[f64]);

    /// The length of the goal values.
    fn goal_len(&self) -> usize {
        0
    }

    /// Writes the goal values.
    fn save_goal(&self, _into: &mut [f64]) {}

    /// Restores the goal values.
    fn load_goal(&mut self, _goal: &[f64]) {}

    /// Sets the goal to a state: a vector of [`Physics::state`], and the task state at the goal. May change the state
    /// of the physics; the environment restores it.
    ///
    /// # Errors
    /// When the state is invalid.
    fn set_goal_state(&mut self, physics: &mut Physics, state: &[f64], task_state: &[f64]) -> Result<()>;

    /// Sets the goal from values that are not a state, such as a position; `None` if the task does not accept these
    /// values. May change the state of the physics; the environment restores it.
    fn set_goal_values(&mut self, _physics: &mut Physics, _goal: &[f64]) -> Option<Result<()>> {
        None
    }

    /// Samples a reachable goal that is not already reached. May change the state of the physics; the environment
    /// restores it.
    ///
    /// # Errors
    /// When no such goal was found.
    fn sample_goal(&mut self, physics: &mut Physics, key: Key) -> Result<()>;

    /// Puts the physics into a state where the goal is reached, to render it. The environment restores the state.
    fn move_to_goal(&mut self, physics: &mut Physics);

    /// Updates the parts of the model that display goal and task state (markers, lock colours) for `state`, which the
    /// environment sets next. Called whenever the goal or the task state was set from outside.
    fn update_markers(&mut self, _physics: &mut Physics, _state: &[f64]) {}

    /// Whether the goal is reached.
    fn is_success(&self, physics: &Physics) -> bool;

    /// The distance to the goal; 0 at the goal. The unit depends on the task.
    fn goal_distance(&self, physics: &Physics) -> f64;

    /// The default camera.
    fn camera(&self) -> Camera;
}
