//! Classic control compared with rollouts of the Python reference, which wraps the environments of Gymnasium.

use swm_conformance::golden::{self, Golden, image_difference};
use swm_core::{Action, Batch, Env, FrameMut, ResetOptions, Schema, Space};

fn frame(env: &mut dyn Env, (width, height): (usize, usize)) -> Vec<u8> {
    let mut rgb = vec![0; width * height * 3];
    env.render(FrameMut::new(width, height, &mut rgb)).expect("rendering a frame");
    rgb
}

/// Replays every rollout of an environment; `size` is the width and height at which the reference draws it.
fn follow(id: &str, size: (usize, usize)) {
    let files = golden::files(env!("CARGO_MANIFEST_DIR"), &format!("{}-", id.replace('/', "_")));
    assert!(files.len() >= 2, "the golden files in `tests/golden` are missing");
    for file in files {
        let mut golden = Golden::open(&file);
        let name = file.display();
        let mut env = swm_envs::ENVS.get(id).expect("finding the environment").env().expect("creating the environment");
        let mut row = Batch::zeros(&Schema::new(env.spec().columns.clone()).expect("creating the schema"), 1);
        let states = golden.read::<f64>("info.state");
        // Some files contain the start state in double precision.
        let exact = golden.has("start");
        let n = env.spec().columns[0].len();
        let options = ResetOptions {
            variation: golden.variation(),
            state: Some(if exact { golden.read("start") } else { states[..n].to_vec() }),
            ..ResetOptions::default()
        };
        env.reset(0, &options).expect("resetting to the recorded start");
        let first = image_difference(&frame(&mut *env, size), &golden.read("frame_first"));

        let (rewards, terminations) = (golden.read::<f64>("reward"), golden.read::<bool>("terminated"));
        let discrete = matches!(env.spec().action_space, Space::Discrete { .. });
        let choices = if discrete { golden.read::<i64>("action") } else { vec![] };
        let values = if discrete { vec![] } else { golden.read::<f32>("action") };
        for t in 0..rewards.len() {
            let action = if discrete { Action::Discrete(&choices[t..=t]) } else { Action::Continuous(&values[t..=t]) };
            let transition = env.step(action).expect("stepping the environment");
            env.observe(&mut row.row_mut(0));
            let state = row.row(0).to_f64("state").expect("reading the column");
            let expected = &states[n * (t + 1)..][..n];
            let error = state.iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            assert!(error <= 1e-5, "{name}, state {t}: {state:?}, expected {expected:?}");
            let error = (transition.reward - rewards[t]).abs();
            assert!(error <= 1e-5, "{name}, reward {t}: {}, expected {}", transition.reward, rewards[t]);
            assert_eq!(transition.terminated, terminations[t], "{name}, terminated {t}");
        }
        let last = image_difference(&frame(&mut *env, size), &golden.read("frame_last"));
        assert!(first <= 0.2 && last <= 0.2, "{name}: frames differ by {first} and {last}");
    }
}

#[test]
fn cart_pole_follows_the_reference() {
    follow("swm/CartPoleControl-v1", (600, 400));
}

#[test]
fn mountain_car_follows_the_reference() {
    follow("swm/MountainCarControl-v0", (600, 400));
    follow("swm/MountainCarContinuousControl-v0", (600, 400));
}

#[test]
fn acrobot_follows_the_reference() {
    follow("swm/AcrobotControl-v1", (500, 500));
}

#[test]
fn pendulum_follows_the_reference() {
    follow("swm/PendulumControl-v1", (500, 500));
}
