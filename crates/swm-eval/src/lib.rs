//! Policies in worlds: [`World`] plays episodes, and what is done with them has a file each.
//!
//! - [`world`]: many environments, one policy, and the loop both uses below share.
//! - [`collect`]: every episode goes to a dataset, in the order of its number.
//! - [`starts`] and [`evaluate`]: from where to play and towards which goal, and how often it is reached.
//! - [`request`], [`runner`] and [`reproduce`]: all that decides an evaluation as one value, running it for several
//!   policies on the same starts, and running it again.
//! - [`prediction`]: how well a model predicts what was recorded, beside whether its plans succeeded.
//!
//! An episode is decided by its own key. Neither the number of environments, nor that of threads, nor what
//! was played before in the same slot changes a byte of it.

pub mod collect;
pub mod evaluate;
mod filming;
mod judge;
pub mod prediction;
pub mod reproduce;
pub mod request;
pub mod runner;
pub mod starts;
mod witness;
pub mod world;

pub use collect::{CollectConfig, Collected};
pub use evaluate::EvalConfig;
pub use filming::Videos;
pub use prediction::Predictor;
pub use reproduce::{Difference, Reproduction, reproduce};
pub use request::{Acts, Choice, Condition, EvalRequest, HeldOut, Model, PolicyRequest, StartsRequest};
pub use runner::{Actor, Means, Moment, Resolver};
pub use starts::Starts;
pub use world::{World, WorldConfig};
