//! Tests that actions of every kind of space reach the environment unchanged.

use crate::play::{RecordedEnv, make};
use crate::{config, id};
use swm_core::{Action, DType, ResetOptions, Space};

#[test]
fn actions_of_every_space_reach_the_environment() {
    let Some(config) = config() else { return };
    let multi = |nvec: &[i64]| Space::MultiDiscrete { nvec: nvec.to_vec(), start: vec![0; nvec.len()] };
    let cases: [(&str, Space, &[i64]); 5] = [
        ("discrete", Space::Discrete { n: 3, start: -1 }, &[-1]),
        ("multi", multi(&[2, 3]), &[1, 2]),
        ("binary", multi(&[2, 2, 2]), &[1, 0, 1]),
        ("integer_box", multi(&[3, 3, 3, 3]), &[0, 1, 2, 2]),
        ("tuple", multi(&[2, 3, 4]), &[1, 2, 3]),
    ];
    for (kind, space, action) in cases {
        let mut env = RecordedEnv::of(make(&format!("tests.it.environments:Choices-v0,kind={kind}"), &config));
        assert_eq!(env.env.spec().action_space, space, "{kind}");
        env.env.reset(0, &ResetOptions::default()).expect("resetting the environment");
        env.env.step(Action::Discrete(action)).unwrap_or_else(|error| panic!("{kind}: {error}"));
        let observed = env.column("observation");
        let expected: Vec<f64> = action.iter().map(|&choice| choice as f64).collect();
        assert_eq!(observed[..expected.len()], expected, "{kind}");
    }
    // A dictionary of boxes becomes one box.
    let mut env = RecordedEnv::of(make("tests.it.environments:Choices-v0,kind=dict", &config));
    let (low, high) = (vec![-1.0, -1.0, 0.0], vec![1.0, 1.0, f64::INFINITY]);
    assert_eq!(env.env.spec().action_space, Space::Box { shape: vec![3], dtype: DType::Float32, low, high });
    env.env.reset(0, &ResetOptions::default()).expect("resetting the environment");
    env.env.step(Action::Continuous(&[0.5, -0.25, 3.0])).expect("stepping the environment");
    assert_eq!(env.column("observation")[..3], [0.5, -0.25, 3.0]);
    let error = swm_gym::make(&id("tests.it.environments:Choices-v0,kind=mixed"), config.clone())
        .err()
        .expect("the call must fail");
    assert!(error.to_string().contains("wrap the environment"), "{error}");
    let rgb = &mut [0; 3];
    let error =
        env.env.render(swm_core::FrameMut::new(1, 1, rgb)).expect_err("an environment without rendering").to_string();
    assert!(error.contains("render"), "{error}");
}
