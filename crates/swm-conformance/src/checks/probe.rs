//! [`Probe`]: one environment of the suite with its observation row, and helpers that all checks use.

use crate::Suite;
use swm_core::{Action, Batch, Env, EnvEntry, FrameMut, Key, ResetOptions, Schema, Space, VariationRequest};

/// A request that samples the factors and groups `keys`.
pub(super) fn vary(keys: &[&str]) -> VariationRequest {
    VariationRequest {
        variation: Some(keys.iter().map(|&key| key.to_owned()).collect()),
        ..VariationRequest::default()
    }
}

/// Reset options that sample all factors.
pub(super) fn all_varied() -> ResetOptions {
    ResetOptions { variation: vary(&["all"]), ..ResetOptions::default() }
}

/// An environment with a row for its observations.
pub(super) struct Probe {
    /// The environment.
    pub env: Box<dyn Env>,
    /// The last observation, a batch of one row.
    pub row: Batch,
    /// Height and width of the frames, in pixels.
    size: (usize, usize),
}

impl Probe {
    /// Creates the environment of `entry`, not yet reset.
    pub fn new(suite: &Suite, entry: &EnvEntry) -> Self {
        let env = entry.env().unwrap_or_else(|error| panic!("{}: {error}", entry.id));
        let schema = Schema::new(env.spec().columns.clone()).expect("creating the schema");
        Self { env, row: Batch::zeros(&schema, 1), size: suite.frame_size }
    }

    /// Creates the environment of `entry` and resets it.
    pub fn reset(suite: &Suite, entry: &EnvEntry, seed: u64, options: &ResetOptions) -> Self {
        let mut probe = Self::new(suite, entry);
        probe.env.reset(seed, options).unwrap_or_else(|error| panic!("{}, seed {seed}: {error}", entry.id));
        probe
    }

    /// Observes the environment and returns the elements of a column.
    pub fn column(&mut self, name: &str) -> Vec<f64> {
        self.env.observe(&mut self.row.row_mut(0));
        self.row.row(0).to_f64(name).expect("a declared column")
    }

    /// Observes the environment and returns the row.
    pub fn observed(&mut self) -> &Batch {
        self.env.observe(&mut self.row.row_mut(0));
        &self.row
    }

    /// Renders the current state, `[height, width, 3]`.
    pub fn frame(&mut self) -> Vec<u8> {
        let (height, width) = self.size;
        let mut rgb = vec![0; height * width * 3];
        self.env.render(FrameMut::new(width, height, &mut rgb)).expect("rendering a frame");
        rgb
    }

    /// Renders the goal, `[height, width, 3]`.
    pub fn goal_frame(&mut self) -> Vec<u8> {
        let (height, width) = self.size;
        let mut rgb = vec![0; height * width * 3];
        self.env.render_goal(FrameMut::new(width, height, &mut rgb)).expect("rendering the goal");
        rgb
    }

    /// Steps with the `t`-th action of a random sequence.
    pub fn step(&mut self, key: Key, t: u64) -> swm_core::Transition {
        self.act(&self.env.spec().action_space.sample(&mut key.at(t).rng()))
    }

    /// Steps with `action`, `[dim]`, converted to the type of the action space.
    pub fn act(&mut self, action: &[f64]) -> swm_core::Transition {
        let values: Vec<f32> = action.iter().map(|&v| v as f32).collect();
        let integers: Vec<i64> = action.iter().map(|&v| v as i64).collect();
        let action = match self.env.spec().action_space {
            Space::Box { .. } => Action::Continuous(&values),
            _ => Action::Discrete(&integers),
        };
        self.env.step(action).expect("stepping the environment")
    }

    /// The observation, the frame, the goal frame and the success flag, as bytes.
    pub fn all_outputs(&mut self) -> Vec<u8> {
        let mut bytes = bytes_of(self.observed());
        bytes.extend(self.frame());
        bytes.extend(self.goal_frame());
        bytes.push(u8::from(self.env.is_success()));
        bytes
    }
}

/// The mean absolute difference of two frames, in units of 1/255.
pub(super) fn frame_difference(a: &[u8], b: &[u8]) -> f64 {
    assert_eq!(a.len(), b.len(), "the frames must have equal sizes");
    a.iter().zip(b).map(|(&a, &b)| f64::from(a.abs_diff(b))).sum::<f64>() / a.len() as f64
}

/// All bytes of a batch, column by column.
pub(super) fn bytes_of(batch: &Batch) -> Vec<u8> {
    (0..batch.schema().columns().len()).flat_map(|column| batch.bytes(column)).copied().collect()
}

/// Asserts that the first row is finite; `label` names the row in the message.
pub(super) fn assert_finite(batch: &Batch, label: &str) {
    for column in batch.schema().columns() {
        let value = batch.row(0).to_f64(&column.name).expect("reading the column");
        assert!(value.iter().all(|v| v.is_finite()), "{label}: {} = {value:?}", column.name);
    }
}
