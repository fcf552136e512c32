//! Checks that snapshots and dataset rows restore an environment.

use super::probe::{Probe, all_varied, frame_difference};
use crate::Suite;
use swm_core::columns::{STATE, flat_factor};
use swm_core::{Batch, ColumnSpec, DType, Key, ResetOptions, Schema, Snapshot, VariationRequest};

/// Checks that the steps after a restore equal the steps after the snapshot, bit for bit.
pub fn restores_snapshot_bit_for_bit(suite: &Suite) {
    for entry in suite.rows {
        for (seed, options) in [(0, ResetOptions::default()), (1, all_varied()), (2, all_varied())] {
            let key = Key::new(seed);
            let mut probe = Probe::reset(suite, entry, seed, &options);
            (0..5).for_each(|t| {
                probe.step(key, t);
            });
            probe.env.sample_goal(key).expect("sampling a goal");
            let snapshot = probe.env.snapshot();
            let follow = |probe: &mut Probe| {
                let mut outputs = probe.all_outputs();
                for t in 5..5 + suite.steps {
                    let transition = probe.step(key, t);
                    outputs.extend(transition.reward.to_le_bytes());
                    outputs.extend([u8::from(transition.terminated), u8::from(transition.truncated)]);
                    outputs.extend(probe.all_outputs());
                }
                outputs
            };
            let expected = follow(&mut probe);
            let mut other = Probe::reset(suite, entry, 77, &all_varied());
            for (probe, name) in
                [(&mut probe, "the same"), (&mut other, "another"), (&mut Probe::new(suite, entry), "a new")]
            {
                probe.env.restore(&snapshot).expect("restoring the snapshot");
                assert!(
                    probe.env.snapshot() == snapshot,
                    "{}: {name} environment has another snapshot after the restore",
                    entry.id
                );
                assert!(follow(probe) == expected, "{}: {name} environment continues differently", entry.id);
            }
            let factors = |probe: &Probe| probe.env.factors().iter().map(|(_, v)| v.to_vec()).collect::<Vec<_>>();
            assert_eq!(factors(&probe), factors(&other), "{}: factors are part of the state", entry.id);
        }
        let mut probe = Probe::reset(suite, entry, 0, &ResetOptions::default());
        let valid = probe.env.snapshot().0;
        for bytes in [vec![], b"another env".to_vec(), valid[..valid.len() - 1].to_vec()] {
            assert!(probe.env.restore(&Snapshot(bytes)).is_err(), "{}: accepts an invalid snapshot", entry.id);
        }
    }
}

/// A dataset row of a probe: its state and all factors, in `dtype`.
fn dataset_row(probe: &mut Probe, dtype: DType) -> Batch {
    let mut values = vec![(STATE.to_owned(), probe.column(STATE))];
    values.extend(probe.env.factors().iter().map(|(key, value)| (flat_factor(key), value.to_vec())));
    let columns: Vec<ColumnSpec> =
        values.iter().map(|(name, value)| ColumnSpec::new(name.clone(), dtype, [value.len()])).collect();
    let mut row = Batch::zeros(&Schema::new(columns).expect("creating the schema"), 1);
    for (name, value) in &values {
        if dtype == DType::Float64 {
            row.get_mut(name).expect("accessing the column").copy_from_slice(value);
        } else {
            let value: Vec<f32> = value.iter().map(|&v| v as f32).collect();
            row.get_mut(name).expect("accessing the column").copy_from_slice(&value);
        }
    }
    row
}

/// Checks that restoring a dataset row restores the state, the factors, the frame and the goal frame.
pub fn dataset_rows_restore_state_and_factors(suite: &Suite) {
    for entry in suite.rows {
        for seed in 0..suite.restored_rows {
            let (id, key) = (entry.id, Key::new(seed));
            let mut probe = Probe::reset(suite, entry, seed, &all_varied());
            let start = probe.column(STATE);
            let [exact, single] = [DType::Float64, DType::Float32].map(|dtype| dataset_row(&mut probe, dtype));
            (0..8).for_each(|t| {
                probe.step(key, t);
            });
            let goal = dataset_row(&mut probe, DType::Float64);
            // The expected environment also has the goal of the dataset row, because frames may show the goal.
            let factors = probe.env.factors().iter().map(|(key, value)| (key.to_owned(), value.to_vec()));
            let variation = VariationRequest { variation: Some(vec![]), variation_values: factors.collect() };
            let options = ResetOptions { variation, state: Some(start.clone()), goal_state: Some(probe.column(STATE)) };
            let mut expected = Probe::reset(suite, entry, seed, &options);
            let mut other = Probe::new(suite, entry);
            for (row, tolerance) in [(&exact, 0.0), (&single, 1e-4)] {
                other.env.restore_from(row.row(0), goal.row(0)).unwrap_or_else(|error| panic!("{id}: {error}"));
                let difference = other.column(STATE).iter().zip(&start).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
                assert!(difference <= tolerance, "{id}, seed {seed}: the state differs by {difference}");
                for ((key, got), (_, expected)) in other.env.factors().iter().zip(expected.env.factors().iter()) {
                    let difference = got.iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
                    assert!(difference <= tolerance, "{id}, seed {seed}: {key} is {got:?}, not {expected:?}");
                }
                let frames = [(other.frame(), expected.frame()), (other.goal_frame(), expected.goal_frame())];
                for (frame, expected) in frames {
                    let difference = frame_difference(&frame, &expected);
                    assert!(difference < 1.0, "{id}, seed {seed}: the frame differs by {difference} of 255");
                }
            }
        }
        let no_state = Batch::zeros(
            &Schema::new([ColumnSpec::new("position", DType::Float64, [2])]).expect("creating the schema"),
            1,
        );
        let error = Probe::new(suite, entry)
            .env
            .restore_from(no_state.row(0), no_state.row(0))
            .expect_err("a row without a state");
        assert!(error.to_string().contains(STATE), "{}: {error}", entry.id);
    }
}
