//! The vocabulary of stable-worldmodel.
//!
//! Read the modules in this order and you know the system:
//!
//! 1. [`batch`] and [`columns`]: named typed columns, the only thing that flows between the parts, and their names.
//! 2. [`space`] and [`variation`]: what an action, an observation and a factor of variation may be.
//! 3. [`key`]: where every random number comes from.
//! 4. [`env`], [`camera_view`], [`dispatch`], [`dataset_start`]: one environment; [`pool`], [`thread_budget`]: many of them at
//!    once; [`policy`]: what acts in them.
//! 5. [`plan`]: costs of candidate action sequences, and the solvers that minimise them.
//! 6. [`run`], [`registry`], [`manifest`], [`results`], [`error`]: long commands, names, provenance, findings, and what goes wrong.

pub mod batch;
pub mod camera_view;
pub mod columns;
pub mod dataset_start;
pub mod dispatch;
pub mod env;
pub mod error;
pub mod factors;
pub mod key;
pub mod manifest;
mod parallelism;
pub mod plan;
pub mod policy;
pub mod pool;
pub mod predictor;
pub mod registry;
pub mod requirements;
pub mod results;
pub mod run;
pub mod space;
pub mod thread_budget;
pub mod variation;

pub use batch::{Batch, ColumnSpec, DType, Element, RowMut, RowRef, Schema};
pub use camera_view::{CameraView, Modality};
pub use columns::ColumnIndices;
pub use dataset_start::{Callable, CallableArgument, DatasetStart, DatasetStartEnv};
pub use dispatch::{DispatchEnv, PendingCall};
pub use env::{Action, Env, EnvSpec, FrameMut, ResetOptions, Snapshot, Transition};
pub use error::{Error, Result};
pub use key::{Key, Rng};
pub use manifest::Manifest;
pub use plan::{
    Candidates, Constrained, CostModel, DifferentiableCost, LatentDynamics, Plan, PlanProblem, PlanSpace, PlanTrace,
    Solver,
};
pub use policy::{Policy, RandomPolicy};
pub use pool::EnvPool;
pub use predictor::Predictor;
pub use registry::{EnvChoice, EnvEntry, EnvOption, ExpertEntry, Named, Registry};
pub use results::Results;
pub use space::Space;
pub use variation::{Factor, FactorValues, VariationRequest, VariationSpace};
