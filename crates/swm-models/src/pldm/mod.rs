//! PLDM (Sobal et al. 2025, arXiv 2502.14819): encoder and predictor of a LeWM, kept from collapsing by variance and
//! covariance, and in order by temporal alignment and inverse dynamics. See `docs/models/pldm.md`.

mod family;
pub mod import;
pub mod loss;
pub mod model;
pub mod step;
mod train;

pub use family::{ENTRY, cost};
pub use loss::{PldmLoss, Terms};
pub use model::{Idm, Pldm};
