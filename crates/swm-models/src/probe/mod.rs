//! Probes, which measure the information about an environment's state in the latents of a frozen encoder.
//!
//! - [`state`]: regression of the columns of a dataset on latents, [linear](ridge) and with a small network, scored on
//!   held-out episodes, and compared with a regression on a baseline such as the position of the agent.
//! - [`StateProbe`]: the same regression for planning by the states that it reads ([`ProbedCost`]).
//! - [`supervised`]: regression of the columns on images with an encoder that is trained with them, a ceiling for latents.
//! - [`reconstruction`]: reconstruction of images from latents.
//!
//! If the linear map predicts a state, the latents represent the state linearly; if only the network predicts the
//! state, the representation is nonlinear. A planner cannot use a state that neither regression predicts.

mod cost;
mod fit;
pub mod reconstruction;
pub mod ridge;
mod samples;
mod scale;
pub mod state;
pub mod supervised;
mod targets;

pub use cost::{ProbedCost, ProbedLatents, StateProbe};
pub use fit::FitConfig;
pub use reconstruction::{
    ImageDecoder, Reconstruction, ReconstructionConfig, ReconstructionReport, reconstruct_images,
};
pub use state::{Baseline, Score, StateConfig, StateReport, read_state};
pub use supervised::{SupervisedReport, train_encoder};
pub use targets::AnglePart;

use swm_core::Result;

/// An encoder of images.
pub trait ImageEncoder: Send + Sync {
    /// Returns the side of the encoder's square images, in pixels.
    fn image_size(&self) -> usize;

    /// Returns the dimension of a latent; for an encoder of patches, the dimension of all patches together.
    fn latent_dim(&self) -> usize;

    /// Encodes images.
    ///
    /// # Shapes
    /// Maps `[frames, image_size, image_size, 3]` bytes to `[frames, latent_dim]`.
    ///
    /// # Errors
    /// When `rgb` is not a whole number of images.
    fn encode(&self, rgb: &[u8]) -> Result<Vec<f32>>;
}
