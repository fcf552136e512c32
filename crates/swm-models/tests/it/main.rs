//! Integration tests: parity with the published models, training, checkpoints.

#![allow(clippy::print_stdout)] // the measured errors, for `--no-capture`

mod checkpoints;
mod dots;
mod golden;
mod online;
mod planning;
mod reference;
mod training;
