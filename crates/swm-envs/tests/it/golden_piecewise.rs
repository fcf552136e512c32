//! Piecewise against rollouts of the Python reference.

use crate::golden::{self, Golden, picture_difference};
use swm_core::{Action, Batch, Env, FrameMut, ResetOptions, Schema};

fn close(what: &str, got: &[f64], wanted: &[f64]) {
    let apart = got.iter().zip(wanted).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(got.len() == wanted.len() && apart <= 1e-5, "{what}: {got:?}, not {wanted:?}");
}

fn frame(env: &mut dyn Env) -> Vec<u8> {
    let mut rgb = vec![0; 224 * 224 * 3];
    env.render(FrameMut::new(224, 224, &mut rgb)).expect("a picture");
    rgb
}

#[test]
fn rollouts_follow_the_reference() {
    let files = golden::files("swm_Piecewise-v0-");
    assert!(files.len() >= 6, "the files beside this test are always there");
    for file in files {
        let mut golden = Golden::open(&file);
        let name = file.display();
        let [states, goals, observations, distances] =
            ["info.state", "info.goal_state", "obs", "info.distance_to_target"].map(|array| golden.read::<f64>(array));
        let options = ResetOptions {
            variation: golden.variation(),
            state: Some(states[..2].to_vec()),
            goal_state: Some(goals[..2].to_vec()),
        };
        let mut env = swm_envs::piecewise::ENTRY.env().expect("an environment");
        env.reset(0, &options).expect("recorded values are possible");

        let difference = picture_difference(&frame(&mut *env), &golden.read("frame_first"));
        assert!(difference <= 3.0, "{name}: first frame differs by {difference}");

        let mut row = Batch::zeros(&Schema::new(env.spec().columns.clone()).expect("a schema"), 1);
        let mut follows = |env: &dyn Env, t: usize| {
            env.observe(&mut row.row_mut(0));
            let at = |column| row.row(0).to_f64(column).expect("a column");
            close(&format!("{name}, state {t}"), &at("state"), &states[2 * t..][..2]);
            close(&format!("{name}, proprio {t}"), &at("proprio"), &states[2 * t..][..2]);
            close(&format!("{name}, goal {t}"), &at("goal_state"), &goals[2 * t..][..2]);
            close(&format!("{name}, observation {t}"), &at("observation"), &observations[4 * t..][..4]);
            close(&format!("{name}, distance {t}"), &at("distance_to_target"), &distances[t..=t]);
        };
        follows(&*env, 0);
        let (rewards, terminations) = (golden.read::<f64>("reward"), golden.read::<bool>("terminated"));
        for (t, action) in golden.read::<f32>("action").chunks_exact(2).enumerate() {
            let transition = env.step(Action::Continuous(action)).expect("a step");
            follows(&*env, t + 1);
            assert_eq!(transition.reward, rewards[t], "{name}, reward {t}");
            assert_eq!(transition.terminated, terminations[t], "{name}, terminated {t}");
        }

        let difference = picture_difference(&frame(&mut *env), &golden.read("frame_last"));
        assert!(difference <= 3.0, "{name}: last frame differs by {difference}");
    }
}
