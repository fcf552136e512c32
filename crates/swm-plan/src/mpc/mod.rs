//! Model-predictive control: plan some steps ahead, execute the first of them, plan again.
//!
//! [`MpcPolicy`] is the policy; [`ActionScale`] relates a model's action units to an environment's; [`TraceLog`] collects how
//! searches went.

mod action_codec;
mod action_scale;
mod config;
mod guarded_model;
mod history;
mod policy;
mod trace_log;

pub(crate) use action_codec::{ActionCodec, Decoded};
pub use action_scale::ActionScale;
pub use config::MpcConfig;
pub use policy::MpcPolicy;
pub use trace_log::{PlanRecord, TraceLog};
