//! The content of collected datasets, and its independence of environments, threads and interruptions.

use crate::line::{ENTRY, Line, Walker};
use crate::memory::Memory;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use swm_core::run::{Control, Event};
use swm_core::{
    Batch, DType, Env, EnvEntry, Error, Key, Manifest, Policy, RandomPolicy, Result, Space, VariationRequest,
};
use swm_eval::continuation::check_continues;
use swm_eval::{CollectConfig, Collected, MixturePolicy, PolicyChoice, World, WorldConfig};

fn world(envs: usize, threads: usize) -> World {
    let config = WorldConfig { envs, image: Some((2, 3)), views: vec![], max_episode_steps: None, threads };
    World::new(&ENTRY, config).expect("creating the world")
}

fn config(episodes: usize) -> CollectConfig {
    CollectConfig {
        episodes,
        seed: 11,
        variation: VariationRequest { variation: Some(vec!["all".to_owned()]), ..VariationRequest::default() },
        policy: "random".into(),
        ..CollectConfig::default()
    }
}

fn collect(envs: usize, threads: usize, episodes: usize, memory: &Memory) -> Result<Collected> {
    let mut world = world(envs, threads);
    let mut policy = RandomPolicy::new(world.spec(), envs);
    world.collect(&mut policy, memory.writer(), &config(episodes), &mut Control::default())
}

#[test]
fn datasets_do_not_depend_on_environment_and_thread_counts() {
    let single = Memory::default();
    let collected = collect(1, 1, 23, &single).expect("the collection succeeds");
    assert_eq!((collected.episodes, collected.added), (23, 23));
    let rows: usize = single.episodes.lock().expect("no thread has panicked").iter().map(Batch::rows).sum();
    assert_eq!(collected.steps, rows - 23);
    let lengths: Vec<usize> = single.episodes.lock().expect("no thread has panicked").iter().map(Batch::rows).collect();
    assert!(lengths.iter().any(|&n| n < 13), "some episodes end early, so that slots finish out of order: {lengths:?}");
    for (envs, threads) in [(1, 2), (5, 1), (5, 2), (23, 2), (40, 3)] {
        let memory = Memory::default();
        collect(envs, threads, 23, &memory).expect("the collection succeeds");
        assert!(memory.bytes() == single.bytes(), "{envs} environments on {threads} threads");
    }
}

#[test]
fn row_holds_an_observation_and_the_transition_after_it() {
    let memory = Memory::default();
    let mut world = world(3, 1);
    let schema = world.collect_schema(&config(6)).expect("creating the schema of collected episodes");
    assert_eq!(
        world
            .collect_schema(&CollectConfig { goal: true, ..config(6) })
            .expect("creating the schema of collected episodes")
            .columns()
            .len(),
        schema.columns().len() + 1
    );
    world.collect(&mut Walker, memory.writer(), &config(6), &mut Control::default()).expect("the collection succeeds");
    for (number, episode) in memory.episodes.lock().expect("no thread has panicked").iter().enumerate() {
        assert_eq!(*episode.schema(), schema);
        let last = episode.rows() - 1;
        let state = episode.get::<f64>("state").expect("reading the column of states");
        let goal = episode.get::<f64>("goal_state").expect("reading the column of goals")[0];
        let action = episode.get::<f32>("action").expect("reading the column of actions");
        let reward = episode.get::<f32>("reward").expect("reading the column of rewards");
        let terminated = episode.get::<u8>("terminated").expect("reading the column of terminations");
        let success = episode.get::<u8>("success").expect("reading the column of successes");
        for t in 0..last {
            assert!((state[t] + f64::from(action[t]) - state[t + 1]).abs() < 1e-6, "the action leads to the next row");
            assert_eq!(reward[t], -(state[t + 1] - goal).abs() as f32, "the reward belongs to the step");
            assert_eq!(terminated[t], u8::from(t + 1 == last));
            assert_eq!(success[t + 1], terminated[t]);
        }
        assert!(action[last].is_nan());
        assert_eq!((reward[last], terminated[last]), (0.0, 0));
        let seed = Key::new(11).with("episode").at(number as u64).seed() >> 1;
        for elements in episode.get::<i32>("episode_seed").expect("reading the column of seeds").chunks_exact(3) {
            let joined = elements.iter().rev().fold(0u64, |high, &element| high << 21 | element as u64);
            assert_eq!(joined, seed);
            assert!(
                elements.iter().all(|&element| element as f32 as i32 == element),
                "float32 represents the element exactly"
            );
        }
        let start = episode.get::<f32>("variation.agent.x").expect("reading the column of the factor");
        assert!(start.iter().all(|&x| f64::from(x) == state[0]), "constant, and equal to the initial position");
        let color = episode.get::<u8>("variation.agent.color").expect("reading the column of the factor");
        assert_eq!(color[..2], episode.get::<u8>("pixels").expect("reading the column of frames")[..2]);
    }
    let column = |name: &str| schema.column(name).expect("the column exists").clone();
    assert_eq!(column("variation.goal.x").dtype, DType::Float64);
    assert!(schema.find("goal").is_none() && schema.find("step_idx").is_none());
}

#[test]
fn resumed_collection_equals_uninterrupted_collection() {
    let complete = Memory::default();
    collect(4, 2, 15, &complete).expect("the collection succeeds");
    let resumed = Memory::default();
    collect(3, 1, 4, &resumed).expect("the first collection succeeds");
    let second = collect(2, 2, 15, &resumed).expect("the second collection succeeds");
    assert_eq!((second.episodes, second.added), (15, 11));
    assert!(resumed.bytes() == complete.bytes());
    assert_eq!(collect(2, 2, 15, &resumed).expect("no episodes to add").added, 0);
    assert_eq!(resumed.len(), 15);
}

#[test]
fn interruption_keeps_finished_episodes() {
    let (complete, interrupted) = (Memory::default(), Memory::default());
    collect(4, 1, 30, &complete).expect("the collection succeeds");
    let stop = Arc::new(AtomicBool::new(false));
    let mut world = world(4, 1);
    let mut policy = RandomPolicy::new(world.spec(), 4);
    let mut reported = 0;
    let mut control = Control::new().with_interrupt(Arc::clone(&stop)).with_events(|event| {
        if let Event::Progress(progress) = event {
            reported = progress.done;
            stop.store(progress.done >= 6, Ordering::Relaxed);
        }
    });
    let outcome = world.collect(&mut policy, interrupted.writer(), &config(30), &mut control);
    drop(control);
    assert!(matches!(outcome, Err(Error::Interrupted)), "{outcome:?}");
    assert_eq!((complete.ends(), interrupted.ends()), ((1, 0), (0, 1)), "an interrupted dataset is not finished");
    assert_eq!(reported, interrupted.len(), "the reported episodes are stored");
    assert!((6..30).contains(&interrupted.len()));
    assert!(complete.bytes().starts_with(&interrupted.bytes()));
    collect(2, 1, 30, &interrupted).expect("the resumed collection succeeds");
    assert!(interrupted.bytes() == complete.bytes());
}

/// Collects with three quarters of the episodes played by the walker, the others by the random policy.
fn collect_mixture(envs: usize, threads: usize, config: &CollectConfig, memory: &Memory) -> Result<Collected> {
    let mut world = world(envs, threads);
    let policies: Vec<Box<dyn Policy>> = vec![Box::new(Walker), Box::new(RandomPolicy::new(world.spec(), envs))];
    let mut policy = MixturePolicy::new(config.policy.clone(), policies, envs);
    world.collect(&mut policy, memory.writer(), config, &mut Control::default())
}

fn mixture(episodes: usize, action_noise: f64) -> CollectConfig {
    let policy = PolicyChoice::parse(&["walker:3".to_owned(), "random".to_owned()]).expect("the weights are positive");
    CollectConfig { policy, action_noise, ..config(episodes) }
}

#[test]
fn mixtures_with_noise_do_not_depend_on_environments_threads_and_interruptions() {
    let config = mixture(23, 0.3);
    let single = Memory::default();
    collect_mixture(1, 1, &config, &single).expect("the collection succeeds");
    for (envs, threads) in [(1, 2), (5, 1), (5, 2), (40, 3)] {
        let memory = Memory::default();
        collect_mixture(envs, threads, &config, &memory).expect("the collection succeeds");
        assert!(memory.bytes() == single.bytes(), "{envs} environments on {threads} threads");
    }
    let resumed = Memory::default();
    collect_mixture(4, 2, &mixture(9, 0.3), &resumed).expect("the first collection succeeds");
    collect_mixture(3, 1, &config, &resumed).expect("the second collection succeeds");
    assert!(resumed.bytes() == single.bytes());
    // A shard has the episodes from `first` on.
    let shard = Memory::default();
    collect_mixture(2, 1, &CollectConfig { first: 9, ..mixture(14, 0.3) }, &shard).expect("the shard is collected");
    assert!(single.bytes().ends_with(&shard.bytes()));
}

#[test]
fn episodes_of_a_mixture_store_the_index_of_their_policy() {
    let memory = Memory::default();
    let many = mixture(40, 0.0);
    collect_mixture(5, 2, &many, &memory).expect("the collection succeeds");
    let mut counts = [0; 2];
    for episode in memory.episodes.lock().expect("no thread has panicked").iter() {
        let index = episode.get::<i32>("policy_index").expect("reading the policies");
        assert!(index.iter().all(|&i| i == index[0]), "constant over the episode");
        counts[index[0] as usize] += 1;
        let state = episode.get::<f64>("state").expect("reading the states");
        let goal = episode.get::<f64>("goal_state").expect("reading the goals")[0];
        let action = episode.get::<f32>("action").expect("reading the actions");
        let walks = |(&x, &a): (&f64, &f32)| f64::from(a) == f64::from((goal - x).clamp(-1.0, 1.0) as f32);
        let walked = state.iter().zip(&action[..episode.rows() - 1]).all(walks);
        assert_eq!(walked, index[0] == 0, "only the walker moves straight to the goal");
    }
    assert!((24..=36).contains(&counts[0]), "{counts:?}");
    let one = world(1, 1).collect_schema(&config(1)).expect("creating the schema");
    assert!(one.find("policy_index").is_none(), "one policy has no index");
    let list = &world(1, 1).collect_manifest(&many).config["policy"];
    assert_eq!(list[1], serde_json::json!({"name": "random", "weight": 1.0}));
}

#[test]
fn noisy_actions_are_clipped_and_stored_as_executed() {
    let actions = |action_noise: f64| {
        let memory = Memory::default();
        let config = CollectConfig { policy: "walker".into(), action_noise, ..config(60) };
        world(4, 2)
            .collect(&mut Walker, memory.writer(), &config, &mut Control::default())
            .expect("the collection succeeds");
        let mut actions = vec![];
        for episode in memory.episodes.lock().expect("no thread has panicked").iter() {
            let state = episode.get::<f64>("state").expect("reading the states");
            let action = episode.get::<f32>("action").expect("reading the actions");
            for t in 0..episode.rows() - 1 {
                let reached = (state[t] + f64::from(action[t])).clamp(-5.0, 5.0);
                assert!((reached - state[t + 1]).abs() < 1e-6, "the stored action leads to the next row");
                assert!(action[t].abs() <= 1.0);
                actions.push(action[t]);
            }
        }
        actions
    };
    let (quiet, noisy) = (actions(0.0), actions(0.2));
    assert!(quiet.iter().filter(|v| v.abs() < 1.0).count() < noisy.iter().filter(|v| v.abs() < 1.0).count());
    assert!(noisy.iter().any(|v| v.abs() == 1.0), "some actions are clipped");
}

#[test]
fn invalid_noise_is_refused_before_a_dataset_is_written() {
    let schema = |entry: &EnvEntry, action_noise: f64| {
        let world =
            World::new(entry, WorldConfig { image: None, ..WorldConfig::default() }).expect("creating the world");
        world.collect_schema(&CollectConfig { action_noise, ..config(1) }).expect_err("invalid noise").to_string()
    };
    for std in [-0.1, f64::NAN, f64::INFINITY] {
        assert!(schema(&ENTRY, std).contains("at least 0"));
    }
    let discrete = swm_envs::ENVS.get("swm/PushT-Discrete-v1").expect("finding the environment");
    assert!(schema(discrete, 0.1).contains("the actions of swm/PushT-Discrete-v1 are discrete"));
    let manifest = world(1, 1).collect_manifest(&mixture(2, 0.1));
    let stored = world(1, 1).collect_manifest(&mixture(2, 0.2));
    let error = check_continues(&stored, &manifest).expect_err("continuing with other noise").to_string();
    assert!(error.contains("action_noise 0.1") && error.contains("0.2"), "{error}");
}

#[test]
fn actions_that_mark_a_missing_one_are_refused_before_the_first_step() {
    let make = || {
        let mut line = Line::new();
        line.spec.action_space = Space::Discrete { n: 3, start: -1 };
        Ok(Box::new(line) as Box<dyn Env>)
    };
    let size = WorldConfig { envs: 1, image: None, ..WorldConfig::default() };
    let mut signed = World::of(make, size.clone()).expect("creating the world");
    let schema = signed.collect_schema(&config(1)).expect_err("-1 is an action").to_string();
    assert!(schema.contains("contains -1, which marks a missing action"), "{schema}");
    let (memory, mut policy) = (Memory::default(), RandomPolicy::new(signed.spec(), 1));
    let collected = signed.collect(&mut policy, memory.writer(), &config(1), &mut Control::default());
    assert_eq!(collected.expect_err("-1 is an action").to_string(), schema);
    for entry in swm_envs::ENVS.rows {
        let world = World::new(entry, size.clone()).expect("creating the world");
        world.collect_schema(&config(1)).expect(entry.id);
    }
}

/// A policy that fails after `remaining` steps.
struct Failing {
    walker: Walker,
    remaining: usize,
}

impl Policy for Failing {
    fn begin(&mut self, _: usize, _: Key) {}

    fn act(&mut self, infos: &Batch, active: &[bool], actions: &mut Batch) -> Result<()> {
        self.remaining = self.remaining.checked_sub(1).ok_or(Error::external("acting", "no more actions"))?;
        self.walker.act(infos, active, actions)
    }
}

#[test]
fn failing_policies_and_writers_keep_finished_episodes() {
    let memory = Memory::default();
    let mut failing = Failing { walker: Walker, remaining: 20 };
    let error = world(3, 1).collect(&mut failing, memory.writer(), &config(50), &mut Control::default());
    assert!(error.expect_err("the policy fails").to_string().contains("no more actions"));
    assert!(memory.len() > 0);
    assert_eq!(memory.ends(), (0, 1));

    let full = Memory { full_at: Some(5), ..Memory::default() };
    let error = collect(3, 1, 500, &full).expect_err("the disk is full").to_string();
    assert!(error.contains("free some space"), "{error}");
    assert_eq!(full.len(), 5);
}

#[test]
fn errors_name_invalid_requests() {
    let made = |config| World::new(&ENTRY, config).err().expect("the input is invalid").to_string();
    assert!(made(WorldConfig { envs: 0, ..WorldConfig::default() }).contains("at least 1"));
    assert!(made(WorldConfig { image: Some((0, 3)), ..WorldConfig::default() }).contains("0 x 3"));
    let unknown = VariationRequest { variation: Some(vec!["agent.colour".to_owned()]), ..Default::default() };
    let config = CollectConfig { variation: unknown, ..config(1) };
    let memory = Memory::default();
    let error = world(1, 1).collect(&mut Walker, memory.writer(), &config, &mut Control::default());
    assert!(error.expect_err("no such factor").to_string().contains("agent.color"));
}

#[test]
fn manifest_contains_settings_but_no_run_options() {
    let manifest = world(3, 1).collect_manifest(&config(9));
    assert_eq!(manifest, world(1, 2).collect_manifest(&config(9)));
    assert_eq!((manifest.kind.as_str(), manifest.seed), ("collect", 11));
    assert_eq!(manifest.config["env"], "test/Line-v0");
    assert_eq!(manifest.config["image"], serde_json::json!([2, 3]));
    let other = |config: CollectConfig| check_continues(&manifest, &world(1, 1).collect_manifest(&config));
    other(config(500)).expect("a larger number of episodes is compatible");
    let seed = other(CollectConfig { seed: 12, ..config(9) }).expect_err("resuming with another seed").to_string();
    assert!(seed.contains("seed 12") && seed.contains("11"), "{seed}");
    let policy =
        other(CollectConfig { policy: "expert".into(), ..config(9) }).expect_err("resuming with another policy");
    assert!(policy.to_string().contains("\"expert\""), "{policy}");
    // A setting that only one of the collections has, such as wrappers, differs; an empty one does not.
    let mut changed = manifest.clone();
    changed.config["wrappers"] = serde_json::json!([]);
    check_continues(&manifest, &changed).expect("no wrappers in both");
    changed.config["wrappers"] = serde_json::json!(["noise"]);
    for (stored, wanted) in [(&manifest, &changed), (&changed, &manifest)] {
        let error = check_continues(stored, wanted).expect_err("resuming with other wrappers").to_string();
        assert!(error.contains("wrappers") && error.contains("noise"), "{error}");
    }
    let weights = |hash: &str| Manifest { hashes: [("cloned".into(), hash.into())].into(), ..manifest.clone() };
    check_continues(&weights("a"), &weights("a")).expect("the same weights");
    let error = check_continues(&weights("a"), &weights("b")).expect_err("the policy was trained again").to_string();
    assert!(error.contains("weights of cloned"), "{error}");
}
