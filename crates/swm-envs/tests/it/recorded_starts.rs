//! Episodes that start at recorded rows with sampled factors.

use std::collections::BTreeSet;
use swm_core::{Batch, ColumnSpec, DType, DatasetStart, Env, ResetOptions, Schema, VariationRequest, dataset_start};
use swm_envs::ENVS;

/// A recorded row of Two-Room whose episode began at `position`.
fn row(position: [f64; 2]) -> Batch {
    let column = |name: &str| ColumnSpec::new(name, DType::Float64, [2]);
    let schema = Schema::new([column("state"), column("variation_agent_position")]).expect("a schema");
    let mut row = Batch::zeros(&schema, 1);
    for name in ["state", "variation_agent_position"] {
        row.get_mut(name).expect("a column").copy_from_slice(&position);
    }
    row
}

/// Starts an episode there, with the axis of the wall sampled, and returns the axis.
fn axis(env: &mut dyn Env, position: [f64; 2], seed: u64, request: VariationRequest) -> swm_core::Result<i64> {
    let (start, goal) = (row(position), row([180.0, 180.0]));
    let options = ResetOptions { variation: request, ..ResetOptions::default() };
    let from = DatasetStart { start: start.row(0), goal: goal.row(0), callables: &[] };
    dataset_start::reset(env, seed, &options, from)?;
    assert_eq!(env.factors().get("agent.position"), position);
    Ok(env.factors().integer("wall.axis"))
}

#[test]
fn sampled_factors_fit_the_recorded_start() {
    let mut env = ENVS.get("swm/TwoRoom-v1").and_then(swm_core::EnvEntry::env).expect("an environment");
    let sampled = || VariationRequest { variation: Some(vec!["wall.axis".to_owned()]), ..VariationRequest::default() };
    let mut axes = |position| -> BTreeSet<i64> {
        (0..30).map(|seed| axis(&mut *env, position, seed, sampled()).expect("a start")).collect()
    };
    assert_eq!(axes([60.0, 60.0]), BTreeSet::from([0, 1]), "both walls leave room for this start");
    assert_eq!(axes([70.0, 110.0]), BTreeSet::from([1]), "the horizontal wall would touch this one");
    let pinned =
        VariationRequest { variation: Some(vec![]), variation_values: [("wall.axis".to_owned(), vec![0.0])].into() };
    let error = axis(&mut *env, [70.0, 110.0], 0, pinned).expect_err("a pinned wall is not drawn again").to_string();
    assert!(error.contains("agent.position"), "{error}");
}
