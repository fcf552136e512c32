//! Integration tests: golden rollouts of the Python reference, and what every environment must keep. They need the assets.

mod allocation;
mod conformance;
mod golden;
#[path = "../../src/render/likeness.rs"]
mod likeness;
mod link;
mod no_gl;
mod readout;
mod recorded;
mod views;
