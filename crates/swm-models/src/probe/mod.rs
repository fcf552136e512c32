//! Probes: how much of the state of an environment a frozen encoder's latents contain.
//!
//! - [`state`]: regression of the columns of a dataset on latents, [linear](ridge) and with a small network, scored on
//!   held-out episodes.
//! - [`reconstruction`]: the images, reconstructed from latents.
//!
//! If the linear map predicts a state, the latents represent the state linearly; if only the network predicts the
//! state, the representation is nonlinear. A planner cannot use a state that neither regression predicts.

mod fit;
pub mod reconstruction;
pub mod ridge;
mod samples;
mod scale;
pub mod state;

pub use reconstruction::{ReconstructionConfig, ReconstructionReport, reconstruct_images};
pub use state::{Score, StateConfig, StateReport, read_state};

use swm_core::Result;

/// An encoder of images.
pub trait ImageEncoder: Send + Sync {
    /// The side of the encoder's square images, in pixels.
    fn image_size(&self) -> usize;

    /// The dimension of a latent; for an encoder of patches, the dimension of all patches together.
    fn latent_dim(&self) -> usize;

    /// Encodes images.
    ///
    /// # Shapes
    /// Maps `[frames, image_size, image_size, 3]` bytes to `[frames, latent_dim]`.
    ///
    /// # Errors
    /// When the bytes are not whole images.
    fn encode(&self, rgb: &[u8]) -> Result<Vec<f32>>;
}
