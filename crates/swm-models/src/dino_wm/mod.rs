//! DINO-WM (Zhou et al. 2024, arXiv 2411.04983): a predictor of the next frame's patches in the features of a frozen
//! encoder. See `docs/models/dino-wm.md`.

pub mod config;
pub mod cost;
mod family;
pub mod import;
pub mod model;
pub mod predictor;
pub mod step;
mod train;

pub use config::{ColumnConfig, DinoWmConfig};
pub use cost::DinoWmCost;
pub use family::ENTRY;
pub use model::{ColumnEncoder, DinoWm, PatchDecoder};
pub use predictor::{FramePredictor, FramePredictorConfig};
pub use train::DinoWmLoss;
