//! Inverse dynamics: a policy that predicts the actions between two latents of a frozen encoder.
//!
//! In training, the network reads the latents of a frame and of a frame up to `offset` model steps later, and predicts
//! the actions between the first frame and the next (mean squared error of normalised actions). The policy reads the
//! latent of the goal in place of the later frame's latent, so a decision costs one encoding and no search. The policy
//! is a cheap baseline for planners that use the same latents. Sources: Jordan and Rumelhart 1992 ("distal teacher");
//! Pathak et al. 2018 (zero-shot visual imitation). The loss of PLDM has an inverse-dynamics term.

mod checkpoint;
mod family;
mod policy;
mod train;

pub use checkpoint::InverseCheckpoint;
pub use family::{ENTRY, not_resumed};
pub use policy::InversePolicy;
pub use train::{InverseConfig, check_data, train};
