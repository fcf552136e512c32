//! The vocabulary of stable-worldmodel.
//!
//! Read the modules in this order and you know the system:
//!
//! 1. [`batch`]: the only thing that flows between its parts, named typed columns.
//! 2. [`space`] and [`variation`]: what an action, an observation and a factor of variation may be.
//! 3. [`key`]: where every random number comes from.
//! 4. [`env`], [`view`], [`recorded`], [`pool`], [`share`], [`policy`]: worlds, many of them at once, and who acts in them.
//! 5. [`plan`]: costs of candidate action sequences, and the solvers that minimise them.
//! 6. [`registry`], [`manifest`], [`results`], [`error`]: names, provenance, findings, and what goes wrong.

pub mod batch;
pub mod env;
pub mod error;
pub mod factors;
pub mod key;
pub mod manifest;
mod pace;
pub mod plan;
pub mod policy;
pub mod pool;
pub mod recorded;
pub mod registry;
pub mod results;
pub mod share;
pub mod space;
pub mod variation;
pub mod view;

pub use batch::{Batch, ColumnSpec, DType, Element, RowMut, RowRef, Schema};
pub use env::{Action, Env, EnvSpec, FrameMut, Next, ResetOptions, Snapshot, Transition};
pub use error::{Error, Result};
pub use key::{Key, Rng};
pub use manifest::Manifest;
pub use plan::{
    Candidates, Constrained, CostModel, DifferentiableCost, LatentDynamics, Plan, PlanProblem, PlanSpace, PlanTrace,
    Solver,
};
pub use policy::{Policy, RandomPolicy};
pub use pool::EnvPool;
pub use recorded::{Argument, Call, Recorded};
pub use registry::{EnvChoice, EnvEntry, EnvOption, ExpertEntry, Named, Registry};
pub use results::Results;
pub use space::Space;
pub use variation::{Factor, FactorValues, VariationRequest, VariationSpace};
pub use view::{Modality, View};
