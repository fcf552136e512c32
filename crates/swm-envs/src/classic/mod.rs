//! Classic control: the environments of Gymnasium, with the factors of variation of the reference.
//!
//! Each environment implements [`ControlTask`]: equations of motion, a goal, a controller and drawing. [`ClassicEnv`]
//! is the [`swm_core::Env`] of any [`ControlTask`], and [`Controller`] its expert.

pub mod acrobot;
mod angle;
pub mod cart_pole;
mod controller;
mod env;
mod factors;
mod frame;
mod geometry;
#[cfg(test)]
mod measure;
pub mod mountain_car;
pub mod pendulum;
mod task;

use controller::Controller;
use env::ClassicEnv;
use factors::{ColorFactor, PhysicsFactor};
use frame::Surface;
use task::ControlTask;
