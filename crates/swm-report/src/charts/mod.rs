//! The charts of evaluations, drawn with `plot`.
//!
//! `rows` draws points with intervals, one row each; `curves` draws curves in panels; the other files say what is drawn.

pub(crate) mod autopsy;
mod axis;
mod curves;
pub(crate) mod episodes;
pub(crate) mod gaps;
pub(crate) mod latency;
pub(crate) mod learning;
pub(crate) mod paired;
pub(crate) mod prediction;
mod rows;
pub(crate) mod searches;
pub(crate) mod success;
#[cfg(test)]
mod tests;
pub(crate) mod time_to_goal;
pub(crate) mod training;
