//! Tests that the outputs of an environment depend only on its seed and actions, not on threads or other environments.

use crate::{config, id};
use swm_core::batch::{Batch, DType, Schema};
use swm_core::pool::{Reset, threads};
use swm_core::{
    Action, Env, EnvPool, Error, FrameMut, Key, PendingCall, Policy, RandomPolicy, ResetOptions, Space,
    VariationRequest,
};
use swm_gym::GymConfig;

pub const ROOM: &str = "tests.it.environments:Room-v0";

pub fn make(text: &str, config: &GymConfig) -> Box<dyn Env> {
    swm_gym::make(&id(text), config.clone()).unwrap_or_else(|error| panic!("{text}: {error}"))
}

/// Plays episodes with random actions and returns the bytes of all their outputs, one vector per slot.
pub fn play(text: &str, config: &GymConfig, episodes: &[u64], workers: usize, steps: usize) -> Vec<Vec<u8>> {
    let envs = episodes.iter().map(|_| make(text, config)).collect();
    let threads = threads(workers).expect("creating the thread pool");
    let mut pool = EnvPool::new(envs, Some((48, 64)), Some(steps), threads).expect("creating the environment pool");
    let mut policy = RandomPolicy::new(pool.spec(), episodes.len());
    let mut actions =
        Batch::zeros(&Schema::new([pool.spec().action_column()]).expect("creating the schema"), episodes.len());
    let resets: Vec<Reset> = (0..)
        .zip(episodes)
        .map(|(slot, &episode)| {
            policy.begin(slot, Key::new(episode));
            Reset { slot, seed: Key::new(episode).seed(), options: ResetOptions::default() }
        })
        .collect();
    pool.reset(&resets).expect("resetting the environment");
    let mut outputs = vec![vec![]; episodes.len()];
    let mut record = |pool: &EnvPool| {
        for (slot, output) in outputs.iter_mut().enumerate() {
            for (column, spec) in pool.infos().schema().columns().iter().enumerate() {
                let n = spec.row_bytes();
                output.extend_from_slice(&pool.infos().bytes(column)[slot * n..(slot + 1) * n]);
            }
        }
    };
    record(&pool);
    let active = vec![true; episodes.len()];
    for _ in 0..steps {
        policy.act(pool.infos(), &active, &mut actions).expect("choosing random actions");
        pool.step(&actions, &active).expect("stepping the environment");
        record(&pool);
    }
    outputs
}

/// An environment and a row for its observations.
pub struct RecordedEnv {
    pub env: Box<dyn Env>,
    row: Batch,
}

impl RecordedEnv {
    pub fn of(env: Box<dyn Env>) -> Self {
        let schema = Schema::new(env.spec().columns.clone()).expect("creating the schema");
        Self { env, row: Batch::zeros(&schema, 1) }
    }

    pub fn dispatch(&mut self, call: PendingCall<'_>) -> bool {
        self.env.as_dispatch().is_some_and(|env| env.dispatch(call))
    }

    pub fn column(&mut self, name: &str) -> Vec<f64> {
        self.env.observe(&mut self.row.row_mut(0));
        self.row.row(0).to_f64(name).expect("reading the column")
    }

    pub fn all_outputs(&mut self) -> Vec<u8> {
        self.env.observe(&mut self.row.row_mut(0));
        let mut bytes: Vec<u8> =
            (0..self.row.schema().columns().len()).flat_map(|column| self.row.bytes(column)).copied().collect();
        bytes.extend(self.frame(9, 12));
        bytes
    }

    pub fn frame(&mut self, height: usize, width: usize) -> Vec<u8> {
        let mut rgb = vec![7; height * width * 3];
        self.env.render(FrameMut::new(width, height, &mut rgb)).expect("rendering a frame");
        rgb
    }
}

#[test]
fn outputs_do_not_depend_on_threads_or_other_environments() {
    let Some(config) = config() else { return };
    for text in ["CartPole-v1", ROOM] {
        let serial = play(text, &config, &[0, 1, 2, 3], 1, 6);
        assert!(serial == play(text, &config, &[0, 1, 2, 3], 4, 6), "{text}: four threads differ from one");
        assert!(serial[0] != serial[1], "{text}: two seeds give two episodes");
        assert!(serial[..2] == play(text, &config, &[0, 1], 2, 6), "{text}: two environments differ from four");
        assert!(serial[3] == play(text, &config, &[3], 1, 6)[0], "{text}: a single environment differs");
    }
}

#[test]
fn environments_run_in_parallel_on_one_thread() {
    let Some(config) = config() else { return };
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    // Each environment waits in its reset and in its step for the other environment, except in episodes of seed 0.
    let text = format!("{ROOM},meet={}", folder.path().display());
    let envs = (0..2).map(|_| make(&text, &config)).collect();
    let mut pool = EnvPool::new(envs, None, None, threads(1).expect("creating the thread pool"))
        .expect("creating the environment pool");
    let actions = Batch::zeros(&Schema::new([pool.spec().action_column()]).expect("creating the schema"), 2);
    for seeds in [[0, 0], [1, 2]] {
        let reset = |(slot, seed)| Reset { slot, seed, options: ResetOptions::default() };
        pool.reset(&(0..).zip(seeds).map(reset).collect::<Vec<_>>()).expect("resetting the environment");
        pool.step(&actions, &[true, true]).expect("stepping the environment");
    }
    assert_eq!(pool.infos().get::<i64>("steps").expect("reading the column"), [1, 1]);
}

#[test]
fn dispatched_calls_run_once_and_before_later_calls() {
    let Some(config) = config() else { return };
    let push = Action::Continuous(&[0.1, -0.2]);
    let (start, none) = (ResetOptions::default(), Action::Continuous(&[0.0, 0.0]));
    let mut plain = RecordedEnv::of(make(ROOM, &config));
    let mut dispatched = RecordedEnv::of(make(ROOM, &config));
    for env in [&mut plain, &mut dispatched] {
        env.env.reset(1, &start).expect("resetting the environment");
    }
    plain.env.reset(4, &start).expect("resetting the environment");
    assert!(dispatched.dispatch(PendingCall::Reset(4, &start)));
    assert!(!dispatched.dispatch(PendingCall::Step(push)), "only one call is dispatched at a time");
    dispatched.env.reset(4, &start).expect("resetting the environment");
    plain.env.step(push).expect("stepping the environment");
    assert!(dispatched.dispatch(PendingCall::Step(push)));
    dispatched.env.step(push).expect("stepping the environment");
    assert!(plain.all_outputs() == dispatched.all_outputs());
    // Any other call completes the dispatched step first.
    plain.env.step(push).expect("stepping the environment");
    assert!(dispatched.dispatch(PendingCall::Step(push)));
    assert!(plain.env.snapshot() == dispatched.env.snapshot());
    assert!(plain.frame(9, 12) == dispatched.frame(9, 12) && plain.all_outputs() == dispatched.all_outputs());
    plain.env.step(push).and_then(|_| plain.env.step(none)).expect("stepping the environment twice");
    assert!(dispatched.dispatch(PendingCall::Step(push)));
    dispatched.env.step(none).expect("stepping the environment");
    assert!(plain.all_outputs() == dispatched.all_outputs());
    // A reset completes the dispatched step first, too.
    assert!(dispatched.dispatch(PendingCall::Step(push)));
    for env in [&mut plain, &mut dispatched] {
        env.env.reset(7, &start).expect("resetting the environment");
    }
    assert!(plain.all_outputs() == dispatched.all_outputs());
    // An invalid call is not dispatched; the call itself returns the error and changes nothing.
    assert!(!dispatched.dispatch(PendingCall::Step(Action::Discrete(&[0]))));
    assert!(dispatched.env.step(Action::Discrete(&[0])).is_err());
    assert!(plain.all_outputs() == dispatched.all_outputs());
}

#[test]
fn spec_describes_the_environment() {
    let Some(config) = config() else { return };
    let env = make("CartPole-v1", &config);
    let spec = env.spec();
    assert_eq!(spec.id, "CartPole-v1");
    assert_eq!(spec.action_space, Space::Discrete { n: 2, start: 0 });
    assert_eq!(spec.max_episode_steps, 500);
    assert_eq!((spec.columns.len(), spec.columns[0].name.as_str()), (1, "observation"));
    assert_eq!(spec.observation_space[0].1.bounds(1), (f64::NEG_INFINITY, f64::INFINITY));
    assert!(env.libraries().contains_key("gymnasium"), "{:?}", env.libraries());

    let room = make(ROOM, &config);
    let spec = room.spec();
    let mut columns: Vec<(&str, DType, &[usize])> =
        spec.columns.iter().map(|column| (column.name.as_str(), column.dtype, &column.shape[..])).collect();
    let mut expected: [(&str, DType, &[usize]); 9] = [
        ("position", DType::Float64, &[2]),
        ("camera", DType::U8, &[6, 8, 3]),
        ("door_open", DType::Int64, &[]),
        ("door_flags", DType::Bool, &[2]),
        ("obs_reward", DType::Int64, &[]),
        ("goal_distance", DType::Float64, &[]),
        ("moved", DType::Float32, &[]),
        ("noise", DType::Float64, &[]),
        ("steps", DType::Int64, &[]),
    ];
    // Gymnasium determines the order of a dictionary's keys, so both lists are sorted.
    columns.sort_by(|a, b| a.0.cmp(b.0));
    expected.sort_by(|a, b| a.0.cmp(b.0));
    assert_eq!(columns, expected);
    assert_eq!(spec.max_episode_steps, 30);
    assert_eq!(spec.action_space, Space::uniform_box([2], DType::Float32, f64::from(-0.4f32), f64::from(0.4f32)));
}

#[test]
fn info_goals_and_frames_become_outputs() {
    let Some(config) = config() else { return };
    let mut room = RecordedEnv::of(make(ROOM, &config));
    assert_eq!(room.env.goal_distance(), f64::INFINITY, "the distance is infinite before the first episode");
    room.env.reset(3, &ResetOptions::default()).expect("resetting the environment");
    assert_eq!((room.column("noise"), room.column("steps")), (vec![0.5], vec![0.0]));
    let mut goal = vec![0; 5 * 7 * 3];
    room.env.render_goal(FrameMut::new(7, 5, &mut goal)).expect("rendering the goal");
    assert_eq!((goal[0], goal[2]), (40, 40));
    let (mut noises, mut steps) = (vec![], 0);
    let terminated = loop {
        // The bridge converts the bound in single precision to the bound in double precision.
        let transition = room.env.step(Action::Continuous(&[0.4, -0.4])).expect("stepping the environment");
        steps += 1;
        assert_eq!(transition.reward, -1.5);
        assert_eq!(room.env.is_success(), steps >= 6);
        assert_eq!(room.column("steps"), [f64::from(steps)]);
        assert!((room.env.goal_distance() - room.column("goal_distance")[0]).abs() < 1e-12);
        noises.extend(room.column("noise"));
        if transition.terminated {
            break steps;
        }
    };
    assert_eq!(terminated, 7);
    assert_eq!(noises[0], noises[1], "a missing entry keeps its value");
    assert_ne!(noises[1], noises[2]);
    // The top third is blue, at the native size and at half that size.
    let native = room.frame(12, 16);
    assert_eq!((&native[..3], &native[native.len() - 3..]), (&[0, 0, 140][..], &[0, 0, 0][..]));
    let half = room.frame(6, 8);
    assert_eq!((half[2], half[half.len() - 1]), (140, 0));
    // The next episode starts with new values.
    room.env.reset(3, &ResetOptions::default()).expect("resetting the environment");
    assert_eq!((room.column("noise"), room.column("steps")), (vec![0.5], vec![0.0]));
}

#[test]
fn factors_are_sampled_pinned_and_read_back() {
    let Some(config) = config() else { return };
    let mut room = make(ROOM, &config);
    let keys: Vec<String> = room.spec().variation_space.factors().iter().map(|factor| factor.key.clone()).collect();
    assert_eq!(keys, ["agent.color", "agent.size", "door.number"]);
    let mut reset = |variation: Option<&[&str]>, pinned: &[(&str, &[f64])]| {
        let request = VariationRequest {
            variation: variation.map(|keys| keys.iter().map(|&key| key.to_owned()).collect()),
            variation_values: pinned.iter().map(|(key, value)| ((*key).to_owned(), value.to_vec())).collect(),
        };
        room.reset(9, &ResetOptions { variation: request, ..ResetOptions::default() })?;
        let factors = room.factors();
        Ok::<_, Error>((factors.scalar("agent.size"), factors.rgb("agent.color"), factors.integer("door.number")))
    };
    let plain = reset(Some(&[]), &[]).expect("resetting with no varied factor");
    assert_eq!(plain, (1.0, [255, 0, 10], 1));
    let default = reset(None, &[]).expect("resetting with the default factors");
    assert!(default.0 != 1.0 && default.1 == plain.1, "{default:?}");
    assert_ne!(reset(Some(&["agent"]), &[]).expect("resetting with a varied group").1, plain.1);
    assert_ne!(reset(Some(&["all"]), &[]).expect("resetting with all factors varied").1, plain.1);
    let pinned: &[(&str, &[f64])] =
        &[("door.number", &[3.0]), ("agent.color", &[1.0, 2.0, 3.0]), ("agent.size", &[0.75])];
    assert_eq!(reset(Some(&["all"]), pinned).expect("resetting with all factors pinned"), (0.75, [1, 2, 3], 3));
    for (variation, pinned, words) in [
        (Some(&["agent.colour"][..]), &[][..], "did you mean agent.color"),
        (None, &[("agent.size", &[9.0][..])][..], "0.5 ..= 2"),
        (None, &[("agent.sise", &[1.0][..])][..], "did you mean agent.size"),
    ] {
        let error = reset(variation, pinned).expect_err(words).to_string();
        assert!(error.contains(words), "{error}");
    }
}

#[test]
fn gymnasium_wrapper_provides_factors_and_frames() {
    let Some(config) = config() else { return };
    let mut coated = RecordedEnv::of(make("tests.it.environments:Coated-v0", &config));
    coated.env.reset(1, &ResetOptions::default()).expect("resetting the environment");
    assert_eq!(coated.frame(2, 2), [9; 12]);
    let pinned = [("coat".to_owned(), vec![1.0, 2.0, 3.0])].into();
    let variation = VariationRequest { variation: None, variation_values: pinned };
    coated.env.reset(1, &ResetOptions { variation, ..ResetOptions::default() }).expect("resetting the environment");
    assert_eq!(coated.env.factors().rgb("coat"), [1, 2, 3]);
    assert_eq!(coated.frame(1, 1), [1, 2, 3]);
}

#[test]
fn restores_snapshot_bit_for_bit() {
    let Some(config) = config() else { return };
    let mut room = RecordedEnv::of(make(ROOM, &config));
    room.env.reset(5, &ResetOptions::default()).expect("resetting the environment");
    let outputs_of_steps = |room: &mut RecordedEnv, n: i16| {
        let actions = (0..n).map(|i| [0.1 * f32::from(i % 3), -0.2]);
        actions
            .flat_map(|action| {
                room.env.step(Action::Continuous(&action)).expect("stepping the environment");
                room.all_outputs()
            })
            .collect::<Vec<u8>>()
    };
    outputs_of_steps(&mut room, 2);
    let snapshot = room.env.snapshot();
    let expected = outputs_of_steps(&mut room, 3);
    room.env.restore(&snapshot).expect("restoring the snapshot");
    assert!(outputs_of_steps(&mut room, 3) == expected, "the same environment differs after a restore");
    let mut other = RecordedEnv::of(make(ROOM, &config));
    other.env.restore(&snapshot).expect("restoring the snapshot");
    assert!(outputs_of_steps(&mut other, 3) == expected, "another environment differs after a restore");
    let error =
        make("CartPole-v1", &config).restore(&snapshot).expect_err("a snapshot of another environment").to_string();
    assert!(error.contains("another environment"), "{error}");
}

#[test]
fn unsupported_requests_are_errors() {
    let Some(config) = config() else { return };
    let mut env = RecordedEnv::of(make("CartPole-v1", &config));
    let early = env.env.step(Action::Discrete(&[0])).expect_err("stepping before a reset").to_string();
    assert!(early.contains("reset it first"), "{early}");
    assert!(
        env.env
            .sample_goal(Key::new(0))
            .expect_err("an environment without goals")
            .to_string()
            .contains("another seed")
    );
    let state = ResetOptions { state: Some(vec![0.0; 4]), ..ResetOptions::default() };
    assert!(
        env.env
            .reset(0, &state)
            .expect_err("an environment without states")
            .to_string()
            .contains("the seed decides the initial state")
    );
    let variation = VariationRequest { variation: Some(vec!["all".to_owned()]), ..VariationRequest::default() };
    let varied = ResetOptions { variation, ..ResetOptions::default() };
    assert!(
        env.env.reset(0, &varied).expect_err("an environment without factors").to_string().contains("variation_space")
    );
    env.env.reset(0, &ResetOptions::default()).expect("resetting the environment");
    assert!(env.env.step(Action::Discrete(&[2])).is_err(), "there are two actions");
    assert!(env.env.step(Action::Continuous(&[0.0])).is_err(), "an action of another kind must be an error");
    env.env.step(Action::Discrete(&[1])).expect("stepping the environment after invalid actions");

    let unknown =
        swm_gym::make(&id("CartPoel-v1"), config.clone()).err().expect("an unknown id must be an error").to_string();
    assert!(unknown.contains("did you mean CartPole-v1"), "{unknown}");
    let wrong = swm_gym::make(&id("CartPole-v1,sutton=1"), config.clone())
        .err()
        .expect("an unknown argument must be an error")
        .to_string();
    assert!(wrong.contains("sutton") && wrong.contains("CartPole-v1"), "{wrong}");
    let module = swm_gym::make(&id("no_such_module:Maze-v0"), config.clone())
        .err()
        .expect("a missing module must be an error")
        .to_string();
    assert!(module.contains("no_such_module"), "{module}");
    let python = swm_gym::Python { program: "/no/such/python".into(), origin: "named by a test" };
    let none = swm_gym::make(&id("CartPole-v1"), GymConfig { python, ..config })
        .err()
        .expect("a missing Python interpreter must be an error")
        .to_string();
    assert!(none.contains("/no/such/python (named by a test)") && none.contains("SWM_PYTHON"), "{none}");
}
