//! Probes: how much of the state of an environment a frozen encoder's latents contain.
//!
//! - [`state`]: regression of the columns of a dataset on latents, [linear](ridge) and with a small network, scored on
//!   held-out episodes.
//! - [`reconstruction`]: the images, reconstructed from latents.
//!
//! A state that a linear map reads is represented linearly; one that only the network reads, nonlinearly. A planner
//! cannot use what neither reads.

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
    /// The side of its square images, in pixels.
    fn image_size(&self) -> usize;

    /// The dimension of a latent; for an encoder of patches, that of all patches together.
    fn latent_dim(&self) -> usize;

    /// Encodes images.
    ///
    /// # Shapes
    /// `[frames, image_size, image_size, 3]` bytes to `[frames, latent_dim]`.
    ///
    /// # Errors
    /// When the bytes are not whole images.
    fn encode(&self, rgb: &[u8]) -> Result<Vec<f32>>;
}
