//! Integration tests: golden rollouts of the Python reference, and what every environment must keep. They need the assets.

mod conformance;
mod golden;
mod recorded;
mod views;
