//! Collection of episodes with policies, and evaluation of policies.
//!
//! - [`world`]: [`World`], many environments of one kind and the loop that plays a policy in them.
//! - [`collect`]: writes every episode to a dataset. [`policy_mixture`]: policies that share the episodes.
//! - [`starts`] and [`evaluate`]: initial states and goals, and the success rate of a policy from them.
//! - [`request`]: all settings of an evaluation as one value. [`runner`] evaluates the policies of a request on the
//!   same starts, [`reproduce()`] repeats an evaluation from its results, and [`replay`] some of its episodes.
//! - [`baselines`]: policies that need no training and show what a success rate means.
//! - [`until`]: evaluates more and more starts until a rule is met.
//! - [`study`]: many evaluations with one table.
//! - [`prediction`]: the prediction errors of a model on recorded trajectories.
//!
//! An episode depends only on its key: neither on the number of environments or threads, nor on earlier episodes in the
//! same slot.

mod action_noise;
pub mod baselines;
pub mod collect;
pub mod continuation;
pub mod evaluate;
mod frame_strip;
mod nearest;
mod parts;
mod played;
pub mod policy_mixture;
pub mod prediction;
pub mod replay;
pub mod reproduce;
pub mod request;
pub mod runner;
mod seeding;
pub mod starts;
mod starts_hash;
pub mod study;
mod success_criterion;
pub mod until;
mod video_recording;
pub mod world;

pub use baselines::{NoOpPolicy, ReplayPolicy};
pub use collect::{CollectConfig, Collected};
pub use evaluate::EvalConfig;
pub use frame_strip::frame_strip;
pub use nearest::NearestPolicy;
pub use policy_mixture::{MixturePolicy, PolicyChoice, WeightedPolicy};
pub use prediction::Predictor;
pub use replay::{Recorded, Replay};
pub use reproduce::{Difference, Reproduction, reproduce, reproduce_episodes};
pub use request::{Choice, Condition, EndCost, EvalRequest, HeldOut, Model, PolicyKind, PolicyRequest, StartsRequest};
pub use runner::{PROBE_DATASET, ResolvedPolicy, Resolver, RunOptions};
pub use seeding::{episode_key, reset_seed};
pub use starts::Starts;
pub use study::{AnyStudy, Cell, Common, Measured, Study, StudyFolder, TableCell, TableStudy};
pub use video_recording::{STAGED, Videos, publish};
pub use world::{World, WorldConfig};
