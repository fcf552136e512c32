//! Properties of every wrapper: determinism, snapshots, and no effect on anything but frames.

use super::{SIZE, Varies, applied, make, variants};
use std::collections::BTreeSet;
use swm_core::batch::{Batch, ColumnSpec, DType, Schema};
use swm_core::pool::{Reset, threads};
use swm_core::{Action, Env, EnvPool, FrameMut, Key, ResetOptions, Snapshot, VariationRequest};
use swm_envs::wrappers::{EpisodeFrame, GoalFrame, Stack};
use swm_envs::{ENVS, two_room};

/// Reset options that sample no factor, so that Two-Room does not depend on the seed.
fn fixed_factors() -> ResetOptions {
    let variation = VariationRequest { variation: Some(vec![]), ..VariationRequest::default() };
    ResetOptions { variation, ..ResetOptions::default() }
}

fn wrapped<S: AsRef<str>>(texts: &[S], goal: GoalFrame) -> Box<dyn Env> {
    Stack::parse(texts)
        .expect("parsing the wrappers")
        .wrap(two_room::ENTRY.env().expect("creating the environment"), goal)
}

fn frame(env: &mut dyn Env) -> Vec<u8> {
    let mut rgb = vec![0; 3 * SIZE[0] * SIZE[1]];
    env.render(FrameMut::new(SIZE[0], SIZE[1], &mut rgb)).expect("rendering a frame");
    rgb
}

fn goal_frame(env: &mut dyn Env) -> Vec<u8> {
    let mut rgb = vec![0; 3 * SIZE[0] * SIZE[1]];
    env.render_goal(FrameMut::new(SIZE[0], SIZE[1], &mut rgb)).expect("rendering a frame");
    rgb
}

fn step(env: &mut dyn Env) {
    env.step(Action::Continuous(&[0.5, -0.3])).expect("stepping the environment");
}

#[test]
fn frames_depend_only_on_seed_and_step() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    for (text, varies) in variants(folder.path()) {
        let (mut wrapper, mut other) = (make(&text), make(&text));
        let at = EpisodeFrame::Step;
        let first = applied(&mut *wrapper, SIZE, 1, at(3));
        assert_eq!(first, applied(&mut *wrapper, SIZE, 1, at(3)), "{text}: drawing twice differs");
        // Earlier frames, their size, and the instance do not affect the result.
        applied(&mut *other, [31, 7], 9, at(8));
        applied(&mut *other, SIZE, 2, EpisodeFrame::Goal);
        assert_eq!(first, applied(&mut *other, SIZE, 1, at(3)), "{text}: earlier frames change the result");
        assert_eq!(first, applied(&mut *other.fork(), SIZE, 1, at(3)), "{text}: a fork differs");
        let seeds: BTreeSet<Vec<u8>> = (1..9).map(|seed| applied(&mut *wrapper, SIZE, seed, at(3))).collect();
        let steps: BTreeSet<Vec<u8>> = (0..8).map(|step| applied(&mut *wrapper, SIZE, 1, at(step))).collect();
        let differ = [seeds.len() > 1, steps.len() > 1];
        let expected = match varies {
            Varies::Never => [false, false],
            Varies::PerEpisode => [true, false],
            Varies::PerStep => [true, true],
            Varies::WithStep => [false, true],
        };
        assert_eq!(differ, expected, "{text}: differs between [seeds, steps]");
    }
}

#[test]
fn accepts_frames_of_any_size() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let sizes = [[1, 1], [1, 9], [9, 1], [2, 2], [3, 2], [8, 17], [130, 3], [3, 130], [0, 0], [0, 4], [4, 0]];
    for (text, _) in variants(folder.path()) {
        let mut wrapper = make(&text);
        for size in sizes {
            for which in [EpisodeFrame::Step(0), EpisodeFrame::Step(u64::MAX), EpisodeFrame::Goal] {
                assert_eq!(applied(&mut *wrapper, size, 5, which).len(), 3 * size[0] * size[1], "{text}, {size:?}");
            }
        }
    }
}

#[test]
fn restored_snapshot_continues_bit_for_bit() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let mut texts: Vec<String> = variants(folder.path()).into_iter().map(|(text, _)| text).collect();
    texts.retain(|text| !text.contains("=256"));
    for text in &texts {
        let stack = ["blur,kernel=3", text, "noise,std=linear/0/30/6"];
        let (mut env, mut other) = (wrapped(&stack, GoalFrame::Wrapped), wrapped(&stack, GoalFrame::Wrapped));
        env.reset(3, &fixed_factors()).expect("resetting the environment");
        other.reset(8, &fixed_factors()).expect("resetting the environment");
        (0..3).for_each(|_| step(&mut *env));
        step(&mut *other);
        let snapshot = env.snapshot();
        let follow = |env: &mut dyn Env| {
            let mut frames = vec![env.snapshot().0, frame(env), goal_frame(env)];
            for _ in 0..4 {
                step(env);
                frames.push(frame(env));
            }
            frames
        };
        let expected = follow(&mut *env);
        for env in [&mut *env, &mut *other] {
            env.restore(&snapshot).expect("restoring a snapshot of the same stack");
            assert!(follow(env) == expected, "{text}: a restored environment continues differently");
        }
        let bare = two_room::ENTRY.env().expect("creating the environment").snapshot().0;
        let cut = snapshot.0[..20].to_vec();
        let other_stack = wrapped(&["grayscale"], GoalFrame::Clean).snapshot().0;
        for foreign in [bare, cut, other_stack, vec![]] {
            assert!(env.restore(&Snapshot(foreign)).is_err(), "{text}: a foreign snapshot is refused");
        }
        assert!(
            two_room::ENTRY.env().expect("creating the environment").restore(&snapshot).is_err(),
            "{text}: an unwrapped environment refuses the snapshot"
        );
    }
}

#[test]
fn wrappers_change_only_frames() {
    for entry in ENVS.rows {
        let stack = Stack::parse(&["noise", "occlusion"]).expect("parsing the wrappers");
        let (mut env, mut bare) = (
            stack.wrap(entry.env().expect("creating the environment"), GoalFrame::Clean),
            entry.env().expect("creating the environment"),
        );
        assert_eq!(env.spec().id, bare.spec().id);
        let schema = Schema::new(bare.spec().columns.clone()).expect("creating the schema");
        let [mut wrapped_row, mut bare_row] = [Batch::zeros(&schema, 1), Batch::zeros(&schema, 1)];
        env.reset(4, &ResetOptions::default()).expect("resetting the environment");
        bare.reset(4, &ResetOptions::default()).expect("resetting the environment");
        for goal in 0..3 {
            let key = Key::new(goal);
            assert_eq!(env.sample_goal(key).is_ok(), bare.sample_goal(key).is_ok());
            env.observe(&mut wrapped_row.row_mut(0));
            bare.observe(&mut bare_row.row_mut(0));
            (0..schema.columns().len())
                .for_each(|c| assert_eq!(wrapped_row.bytes(c), bare_row.bytes(c), "{}", entry.id));
            assert_eq!(env.factors().iter().collect::<Vec<_>>(), bare.factors().iter().collect::<Vec<_>>());
            assert_eq!((env.is_success(), env.goal_distance()), (bare.is_success(), bare.goal_distance()));
            assert_eq!(goal_frame(&mut *env), goal_frame(&mut *bare), "{}: the goal frame is unchanged", entry.id);
            assert_ne!(frame(&mut *env), frame(&mut *bare), "{}: the frame of the step is changed", entry.id);
        }
        let refused = ResetOptions { state: Some(vec![f64::NAN]), ..ResetOptions::default() };
        let before = frame(&mut *env);
        assert!(env.reset(5, &refused).is_err());
        assert_eq!(frame(&mut *env), before, "{}: a refused reset changes nothing", entry.id);
    }
    let none = Stack::parse::<&str>(&[]).expect("parsing an empty stack");
    let mut env = none.wrap(two_room::ENTRY.env().expect("creating the environment"), GoalFrame::Wrapped);
    assert!(
        two_room::ENTRY.env().expect("creating the environment").restore(&env.snapshot()).is_ok(),
        "an empty stack adds nothing"
    );
    assert_eq!(frame(&mut *env), frame(&mut *two_room::ENTRY.env().expect("creating the environment")));
}

#[test]
fn wrapped_goal_frame_has_the_values_sampled_for_the_episode() {
    let mut env = wrapped(&["color-jitter,hue=0.5", "noise"], GoalFrame::Wrapped);
    let mut clean = wrapped(&["color-jitter,hue=0.5"], GoalFrame::Wrapped);
    let at_goal =
        ResetOptions { state: Some(vec![60.0, 112.0]), goal_state: Some(vec![60.0, 112.0]), ..fixed_factors() };
    for env in [&mut env, &mut clean] {
        env.reset(2, &at_goal).expect("resetting the environment");
    }
    assert_eq!(frame(&mut *clean), goal_frame(&mut *clean), "values sampled per episode apply to the goal frame");
    assert_ne!(frame(&mut *env), goal_frame(&mut *env), "goal frame and step frame have different noise");
    let goal = goal_frame(&mut *env);
    step(&mut *env);
    assert_eq!(goal, goal_frame(&mut *env), "the goal frame does not change with the steps");
}

#[test]
fn restored_dataset_row_starts_at_step_0_with_the_seed_of_the_last_reset() {
    let texts = ["noise", "occlusion,num_patches=3"];
    let (mut env, mut other) = (wrapped(&texts, GoalFrame::Clean), wrapped(&texts, GoalFrame::Clean));
    env.reset(6, &fixed_factors()).expect("resetting the environment");
    other.reset(6, &fixed_factors()).expect("resetting the environment");
    let at_start = frame(&mut *env);
    (0..3).for_each(|_| step(&mut *env));
    let schema = Schema::new([ColumnSpec::new("state", DType::Float64, [2])]).expect("creating the schema");
    let mut row = Batch::zeros(&schema, 1);
    row.get_mut("state").expect("accessing the column `state`").copy_from_slice(&[60.0, 112.0]);
    for env in [&mut env, &mut other] {
        env.restore_from(row.row(0), row.row(0)).expect("restoring from the row");
        assert_eq!(frame(&mut **env), at_start, "steps are counted from the row");
    }
    step(&mut *env);
    step(&mut *other);
    assert_eq!(frame(&mut *env), frame(&mut *other));
}

#[test]
fn frames_depend_on_the_order_and_index_of_wrappers() {
    let frames = |texts: &[&str]| {
        let mut env = wrapped(texts, GoalFrame::Clean);
        env.reset(1, &fixed_factors()).expect("resetting the environment");
        frame(&mut *env)
    };
    assert_ne!(frames(&["noise,std=60", "blur"]), frames(&["blur", "noise,std=60"]));
    assert_ne!(frames(&["grayscale", "occlusion,color=255/0/0"]), frames(&["occlusion,color=255/0/0", "grayscale"]));
    // Two wrappers of one kind sample differently.
    let difference = |texts: &[&str]| {
        let (frames, clean) = (frames(texts), frames(&[]));
        frames.iter().zip(clean).filter(|(a, b)| **a != *b).count()
    };
    let one = difference(&["occlusion,color=99"]);
    assert!(difference(&["occlusion,color=99", "occlusion,color=99"]) > one, "the second patch is at another position");
}

#[test]
fn frames_do_not_depend_on_threads_or_other_environments() {
    let texts = ["color-jitter", "moving-patch", "noise", "random-shift,resample=step"];
    let play = |seeds: &[u64], workers: usize| -> Vec<Vec<u8>> {
        let stack = Stack::parse(&texts).expect("parsing the wrappers");
        let envs = seeds
            .iter()
            .map(|_| stack.wrap(two_room::ENTRY.env().expect("creating the environment"), GoalFrame::Wrapped))
            .collect();
        let image = Some((SIZE[1], SIZE[0]));
        let mut pool = EnvPool::new(envs, image, None, threads(workers).expect("creating the thread pool"))
            .expect("creating the environment pool");
        let resets: Vec<Reset> =
            seeds.iter().enumerate().map(|(slot, &seed)| Reset { slot, seed, options: fixed_factors() }).collect();
        pool.reset(&resets).expect("resetting the environment");
        let mut actions =
            Batch::zeros(&Schema::new([pool.spec().action_column()]).expect("creating the schema"), seeds.len());
        actions.get_mut::<f32>("action").expect("accessing the column `action`").fill(0.3);
        let mut frames = vec![vec![]; seeds.len()];
        for _ in 0..5 {
            for (slot, frames) in frames.iter_mut().enumerate() {
                for column in ["pixels", "goal"] {
                    let column = pool.infos().schema().index(column).expect("finding the column");
                    frames.extend_from_slice(pool.infos().row(slot).at::<u8>(column));
                }
            }
            pool.step(&actions, &vec![true; seeds.len()]).expect("stepping the environment");
        }
        frames
    };
    let expected = play(&[0, 1, 2, 3, 4], 1);
    assert!(expected == play(&[0, 1, 2, 3, 4], 4), "the number of threads changes frames");
    assert!(expected[3..4] == play(&[3], 2), "other environments change frames");
    assert!(expected[0] != expected[1], "episodes differ");
}
