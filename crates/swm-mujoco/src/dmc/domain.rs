//! [`Domain`]: the trait that each domain of the suite implements; [`TaskTable`] and [`InfoColumn`]: its tables.

use super::model_edit::ModelEdit;
use super::observation::ObservationWriter;
use crate::Physics;
use mujoco_rs::wrappers::MjModel;
use swm_core::{Factor, Result, Rng};

/// The tasks of a domain by name; the first is the default. Made by [`tasks!`].
pub struct TaskTable<T: 'static> {
    /// The names, as the option `task` takes them.
    pub names: &'static [&'static str],
    /// The task of each name.
    pub tasks: &'static [T],
}

impl<T: Copy> TaskTable<T> {
    /// Returns the task with this name, or the default task for an unknown name.
    pub fn get(&self, name: &str) -> T {
        let index = self.names.iter().position(|known| *known == name);
        self.tasks[index.unwrap_or(0)]
    }
}

/// Makes a [`TaskTable`] of `"name" => task` rows.
macro_rules! tasks {
    ($($name:literal => $task:expr),+ $(,)?) => {
        $crate::dmc::domain::TaskTable { names: &[$($name),+], tasks: &[$($task),+] }
    };
}
pub(super) use tasks;

/// The reward of one control step; the type [`Domain::Task`] of domains whose tasks differ in the reward only.
pub type RewardFn<D> = fn(&D, &Physics) -> f64;

/// A column in addition to the observation (an entry of `info` in the reference).
pub struct InfoColumn<D> {
    /// The name of the column.
    pub name: &'static str,
    /// The number of elements.
    pub len: usize,
    /// Writes the elements.
    pub write: fn(&D, &Physics, &mut [f64]),
}

/// A domain of the suite: the model and the code that its tasks have in common. A value of the implementing type is one
/// task on a compiled model.
pub trait Domain: Send + Sized + 'static {
    /// The parameters that distinguish the tasks.
    type Task: Copy + Send + 'static;

    /// The registered id.
    const ID: &'static str;
    /// The file of the model.
    const MODEL: &'static str;
    /// A one-sentence description.
    const SUMMARY: &'static str;
    /// The tasks; the first is the default.
    const TASKS: TaskTable<Self::Task>;
    /// Time steps per control step.
    const SUBSTEPS: usize;
    /// The number of actions after which an episode is truncated: the suite's time limit.
    const MAX_STEPS: usize = 500;
    /// The index of the default camera.
    const CAMERA: usize = 0;
    /// Columns in addition to the observation.
    const INFO: &'static [InfoColumn<Self>] = &[];
    /// Joints that goals do not include.
    const IGNORED_JOINTS: &'static [&'static str] = &[];
    /// The number of values that describe a target that is drawn per episode; 0 without such a target.
    const TARGET_LEN: usize = 0;
    /// The largest difference from the goal at each joint, in radians or metres.
    const GOAL_TOLERANCE: f64 = 0.1;

    /// The factors of variation, in sampling order.
    fn factors() -> Vec<Factor>;

    /// Edits the MJCF text of the model for a task.
    ///
    /// # Errors
    /// When the text is not that of the pinned version.
    fn prepare_xml(text: String, _task: Self::Task) -> Result<String> {
        Ok(text)
    }

    /// Applies factors of variation to the model before it is compiled.
    ///
    /// # Errors
    /// When the model lacks an element.
    fn edit(edit: &mut ModelEdit<'_>, task: Self::Task) -> Result<()>;

    /// Finds the elements of the domain in a compiled model.
    ///
    /// # Errors
    /// When the model lacks an element.
    fn new(model: &MjModel, task: Self::Task) -> Result<Self>;

    /// Edits the compiled model for the task.
    fn configure_model(&self, _physics: &mut Physics) {}

    /// Draws the start of an episode. The state is the model's initial one, with derived quantities up to date.
    ///
    /// # Errors
    /// When no valid start was found.
    fn start(&self, physics: &mut Physics, rng: &mut Rng) -> Result<()>;

    /// Writes the target of the task. Shape of `into`: `[TARGET_LEN]`.
    fn target(&self, _physics: &Physics, _into: &mut [f64]) {}

    /// Sets the target of the task. The caller updates derived quantities.
    fn set_target(&self, _physics: &mut Physics, _target: &[f64]) {}

    /// Writes the observation.
    fn observe(&self, physics: &Physics, observation: &mut ObservationWriter<'_>);

    /// The reward of one control step.
    fn reward(&self, physics: &Physics) -> f64;

    /// Writes the goal configuration and returns true if the task determines it; otherwise returns false.
    fn goal_qpos(&self, _physics: &Physics, _qpos: &mut [f64]) -> bool {
        false
    }

    /// Whether the goal configuration is reached; `None` to compare joint by joint.
    fn goal_reached(&self, _physics: &Physics, _goal: &[f64]) -> Option<bool> {
        None
    }

    /// The distance to the goal configuration, in radians or metres; `None` to compare joint by joint.
    fn goal_distance(&self, _physics: &Physics, _goal: &[f64]) -> Option<f64> {
        None
    }

    /// Whether the episode terminates at the goal.
    fn terminates_at_goal(&self) -> bool {
        false
    }
}
