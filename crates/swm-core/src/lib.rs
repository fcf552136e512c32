//! The contracts of stable-worldmodel: the traits and types that the other crates implement and use.
//!
//! Read the modules in this order:
//!
//! 1. [`batch`] and [`columns`]: named typed arrays, which all parts of the system exchange, and the names of their
//!    columns.
//! 2. [`space`], [`variation`], [`factors`]: spaces of actions and observations, factors of variation, and the values
//!    of factors in dataset rows.
//! 3. [`key`]: keyed random streams, the only source of randomness.
//! 4. [`mod@env`], [`camera_view`], [`dispatch`], [`dataset_start`]: one environment. [`pool`], [`thread_budget`]: many
//!    environments on a fixed set of threads. [`policy`]: policies and experts.
//! 5. [`plan`]: costs of candidate action sequences, and the solvers that minimise them. [`predictor`]: models that
//!    predict latents. [`requirements`]: columns that a model family requires of a dataset.
//! 6. [`run`]: progress and interruption of long commands. [`registry`], [`manifest`], [`results`], [`error`]: names,
//!    provenance, evaluation results and errors. [`files`]: reading, replacing and deleting files. [`home`]: the home
//!    folder. [`text`]: text from files, made safe to print. [`origin`]: names that only the user may choose.
//!    [`finite`]: counts of NaN and infinite values. [`guarded`]: calls of libraries that may panic. [`limits`]: the
//!    largest counts that commands accept.

pub mod batch;
pub mod camera_view;
pub mod columns;
pub mod dataset_start;
pub mod dispatch;
pub mod env;
pub mod error;
pub mod factors;
pub mod files;
pub mod finite;
pub mod guarded;
pub mod home;
pub mod key;
pub mod limits;
pub mod manifest;
pub mod origin;
mod parallelism;
pub mod plan;
pub mod policy;
pub mod pool;
pub mod precision;
pub mod predictor;
pub mod registry;
pub mod requirements;
pub mod results;
pub mod run;
pub mod space;
mod sync;
pub mod text;
pub mod thread_budget;
pub mod variation;
mod worker_threads;

pub use batch::{Batch, ColumnSpec, DType, Element, LARGEST_SCHEMA, RowMut, RowRef, Schema, check_column_count};
pub use camera_view::{CameraView, Modality};
pub use columns::ColumnIndices;
pub use dataset_start::{Callable, CallableArgument, DatasetStart, DatasetStartEnv};
pub use dispatch::{DispatchEnv, PendingCall};
pub use env::{Action, Env, EnvSpec, FrameMut, ResetOptions, Snapshot, Transition};
pub use error::{Error, Result};
pub use key::{Key, Rng};
pub use manifest::Manifest;
pub use origin::Origin;
pub use plan::{
    Candidates, Constrained, CostModel, DifferentiableCost, Iteration, LatentDynamics, Plan, PlanProblem, PlanSpace,
    PlanTrace, SearchObserver, Solver,
};
pub use policy::{Policy, RandomPolicy};
pub use pool::EnvPool;
pub use predictor::Predictor;
pub use registry::{EnvChoice, EnvEntry, EnvOption, ExpertEntry, Named, Registry};
pub use results::Results;
pub use space::Space;
pub use variation::{Factor, FactorValues, VariationRequest, VariationSpace};
