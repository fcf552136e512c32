//! Recorded iterations of the reference's sampling solvers, for tests of single updates.
//!
//! The recordings are in `tests/golden/updates.json`; `tests/golden/export_updates.py` writes this file.

use super::{Bounds, Elites, Gaussian};
use serde::Deserialize;
use std::collections::BTreeMap;
use swm_core::PlanTrace;

pub const HORIZON: usize = 4;
pub const DIM: usize = 2;
pub const ELITES: usize = 5;

/// One iteration of a reference solver with 16 samples.
#[derive(Default, Deserialize)]
#[serde(default)]
pub struct Update {
    pub noise: Vec<f32>,
    pub candidates: Vec<f32>,
    pub costs: Vec<f32>,
    /// The mean of the sampling distribution after the iteration.
    pub mean: Vec<f32>,
    /// The standard deviation after the iteration, which the reference calls `var`.
    pub var: Vec<f32>,
    /// The probabilities of discrete actions after the iteration.
    pub probs: Vec<f32>,
}

impl Update {
    /// Returns the elites of the recorded candidates.
    pub fn elites<'a>(&'a self, order: &'a mut Vec<usize>) -> Elites<'a> {
        Elites::select(&self.candidates, &self.costs, ELITES, order)
    }
}

/// The recorded iterations of a solver.
pub fn updates(solver: &str) -> Vec<Update> {
    let text = include_str!("../../tests/golden/updates.json");
    let mut all: BTreeMap<String, Vec<Update>> = serde_json::from_str(text).expect("updates.json is valid");
    all.remove(solver).expect("updates.json has an entry for this solver")
}

/// The initial distribution of the reference's Gaussian solvers.
pub fn initial() -> Gaussian {
    let (mean, std) = (vec![0.0; HORIZON * DIM], vec![1.0; HORIZON * DIM]);
    Gaussian { mean, std, trace: PlanTrace::default(), order: vec![] }
}

/// Returns the candidates that the solvers of this crate compute from the recorded noise.
pub fn candidates(update: &Update, gaussian: &Gaussian, bound: f32) -> Vec<f32> {
    let mut candidates = update.noise.clone();
    for candidate in candidates.chunks_exact_mut(HORIZON * DIM) {
        gaussian.scale(candidate);
    }
    candidates[..HORIZON * DIM].copy_from_slice(&gaussian.mean);
    Bounds { low: &[-bound; DIM], high: &[bound; DIM] }.clip(&mut candidates);
    candidates
}

/// Asserts that the values equal the values of the reference up to 1e-5.
pub fn assert_near(ours: &[f32], theirs: &[f32]) {
    assert_eq!(ours.len(), theirs.len());
    for (ours, theirs) in ours.iter().zip(theirs) {
        assert!((ours - theirs).abs() < 1e-5, "{ours}, the reference: {theirs}");
    }
}
