//! The point maze against rollouts of the Python reference.

use crate::golden::{self, Golden, picture_difference};
use swm_core::{Action, Batch, Env, FrameMut, ResetOptions, Schema};

/// Side of the reference's pictures.
const SIDE: usize = 500;

fn close(what: &str, got: &[f64], wanted: &[f64]) {
    let apart = got.iter().zip(wanted).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(got.len() == wanted.len() && apart <= 1e-5, "{what}: {got:?}, not {wanted:?}");
}

fn frame(env: &mut dyn Env) -> Vec<u8> {
    let mut rgb = vec![0; SIDE * SIDE * 3];
    env.render(FrameMut::new(SIDE, SIDE, &mut rgb)).expect("a picture");
    rgb
}

#[test]
fn rollouts_follow_the_reference() {
    let files = golden::files("swm_SimplePointMaze-v0-");
    assert!(files.len() >= 9, "the files beside this test are always there");
    for file in files {
        let mut golden = Golden::open(&file);
        let name = file.display();
        let states = golden.read::<f64>("obs");
        let mut variation = golden.variation();
        // The reference keeps the agent's place in this factor: what was recorded is where it was when they were asked.
        variation.variation_values.insert("agent.position".to_owned(), states[..2].to_vec());
        let mut env = swm_envs::point_maze::ENTRY.env().expect("an environment");
        env.reset(0, &ResetOptions { variation, ..ResetOptions::default() }).expect("recorded values are possible");

        let difference = picture_difference(&frame(&mut *env), &golden.read("frame_first"));
        assert!(difference <= 3.0, "{name}: first frame differs by {difference}");

        let mut row = Batch::zeros(&Schema::new(env.spec().columns.clone()).expect("a schema"), 1);
        let mut follows = |env: &dyn Env, t: usize| {
            env.observe(&mut row.row_mut(0));
            for column in ["state", "observation"] {
                let value = row.row(0).to_f64(column).expect("a column");
                close(&format!("{name}, {column} {t}"), &value, &states[2 * t..][..2]);
            }
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
