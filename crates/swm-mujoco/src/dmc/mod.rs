//! The DeepMind Control suite (Tassa et al. 2018), with the tasks and factors of variation that the reference adds.
//!
//! A [`Domain`] is what tells the worlds apart: a model, tasks, a start, observations and rewards. [`Control`] makes an
//! environment of any of them.

mod acrobot;
mod adopt;
mod ball_in_cup;
mod blueprint;
mod cartpole;
mod cheetah;
mod env;
mod factors;
mod finger;
mod goal;
#[cfg(test)]
mod golden;
mod hopper;
mod humanoid;
mod manipulator;
mod names;
mod pendulum;
mod quadruped;
mod reacher;
mod reward;
mod start;
mod walker;

use crate::Physics;
use blueprint::Edit;
use env::Seen;
use mujoco_rs::wrappers::MjModel;
use std::marker::PhantomData;
use swm_core::{EnvEntry, EnvOption, ExpertEntry, Factor, Result, Rng};

/// Every world of the suite.
pub const ENTRIES: [EnvEntry; 12] = [
    acrobot::ENTRY,
    ball_in_cup::ENTRY,
    cartpole::ENTRY,
    cheetah::ENTRY,
    finger::ENTRY,
    hopper::ENTRY,
    humanoid::ENTRY,
    manipulator::ENTRY,
    pendulum::ENTRY,
    quadruped::ENTRY,
    reacher::ENTRY,
    walker::ENTRY,
];

/// One world of the suite, on one model, with one task.
trait Domain: Send + Sized + 'static {
    /// What there is to do.
    type Task: Copy + Send + 'static;

    /// Its registered id.
    const ID: &'static str;
    /// The file of its model.
    const MODEL: &'static str;
    /// What one does there, in a sentence.
    const SUMMARY: &'static str;
    /// The tasks by name; the first is the default.
    const TASKS: &'static [(&'static str, Self::Task)];
    /// Their names.
    const NAMES: &'static [&'static str];
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
    /// Numbers of the task's target, if it has one that differs between episodes.
    const TARGET: usize = 0;
    /// How near each joint must be to its goal, in radians or metres.
    const NEAR: f64 = 0.1;

    /// The factors of variation, in sampling order.
    fn factors() -> Vec<Factor>;

    /// The model's text as the task wants it.
    ///
    /// # Errors
    /// When the text is not the one that was pinned.
    fn draft(text: String, _task: Self::Task) -> Result<String> {
        Ok(text)
    }

    /// Applies factors of variation to the model before it is compiled.
    fn edit(edit: &mut Edit<'_>, task: Self::Task) -> Result<()>;

    /// The world on a compiled model.
    fn new(model: &MjModel, task: Self::Task) -> Result<Self>;

    /// Edits the compiled model as the task wants it.
    fn adapt(&self, _physics: &mut Physics) {}

    /// Draws the start of an episode. The state comes as the model has it, with everything derived from it.
    fn start(&self, physics: &mut Physics, rng: &mut Rng) -> Result<()>;

    /// Where the target is.
    fn target(&self, _physics: &Physics, _into: &mut [f64]) {}

    /// Puts the target somewhere. Whatever depends on the model's places must be computed again.
    fn place(&self, _physics: &mut Physics, _target: &[f64]) {}

    /// Appends what an agent observes.
    fn observe(&self, physics: &Physics, seen: &mut Seen<'_>);

    /// The reward of one control step.
    fn reward(&self, physics: &Physics) -> f64;

    /// Where the task leads: fills in the joints' coordinates there, if one configuration is the task's goal.
    fn destination(&self, _physics: &Physics, _qpos: &mut [f64]) -> bool {
        false
    }

    /// Whether a goal's configuration is reached, where the task has a say in it.
    fn reached(&self, _physics: &Physics, _goal: &[f64]) -> Option<bool> {
        None
    }

    /// How far a goal's configuration is, where the task has a say in it.
    fn left(&self, _physics: &Physics, _goal: &[f64]) -> Option<f64> {
        None
    }

    /// Whether the episode ends at the goal.
    fn ends_at_goal(&self) -> bool {
        false
    }

    /// Fills a column of [`Domain::INFO`].
    fn info(&self, _physics: &Physics, _column: usize, _into: &mut [f64]) {}
}

/// The names of tasks.
const fn task_names<T: Copy, const N: usize>(tasks: &[(&'static str, T)]) -> [&'static str; N] {
    assert!(tasks.len() == N, "all of them");
    let mut all = [""; N];
    let mut i = 0;
    while i < N {
        all[i] = tasks[i].0;
        i += 1;
    }
    all
}

/// What every world of the suite can be asked for.
struct Options<D>(PhantomData<D>);

impl<D: Domain> Options<D> {
    const ALL: &'static [EnvOption] = &[EnvOption { key: "task", summary: "what there is to do", values: D::NAMES }];
}

/// The registry's row of a world.
const fn entry<D: Domain>(experts: &'static [ExpertEntry]) -> EnvEntry {
    EnvEntry { id: D::ID, summary: D::SUMMARY, options: Options::<D>::ALL, make: env::make::<D>, experts }
}

/// How far apart two places are.
fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    norm(&[a[0] - b[0], a[1] - b[1], a[2] - b[2]])
}

/// The length of a vector.
fn norm(vector: &[f64]) -> f64 {
    vector.iter().map(|x| x * x).sum::<f64>().sqrt()
}

/// A vector of the world as a body whose orientation is `frame` sees it.
fn seen_from(frame: &[f64; 9], vector: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|i| (0..3).map(|k| vector[k] * frame[3 * k + i]).sum())
}
