//! Operations on whole datasets of any format: convert, examine and repair, preview, find colours.

mod colours;
pub mod convert;
pub mod doctor;
pub mod preview;
mod save_replay;

pub use colours::frequent_colours;
