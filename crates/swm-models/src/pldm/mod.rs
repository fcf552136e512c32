//! PLDM (Sobal et al. 2025, arXiv 2502.14819): the encoder and predictor of a LeWM, trained with variance, covariance,
//! temporal alignment and inverse-dynamics terms. See `docs/models/pldm.md`.

mod family;
pub mod import;
pub mod loss;
pub mod model;
pub mod step;
mod train;

pub use family::{ENTRY, cost};
pub use loss::{PldmLoss, Terms};
pub use model::{Idm, Pldm};
