//! Probes: what a frozen encoder's latents say about the world.
//!
//! - [`state`](mod@state): read-outs of the columns of a dataset from latents, [linear](ridge) and by a small network, judged
//!   on episodes that they were not fitted on.
//! - [`reconstruction`]: the pictures themselves, drawn again from latents.
//!
//! A latent that knows where things are lets a linear map say so; one that a network alone can read holds it folded; what
//! neither reads is lost, and no planner can use it.

mod fit;
pub mod reconstruction;
pub mod ridge;
mod samples;
mod scale;
pub mod state;

pub use reconstruction::{ReconstructionConfig, ReconstructionReport, reconstruct_images};
pub use state::{Score, StateConfig, StateReport, read_state};

use swm_core::Result;

/// An encoder from pictures to latents.
pub trait ImageEncoder: Send + Sync {
    /// The side of the square pictures it sees, in pixels.
    fn image_size(&self) -> usize;

    /// Numbers in a latent: all patches, where it has patches.
    fn latent_dim(&self) -> usize;

    /// The latents of pictures.
    ///
    /// # Shapes
    /// `[frames, image, image, 3]` bytes to `[frames, latent]`.
    ///
    /// # Errors
    /// When the bytes are not whole pictures.
    fn encode(&self, rgb: &[u8]) -> Result<Vec<f32>>;
}
