//! Objectives and constraints that compose, over the latents and actions of a candidate.
//!
//! An [`Objective`] is the cost of one [`Trajectory`] and its gradient; a list of objectives is their sum. A [`Constraint`] is
//! an inequality, satisfied when its value is at most 0. Two models apply them: [`ObjectiveCost`] rolls out any latent
//! dynamics and replaces the model's cost, with the gradient by back-propagation through time; [`Regularised`] keeps the cost
//! of a model and adds terms on actions. [`Penalised`] turns constraints into a cost. [`ObjectiveConfig`] describes terms and
//! constraints in a file.
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
