//! Twelve domains of the DeepMind Control suite (Tassa et al. 2018, arXiv:1801.00690), with the tasks and factors of
//! variation that the reference adds.
//!
//! Each domain is one module: a [`Domain`](domain::Domain) with its tasks, factors, initial states, observation and
//! rewards. `suite_env` runs a domain as an environment. Constants and formulas are those of `dm_control` 1.0.50
//! (`dm_control/suite/`) and, for the added tasks, of TD-MPC2 (Hansen et al. 2024) and Newt (Hansen et al. 2025).

mod acrobot;
mod ball_in_cup;
mod cartpole;
mod cheetah;
mod domain;
#[cfg(test)]
mod expert_test;
mod factors;
mod finger;
mod goal;
#[cfg(test)]
mod golden;
mod hopper;
mod humanoid;
mod manipulator;
mod measures;
mod model_edit;
mod model_index;
mod model_source;
mod observation;
mod pendulum;
mod quadruped;
mod reacher;
mod replace_values;
mod reward;
mod start;
mod suite_env;
mod walker;

use swm_core::EnvEntry;

/// The domains of the suite that this crate implements.
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
