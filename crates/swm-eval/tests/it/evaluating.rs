//! Evaluation: starts, success, and independence of environments and threads.

use crate::line::{ENTRY, Walker};
use crate::memory::{Memory, MemoryReader};
use swm_core::results::{Counting, Run};
use swm_core::run::Control;
use swm_core::{Batch, Candidates, CostModel, Error, Key, Policy, RandomPolicy, Result, VariationRequest};
use swm_data::Reader as _;
use swm_eval::{CollectConfig, EvalConfig, STAGED, Starts, Videos, World, WorldConfig, publish};
use swm_plan::{ActionScale, Cem, MpcConfig, MpcPolicy};

pub fn world(envs: usize, threads: usize) -> World {
    let config = WorldConfig { envs, image: Some((4, 4)), views: vec![], max_episode_steps: Some(12), threads };
    World::new(&ENTRY, config).expect("creating the world")
}

pub fn pinned(values: &[(&str, f64)]) -> VariationRequest {
    let variation_values = values.iter().map(|&(key, value)| (key.to_owned(), vec![value])).collect();
    VariationRequest { variation: None, variation_values }
}

fn run(world: &mut World, policy: &mut dyn Policy, starts: &Starts, budget: Option<usize>) -> Run {
    let config =
        EvalConfig { policy: "walker".to_owned(), condition: "test".to_owned(), budget, ..EvalConfig::default() };
    world.evaluate(policy, starts, &config, &mut Control::default()).expect("the evaluation succeeds")
}

pub fn run_counted(world: &mut World, policy: &mut dyn Policy, starts: &Starts, counting: Counting) -> Run {
    let config = EvalConfig { counting, ..EvalConfig::default() };
    world.evaluate(policy, starts, &config, &mut Control::default()).expect("the evaluation succeeds")
}

/// The run without its timing, as JSON.
fn without_timing(run: &Run) -> String {
    serde_json::to_string(&Run { timing: Default::default(), ..run.clone() }).expect("serialising to JSON")
}

#[test]
fn solved_starts_are_counted_separately() {
    // Some episodes are solved at the start: the goal is at 2, the start anywhere in -4 ..= 4.
    let variation = VariationRequest { variation: Some(vec!["agent.x".to_owned()]), ..pinned(&[("goal.x", 2.0)]) };
    let starts = Starts::episodic(200, 3, variation).expect("creating the starts");
    let found = run(&mut world(16, 2), &mut Walker, &starts, None);
    assert!(found.solved_at_start > 0, "some starts are solved");
    assert_eq!(found.success.n + found.solved_at_start, 200);
    assert_eq!(found.success.successes, found.success.n, "at most 6 steps in a straight line");
    for episode in &found.episodes {
        assert_eq!(episode.solved_at_start, episode.steps == 0);
        assert!(!(episode.solved_at_start && episode.success));
    }
    let time = found.time_to_goal.expect("some episodes succeed");
    assert!((1.0..=6.0).contains(&time.median), "{time:?}");
}

#[test]
fn step_budget_ends_an_episode() {
    let starts = Starts::episodic(3, 0, pinned(&[("agent.x", -3.0), ("goal.x", 3.0)])).expect("creating the starts");
    let steps = |budget| {
        let found = run(&mut world(2, 1), &mut Walker, &starts, budget);
        (found.success.successes, found.episodes[0].steps)
    };
    assert_eq!((steps(None), steps(Some(6)), steps(Some(5))), ((3, 6), (3, 6), (0, 5)));
    let config = EvalConfig { budget: Some(13), ..EvalConfig::default() };
    let error = world(1, 1).evaluate(&mut Walker, &starts, &config, &mut Control::default());
    assert!(error.expect_err("the budget is too large").to_string().contains("truncates episodes after 12"));
}

/// A perfect model: the cost is the distance to the goal after the last action.
#[derive(Default)]
struct PerfectModel {
    present: Vec<(f64, f64)>,
}

impl CostModel for PerfectModel {
    fn observe(&mut self, infos: &Batch, envs: &[usize]) -> Result<()> {
        self.present.clear();
        for &env in envs {
            let row = infos.row(env);
            self.present.push((row.get::<f64>("state")?[0], row.get::<f64>("goal_state")?[0]));
        }
        Ok(())
    }

    fn cost(&mut self, candidates: Candidates<'_>, costs: &mut [f32]) -> Result<()> {
        let len = candidates.horizon * candidates.dim;
        for (i, actions) in candidates.actions.chunks_exact(len).enumerate() {
            let (x, goal) = self.present[i / candidates.samples];
            costs[i] = (x + f64::from(actions.iter().sum::<f32>()) - goal).abs() as f32;
        }
        Ok(())
    }
}

fn planner(world: &World) -> MpcPolicy {
    let cem = Cem { samples: 32, iterations: 4, elites: 6, sigma: 1.0 };
    let config = MpcConfig { horizon: 3, receding_horizon: 2, action_block: 2, ..MpcConfig::default() };
    let (scale, slots) = (ActionScale::identity(1), world.pool().len());
    MpcPolicy::new(Box::new(cem), Box::new(PerfectModel::default()), config, scale, world.spec(), slots)
        .expect("creating the policy")
}

#[test]
fn results_do_not_depend_on_environment_and_thread_counts() {
    let starts = Starts::episodic(20, 5, VariationRequest::default()).expect("creating the starts");
    let mut single = world(1, 1);
    let mut policy = planner(&single);
    let planned = run(&mut single, &mut policy, &starts, None);
    let mut policy = RandomPolicy::new(single.spec(), 1);
    let random = run(&mut single, &mut policy, &starts, None);
    assert!(planned.success.low > random.success.high, "{:?} and {:?}", planned.success, random.success);
    assert!(planned.timing.plan_seconds.is_some_and(|plans| plans.n >= 20) && random.timing.plan_seconds.is_none());
    for (envs, threads) in [(7, 1), (20, 1), (20, 2), (32, 2)] {
        let mut world = world(envs, threads);
        let mut policy = planner(&world);
        assert_eq!(
            without_timing(&run(&mut world, &mut policy, &starts, None)),
            without_timing(&planned),
            "{envs} planned"
        );
        let mut policy = RandomPolicy::new(world.spec(), envs);
        assert_eq!(
            without_timing(&run(&mut world, &mut policy, &starts, None)),
            without_timing(&random),
            "{envs} random"
        );
    }
}

pub fn recorded(episodes: usize) -> MemoryReader {
    let memory = Memory::default();
    let mut world = world(4, 1);
    let mut policy = RandomPolicy::new(world.spec(), 4);
    let variation = VariationRequest { variation: Some(vec!["all".to_owned()]), ..VariationRequest::default() };
    let config = CollectConfig { episodes, seed: 1, variation, ..CollectConfig::default() };
    world.collect(&mut policy, memory.writer(), &config, &mut Control::default()).expect("the collection succeeds");
    memory.reader()
}

/// A policy that repeats the recorded actions from the start of its episode.
struct Replay<'a> {
    reader: &'a MemoryReader,
    starts: &'a Starts,
    keys: Vec<(Key, usize)>,
    playing: Vec<[usize; 2]>,
}

impl Policy for Replay<'_> {
    fn begin(&mut self, slot: usize, key: Key) {
        let episode = self.keys.iter().find(|(known, _)| *known == key).expect("a key of these starts").1;
        self.playing[slot] = self.starts.pick(episode).expect("starts of a dataset");
    }

    fn act(&mut self, _: &Batch, active: &[bool], actions: &mut Batch) -> Result<()> {
        for slot in (0..active.len()).filter(|&slot| active[slot]) {
            let [episode, step] = &mut self.playing[slot];
            let range = swm_data::StepRange { episode: *episode, start: *step, length: 1 };
            let row = self.reader.read(&["action"], &[range])?;
            actions.row_mut(slot).set(0, row.get::<f32>("action")?);
            *step += 1;
        }
        Ok(())
    }
}

#[test]
fn replaying_actions_reaches_the_recorded_goal() {
    let reader = recorded(12);
    let picks = Starts::choose(&reader, 30, 4, 8).expect("the dataset has enough starts");
    assert_eq!(
        picks,
        Starts::choose(&reader, 30, 4, 8).expect("the dataset has enough starts"),
        "the seed determines the starts"
    );
    assert_ne!(picks, Starts::choose(&reader, 30, 4, 9).expect("the dataset has enough starts"));
    let starts =
        Starts::from_dataset(&reader, world(1, 1).pool().env(0), picks, 4, 8, VariationRequest::default(), &[])
            .expect("creating the starts");
    let keys = (0..30).map(|i| (Key::new(8).with("episode").at(i as u64), i)).collect();
    let mut replay = Replay { reader: &reader, starts: &starts, keys, playing: vec![[0; 2]; 5] };
    let found = run(&mut world(5, 2), &mut replay, &starts, Some(4));
    assert!(found.success.n > 0);
    assert_eq!(found.success.rate, 1.0, "{found:?}");
    assert!(found.episodes.iter().all(|episode| episode.start.is_some() && episode.steps <= 4));
    let stationary = run(&mut world(5, 1), &mut Stationary, &starts, Some(4));
    assert_eq!((stationary.success.successes, stationary.solved_at_start), (0, found.solved_at_start));
}

/// A policy whose actions are zero.
struct Stationary;

impl Policy for Stationary {
    fn begin(&mut self, _: usize, _: Key) {}

    fn act(&mut self, _: &Batch, _: &[bool], actions: &mut Batch) -> Result<()> {
        actions.get_mut::<f32>("action")?.fill(0.0);
        Ok(())
    }
}

/// A policy that records the first colour it observes, and whose actions are zero.
#[derive(Default)]
struct FirstColor {
    color: Vec<u8>,
}

impl Policy for FirstColor {
    fn begin(&mut self, _: usize, _: Key) {}

    fn act(&mut self, infos: &Batch, _: &[bool], actions: &mut Batch) -> Result<()> {
        if self.color.is_empty() {
            self.color = infos.row(0).get::<u8>("pixels")?[..2].to_vec();
        }
        Stationary.act(infos, &[], actions)
    }
}

#[test]
fn recorded_factors_apply_unless_the_request_pins_them() {
    let reader = recorded(12);
    let picks = Starts::choose(&reader, 1, 6, 0).expect("the dataset has enough starts");
    let color = |variation: VariationRequest| {
        let starts = Starts::from_dataset(&reader, world(1, 1).pool().env(0), picks.clone(), 6, 0, variation, &[])
            .expect("creating the starts");
        let mut policy = FirstColor::default();
        run(&mut world(1, 1), &mut policy, &starts, None);
        policy.color
    };
    let range = swm_data::StepRange { episode: picks[0][0], start: 0, length: 1 };
    let row = reader.read(&["variation.agent.color"], &[range]).expect("reading the row");
    assert_eq!(
        color(VariationRequest::default()),
        row.get::<u8>("variation.agent.color").expect("reading the column of colours")[..2]
    );
    let green = VariationRequest {
        variation: None,
        variation_values: [("agent.color".to_owned(), vec![1.0, 254.0, 0.0])].into(),
    };
    assert_eq!(color(green), [1, 254]);
}

#[test]
fn errors_name_invalid_requests() {
    let reader = recorded(3);
    let starts = |picks, offset, variation| {
        Starts::from_dataset(&reader, world(1, 1).pool().env(0), picks, offset, 0, variation, &[])
            .expect_err("the input is invalid")
            .to_string()
    };
    assert!(starts(vec![], 1, VariationRequest::default()).contains("at least 1"));
    assert!(starts(vec![[3, 0]], 1, VariationRequest::default()).contains("3 episodes, counted from 0"));
    assert!(starts(vec![[0, 5]], 50, VariationRequest::default()).contains("50 steps later"));
    assert!(starts(vec![[0, 0]], 1, pinned(&[("agent.y", 1.0)])).contains("agent.x"));
    let error = Starts::choose(&reader, 1000, 2, 0).expect_err("too many starts").to_string();
    assert!(error.contains("1000") && error.contains("collect more"), "{error}");
    let no_frames = WorldConfig { envs: 1, image: None, views: vec![], max_episode_steps: None, threads: 1 };
    let videos =
        Videos { root: "nowhere".into(), prefix: "v".to_owned(), count: 1, fps: 10, frame_strip: None, staged: false };
    let config = EvalConfig { videos: Some(videos), ..EvalConfig::default() };
    let starts = Starts::episodic(1, 0, VariationRequest::default()).expect("creating the starts");
    let mut world = World::new(&ENTRY, no_frames).expect("creating the world");
    let error =
        world.evaluate(&mut Walker, &starts, &config, &mut Control::default()).expect_err("a world without frames");
    assert!(matches!(error, Error::Config { .. }), "{error}");
}

#[test]
fn videos_of_the_first_episodes_are_written() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let videos = Videos {
        root: folder.path().to_owned(),
        prefix: "videos/walker".to_owned(),
        count: 2,
        fps: 10,
        frame_strip: None,
        staged: false,
    };
    let config = EvalConfig { videos: Some(videos), ..EvalConfig::default() };
    let starts = Starts::episodic(4, 2, VariationRequest::default()).expect("creating the starts");
    let found =
        world(3, 1).evaluate(&mut Walker, &starts, &config, &mut Control::default()).expect("the evaluation succeeds");
    assert_eq!(found.videos, ["videos/walker-0.mp4", "videos/walker-1.mp4"]);
    let read = |name: &String| std::fs::read(folder.path().join(name)).expect("a video");
    let written: Vec<Vec<u8>> = found.videos.iter().map(read).collect();
    assert!(written.iter().all(|video| video.len() > 500));

    // Staged videos replace these when they are published, with their posters.
    let staged = Videos { staged: true, count: 1, fps: 20, ..config.videos.clone().expect("videos") };
    let config = EvalConfig { videos: Some(staged), ..EvalConfig::default() };
    let again =
        world(3, 1).evaluate(&mut Walker, &starts, &config, &mut Control::default()).expect("the evaluation succeeds");
    assert_eq!((again.videos.clone(), read(&again.videos[0]) == written[0]), (found.videos[..1].to_vec(), true));
    publish(folder.path(), &again.videos).expect("moving the files");
    assert!(read(&again.videos[0]) != written[0] && read(&found.videos[1]) == written[1]);
    assert!(!folder.path().join(STAGED).exists());
}
