//! Solvers on problems whose answers are known.
#![allow(missing_docs, clippy::cast_possible_truncation, clippy::cast_precision_loss)]

mod golden;
mod gradient;
mod keyed;
mod lqr;
mod mpc;
mod objective;
mod perfect;
mod sampling;
mod simulator;
mod solvers;
mod toys;
