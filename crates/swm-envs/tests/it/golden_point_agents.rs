//! Two-Room, SimplePointMaze and Piecewise compared with rollouts of the Python reference.

use swm_conformance::golden::{self, Golden, image_difference};
use swm_core::{Action, Batch, Env, EnvEntry, FrameMut, ResetOptions, Schema};

/// The largest tolerated mean difference of a frame, on a scale of 0 to 255.
const FRAME_TOLERANCE: f64 = 3.0;

/// Returns the mean difference between a frame of the environment and a recorded one, on a scale of 0 to 255.
fn frame_difference(env: &mut dyn Env, golden: &mut Golden, name: &str) -> f64 {
    let (height, width, expected) = golden.image(name);
    let mut rgb = vec![0; height * width * 3];
    env.render(FrameMut::new(width, height, &mut rgb)).expect("rendering a frame");
    image_difference(&rgb, &expected)
}

/// Replays every rollout of an environment. `columns` are pairs of a column and the array with its recorded values;
/// `options` reads the reset options of a rollout.
fn follow(entry: &EnvEntry, files: usize, columns: &[(&str, &str)], options: fn(&mut Golden) -> ResetOptions) {
    let found = golden::files(env!("CARGO_MANIFEST_DIR"), &format!("{}-", entry.id.replace('/', "_")));
    assert!(found.len() >= files, "the golden files in `tests/golden` are missing");
    for file in found {
        let mut golden = Golden::open(&file);
        let name = file.display();
        let options = options(&mut golden);
        let expected: Vec<Vec<f64>> = columns.iter().map(|(_, array)| golden.read(array)).collect();
        let mut env = entry.env().expect("creating the environment");
        env.reset(0, &options).expect("resetting to the recorded start");
        let first = frame_difference(&mut *env, &mut golden, "frame_first");

        let mut row = Batch::zeros(&Schema::new(env.spec().columns.clone()).expect("creating the schema"), 1);
        let mut compare = |env: &dyn Env, t: usize| {
            env.observe(&mut row.row_mut(0));
            for ((column, _), expected) in columns.iter().zip(&expected) {
                let values = row.row(0).to_f64(column).expect("reading the column");
                let expected = &expected[values.len() * t..][..values.len()];
                let error = values.iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
                assert!(error <= 1e-5, "{name}, {column} {t}: {values:?}, expected {expected:?}");
            }
        };
        compare(&*env, 0);
        let (rewards, terminations) = (golden.read::<f64>("reward"), golden.read::<bool>("terminated"));
        for (t, action) in golden.read::<f32>("action").chunks_exact(2).enumerate() {
            let transition = env.step(Action::Continuous(action)).expect("stepping the environment");
            compare(&*env, t + 1);
            assert_eq!(transition.reward, rewards[t], "{name}, reward {t}");
            assert_eq!(transition.terminated, terminations[t], "{name}, terminated {t}");
        }

        let last = frame_difference(&mut *env, &mut golden, "frame_last");
        assert!(first <= FRAME_TOLERANCE && last <= FRAME_TOLERANCE, "{name}: frames differ by {first} and {last}");
    }
}

/// The options of a rollout in the room: the recorded factors, start and goal.
fn room_options(golden: &mut Golden) -> ResetOptions {
    let mut first = |array: &str| Some(golden.read::<f64>(array)[..2].to_vec());
    let (state, goal_state) = (first("info.state"), first("info.goal_state"));
    ResetOptions { variation: golden.variation(), state, goal_state }
}

/// The columns of environments in the room.
const ROOM_COLUMNS: &[(&str, &str)] = &[
    ("state", "info.state"),
    ("proprio", "info.state"),
    ("goal_state", "info.goal_state"),
    ("observation", "obs"),
    ("distance_to_target", "info.distance_to_target"),
];

#[test]
fn two_room_follows_the_reference() {
    follow(&swm_envs::two_room::ENTRY, 7, ROOM_COLUMNS, room_options);
}

#[test]
fn piecewise_follows_the_reference() {
    follow(&swm_envs::piecewise::ENTRY, 6, ROOM_COLUMNS, room_options);
}

#[test]
fn point_maze_follows_the_reference() {
    follow(&swm_envs::point_maze::ENTRY, 9, &[("state", "obs"), ("observation", "obs")], |golden| {
        let mut variation = golden.variation();
        // The reference moves this factor with the agent, so the recorded value is not the start position.
        variation.variation_values.insert("agent.position".to_owned(), golden.read::<f64>("obs")[..2].to_vec());
        ResetOptions { variation, ..ResetOptions::default() }
    });
}
