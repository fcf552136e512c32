//! The charts, as SVG elements inside the page.

pub(crate) mod episodes;
pub(crate) mod latency;
pub(crate) mod paired;
pub(crate) mod prediction;
pub(crate) mod searches;
pub(crate) mod success;
mod svg;
pub(crate) mod time_to_goal;
pub(crate) mod training;
