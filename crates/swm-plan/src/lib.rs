//! Planning: solvers that search for cheap action sequences, and the policy that replans with them.
//!
//! A solver is a file; each is the algorithm of its paper on a screen, over the contracts of
//! [`swm_core::plan`]. [`MpcPolicy`] turns any solver and any [`swm_core::CostModel`] into a
//! [`swm_core::Policy`].

pub mod augmented_lagrangian;
pub mod categorical_cem;
pub mod cem;
mod codec;
mod colour;
mod gaussian;
#[cfg(test)]
mod golden;
pub mod gradient_descent;
pub mod grasp;
mod guard;
mod history;
pub mod icem;
pub mod mpc;
pub mod mppi;
pub mod objective;
pub mod optimizer;
pub mod penalty;
pub mod pgd;
mod population;
pub mod predictive_sampling;
pub mod problem;
pub mod registry;
mod sampling;
pub mod scale;
pub mod simulator;
pub mod topk;
pub mod trace;

pub use augmented_lagrangian::AugmentedLagrangian;
pub use categorical_cem::CategoricalCem;
pub use cem::Cem;
pub use gradient_descent::GradientDescent;
pub use grasp::Grasp;
pub use icem::ICem;
pub use mpc::{MpcConfig, MpcPolicy};
pub use mppi::Mppi;
pub use penalty::Penalised;
pub use pgd::Pgd;
pub use predictive_sampling::PredictiveSampling;
pub use registry::{SOLVERS, SolverEntry};
pub use scale::ActionScale;
pub use simulator::{Score, SimulatorCost};
pub use trace::{PlanRecord, TraceLog};
