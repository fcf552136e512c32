//! Integration tests: parity with the published models, training, checkpoints.

#![allow(clippy::print_stdout, reason = "the measured errors, for `--no-capture`")]

mod checkpoints;
mod config;
mod dino_wm;
mod dots;
mod gcrl;
mod golden;
mod hostile;
mod hub;
mod online;
mod planning;
mod pldm;
mod reference;
mod training;
