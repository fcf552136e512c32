//! Operations on whole datasets of any format: convert, examine and repair, preview.

pub mod convert;
pub mod doctor;
pub mod preview;
mod save_replay;
