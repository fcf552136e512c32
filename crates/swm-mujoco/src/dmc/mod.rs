//! The DeepMind Control suite (Tassa et al. 2018), with the tasks and factors of variation that the reference adds.
//!
//! A [`Domain`] is what tells the worlds apart: a model, tasks, a start, observations and rewards. [`Control`] makes an
//! environment of any of them.

pub mod acrobot;
pub mod ball_in_cup;
mod blueprint;
pub mod cartpole;
pub mod cheetah;
mod env;
mod factors;
pub mod finger;
mod goal;
pub mod hopper;
pub mod humanoid;
pub mod manipulator;
mod names;
pub mod pendulum;
pub mod quadruped;
pub mod reacher;
mod reward;
mod start;
pub mod walker;

use crate::Physics;
use blueprint::Edit;
use mujoco_rs::wrappers::MjModel;
use swm_core::{Factor, Result, Rng};

/// One world of the suite, on one model, with one task.
trait Domain: Send + Sized + 'static {
    /// What there is to do.
    type Task: Copy + Send + 'static;

    /// Its registered id.
    const ID: &'static str;
    /// The file of its model.
    const MODEL: &'static str;
    /// The tasks by name; the first is the default.
    const TASKS: &'static [(&'static str, Self::Task)];
    /// Time steps of the physics while a control is held.
    const SUBSTEPS: usize;
    /// Steps after which an episode is truncated: the suite's time limit.
    const LIMIT: usize = 500;
    /// The camera that the reference looks through.
    const CAMERA: usize = 0;
    /// Columns beside the observation: what they are called, and how many numbers they have.
    const INFO: &'static [(&'static str, usize)] = &[];
    /// Joints that no goal asks for.
    const IDLE: &'static [&'static str] = &[];
    /// How near each joint must be to its goal, in radians or metres.
    const NEAR: f64 = 0.1;

    /// The factors of variation, in sampling order.
    fn factors() -> Vec<Factor>;

    /// The model's text as the task wants it.
    fn draft(text: String, _task: Self::Task) -> String {
        text
    }

    /// Applies factors of variation to the model before it is compiled.
    fn edit(edit: &mut Edit<'_>, task: Self::Task) -> Result<()>;

    /// The world on a compiled model.
    fn new(model: &MjModel, task: Self::Task) -> Result<Self>;

    /// Draws the start of an episode. The state comes as the model has it, with everything derived from it.
    fn start(&self, physics: &mut Physics, rng: &mut Rng) -> Result<()>;

    /// Appends what an agent observes.
    fn observe(&self, physics: &Physics, seen: &mut Vec<f64>);

    /// The reward of one control step.
    fn reward(&self, physics: &Physics) -> f64;

    /// Fills a column of [`Domain::INFO`].
    fn info(&self, _physics: &Physics, _column: usize, _into: &mut [f64]) {}

    /// Whether the reference would call this a success, where it has a notion of it.
    fn solved(&self, _physics: &Physics) -> Option<bool> {
        None
    }
}
