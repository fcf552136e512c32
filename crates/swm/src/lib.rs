//! stable-worldmodel: the whole platform behind one name.
//!
//! Collect trajectories from worlds with controllable factors of variation, store and stream them, train world
//! models, plan with them, and measure how they hold up when the world changes. The parts are crates of their
//! own, re-exported here; this crate also builds the `swm` command.

// The command line was written against the facade by its name.
extern crate self as swm;

pub use swm_core as core;
pub use swm_data as data;
pub use swm_envs as envs;
pub use swm_eval as eval;
pub use swm_gym as gym;
pub use swm_models as models;
pub use swm_mujoco as mujoco;
pub use swm_plan as plan;
pub use swm_report as report;

pub mod cli;
pub mod collect;
pub mod describe;
pub mod families;
pub mod home;
pub mod predictor;
pub mod resolver;
pub mod subject;

use swm_core::EnvEntry;
use swm_core::registry::{Registry, join};

/// Every environment of this build: those of two dimensions, then those on MuJoCo.
pub static ENVS: Registry<EnvEntry> = Registry { rows: &ROWS, ..swm_envs::ENVS };

const ROWS: [EnvEntry; swm_envs::ENVS.rows.len() + swm_mujoco::ENVS.rows.len()] =
    join(swm_envs::ENVS.rows, swm_mujoco::ENVS.rows);
