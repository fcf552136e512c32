//! Objectives and constraints that compose, over the latents and actions of a candidate.
//!
//! An [`Objective`] computes the cost of one [`Trajectory`] and the gradient of the cost; the cost of a list of
//! objectives is the sum of their costs. A [`Constraint`] is an inequality, satisfied when its value is at most 0. Two
//! wrappers apply objectives and constraints to a model: [`ObjectiveCost`] rolls out the latent dynamics and replaces
//! the model's cost, with the gradient by back-propagation through time; [`Regularised`] adds terms on actions to the
//! model's cost. [`Penalised`] turns constraints into a cost. [`ObjectiveConfig`] describes terms and constraints in a
//! file.
//!
//! Actions and latents are in the model's (normalised) units throughout.

mod config;
mod constraint;
mod contracts;
mod cost;
mod penalised;
mod pick;
mod regularised;
mod rollout;
mod term;
mod trajectories;

pub use config::{Limit, ObjectiveConfig, Term};
pub use constraint::{ActionNorm, CustomConstraint, LatentBox};
pub use contracts::{Constraint, Objective, Shape, Slope, Trajectory};
pub use cost::ObjectiveCost;
pub use penalised::Penalised;
pub use pick::Pick;
pub use regularised::Regularised;
pub use term::{Change, Control, Goal, When};
