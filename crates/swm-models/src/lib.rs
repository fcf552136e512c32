//! World models and their training.

pub mod lewm;
pub mod nn;
