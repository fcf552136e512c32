//! An inverse-dynamics policy: which actions lead from one latent to another, learnt on a frozen encoder.
//!
//! A network is shown the latents of a frame and of one up to `offset` model steps later, and predicts the actions
//! between the first frame and the next (mean squared error, normalised actions). Acting, the later latent is the goal's:
//! no model is rolled out and nothing is searched, so a decision costs one encoding. It is the cheap baseline beside a
//! planner that uses the same latents. The idea is old (Jordan and Rumelhart 1992, "distal teacher"; as a zero-shot visual
//! goal policy, Pathak et al. 2018); PLDM and the paper's benchmark use such a model as a term or a probe.

mod checkpoint;
mod policy;
mod train;

pub use checkpoint::InverseCheckpoint;
pub use policy::InversePolicy;
pub use train::{InverseConfig, train};
