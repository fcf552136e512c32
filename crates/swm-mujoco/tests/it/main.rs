//! Integration tests: golden rollouts of the Python reference, and the conformance suite. They need the installed
//! assets.

mod allocation;
mod conformance;
mod golden;
mod link;
mod locale;
mod no_gl;
mod play;
mod readout;
#[path = "../../src/render/similarity.rs"]
mod similarity;
mod views;
