//! Planning: solvers that search for cheap action sequences, and the policy that replans with them.
//!
//! - [`solvers`]: a file for each algorithm, and [`SOLVERS`], the list of them.
//! - [`search`]: common parts of solvers: the population, sampling, the gradient loop, optimizers, checks of problems
//!   and settings.
//! - [`objective`]: terms and constraints that are added to the cost of a model or replace it.
//! - [`mpc`]: [`MpcPolicy`], which turns any solver and any [`swm_core::CostModel`] into a [`swm_core::Policy`].
//! - [`simulator`]: the true simulator as a cost model.
//!
//! The contracts (`Solver`, `CostModel`, `PlanProblem`, `Plan`) are in [`swm_core::plan`].

pub mod entry;
pub mod mpc;
pub mod objective;
pub mod search;
pub mod simulator;
pub mod solvers;

pub use entry::{ActionKind, Family, Need, SolverEntry};
pub use mpc::{ActionScale, BetweenIterations, MpcConfig, MpcPolicy, PlanObserver, PlanRecord, TraceLog};
pub use objective::Penalised;
pub use simulator::{Score, SimulatedLatents, SimulatorCost};
pub use solvers::{
    AugmentedLagrangian, CategoricalCem, Cem, GradientDescent, Grasp, ICem, Mppi, Pgd, PredictiveSampling, SOLVERS,
    pairing,
};
