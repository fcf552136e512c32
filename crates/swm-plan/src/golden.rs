//! What the reference's sampling solvers did with given noise, for tests of single updates: `tests/golden/updates.json`,
//! which `export_updates.py` beside it wrote.

use crate::problem::Bounds;
use crate::sampling::{Belief, Population, place};
use serde::Deserialize;
use std::collections::BTreeMap;
use swm_core::PlanTrace;

pub const HORIZON: usize = 4;
pub const DIM: usize = 2;
pub const ELITES: usize = 5;

/// One iteration of the reference, of 16 samples.
#[derive(Deserialize)]
#[serde(default)]
#[derive(Default)]
pub struct Update {
    pub noise: Vec<f32>,
    pub candidates: Vec<f32>,
    pub costs: Vec<f32>,
    /// The distribution after it.
    pub mean: Vec<f32>,
    pub var: Vec<f32>,
    pub probs: Vec<f32>,
}

impl Update {
    pub fn population(&self) -> Population<'_> {
        Population::new(&self.candidates, &self.costs)
    }
}

/// The iterations of a solver.
pub fn updates(solver: &str) -> Vec<Update> {
    let text = include_str!("../tests/golden/updates.json");
    let mut all: BTreeMap<String, Vec<Update>> = serde_json::from_str(text).expect("updates");
    all.remove(solver).expect("a solver")
}

/// Where its Gaussian solvers began.
pub fn begin() -> Belief {
    let (mean, std) = (vec![0.0; HORIZON * DIM], vec![1.0; HORIZON * DIM]);
    Belief { mean, std, trace: PlanTrace::default(), order: vec![] }
}

/// The candidates that our solvers make of the reference's noise.
pub fn candidates(update: &Update, belief: &Belief, bound: f32) -> Vec<f32> {
    let mut candidates = update.noise.clone();
    for candidate in candidates.chunks_exact_mut(HORIZON * DIM) {
        place(candidate, belief);
    }
    candidates[..HORIZON * DIM].copy_from_slice(&belief.mean);
    Bounds { low: &[-bound; DIM], high: &[bound; DIM] }.clip(&mut candidates);
    candidates
}

pub fn assert_near(ours: &[f32], theirs: &[f32]) {
    assert_eq!(ours.len(), theirs.len());
    for (ours, theirs) in ours.iter().zip(theirs) {
        assert!((ours - theirs).abs() < 1e-5, "{ours}, the reference: {theirs}");
    }
}
