//! Solvers on problems whose answers are known.
#![allow(missing_docs, reason = "the items of a test program are private")]

mod golden;
mod gradient;
mod keyed;
mod lqr;
mod mpc;
mod objective;
mod observing;
mod perfect;
mod sampling;
mod simulator;
mod solvers;
mod toys;
mod true_dynamics;
