//! Model-predictive control: plan some steps ahead, execute the first of them, plan again.
//!
//! [`MpcPolicy`] is the policy; [`ActionScale`] converts between a model's and an environment's action units;
//! [`TraceLog`] records every plan and its search.

mod action_codec;
mod action_scale;
mod config;
mod guarded_model;
mod history;
mod observer;
mod policy;
mod trace_log;

pub(crate) use action_codec::{ActionCodec, Decoded};
pub use action_scale::ActionScale;
pub use config::MpcConfig;
pub use observer::{BetweenIterations, PlanObserver};
pub use policy::MpcPolicy;
pub use trace_log::{PlanRecord, TraceLog};
