//! Collecting to and evaluating from a Lance dataset on disk, with a native environment.

use std::path::Path;
use swm_core::policy::ExpertPolicy;
use swm_core::run::Control;
use swm_core::{Error, RandomPolicy, VariationRequest};
use swm_data::{WriteMode, WriteOptions};
use swm_envs::two_room::ENTRY;
use swm_eval::{CollectConfig, Collected, EvalConfig, Starts, World, WorldConfig};

fn world(envs: usize, threads: usize) -> World {
    World::new(&ENTRY, WorldConfig { envs, image: Some((28, 28)), views: vec![], max_episode_steps: Some(60), threads })
        .expect("creating the world")
}

fn expert(world: &World) -> ExpertPolicy {
    let experts = (0..world.pool().len()).map(|_| (ENTRY.experts[0].make)()).collect();
    ExpertPolicy::new(world.spec(), experts)
}

fn collect(path: &Path, mode: WriteMode, envs: usize, episodes: usize) -> Collected {
    let mut world = world(envs, 2);
    let variation = VariationRequest { variation: Some(vec!["all".to_owned()]), ..VariationRequest::default() };
    let config = CollectConfig { episodes, seed: 4, variation, policy: "expert".into(), ..CollectConfig::default() };
    let manifest = Some(world.collect_manifest(&config));
    let options = WriteOptions { mode, manifest, ..WriteOptions::default() };
    let schema = world.collect_schema(&config).expect("creating the schema of collected episodes");
    let writer = swm_data::create(path, &schema, options).expect("creating the dataset");
    let mut policy = expert(&world);
    world.collect(&mut policy, writer, &config, &mut Control::default()).expect("the collection succeeds")
}

#[test]
fn resumed_dataset_has_the_same_content() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let [complete, parts] = ["whole.lance", "parts.lance"].map(|name| folder.path().join(name));
    collect(&complete, WriteMode::Create, 8, 12);
    collect(&parts, WriteMode::Create, 3, 5);
    let resumed = collect(&parts, WriteMode::Append, 1, 12);
    assert_eq!((resumed.episodes, resumed.added), (12, 7));
    let [complete, parts] = [complete, parts].map(|path| swm_data::open(&path).expect("opening the dataset"));
    assert_eq!(
        complete.content_hash().expect("hashing the content"),
        parts.content_hash().expect("hashing the content")
    );
    assert_eq!(complete.manifest(), parts.manifest());
    assert_eq!(complete.manifest().expect("a manifest").config["env"], "swm/TwoRoom-v1");
}

#[test]
fn expert_reaches_recorded_goals() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("rooms.lance");
    collect(&path, WriteMode::Create, 4, 10);
    let reader = swm_data::open(&path).expect("opening the dataset");
    let picks = Starts::choose(&*reader, 20, 6, 0).expect("the dataset has enough starts");
    let mut world = world(5, 2);
    let spec = world.spec().clone();
    let evaluate = |world: &mut World, random: bool, variation: VariationRequest| {
        let starts = Starts::from_dataset(&*reader, world.pool().env(0), picks.clone(), 6, 0, variation, &[])
            .expect("creating the starts");
        let config = EvalConfig { budget: Some(30), ..EvalConfig::default() };
        let control = &mut Control::default();
        if random {
            world
                .evaluate(&mut RandomPolicy::new(&spec, 5), &starts, &config, control)
                .expect("the evaluation succeeds")
        } else {
            let mut policy = expert(world);
            world.evaluate(&mut policy, &starts, &config, control).expect("the evaluation succeeds")
        }
    };
    let expert = evaluate(&mut world, false, VariationRequest::default());
    let random = evaluate(&mut world, true, VariationRequest::default());
    assert!(expert.success.rate > 0.8, "{:?}", expert.success);
    assert!(expert.success.low > random.success.high, "{:?} and {:?}", expert.success, random.success);
    assert_eq!(expert.solved_at_start, random.solved_at_start, "both policies have the same starts");
    let color = VariationRequest { variation: Some(vec!["agent.color".to_owned()]), ..VariationRequest::default() };
    assert_eq!(evaluate(&mut world, false, color).success, expert.success, "the expert does not depend on colours");
}

#[test]
fn dataset_of_another_environment_is_an_error() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("line.lance");
    let line = WorldConfig { envs: 1, image: None, views: vec![], max_episode_steps: None, threads: 1 };
    let mut line = World::new(&crate::line::ENTRY, line).expect("creating the world");
    let config = CollectConfig { episodes: 1, ..CollectConfig::default() };
    let writer = swm_data::create(
        &path,
        &line.collect_schema(&config).expect("creating the schema of collected episodes"),
        WriteOptions::default(),
    );
    let writer = writer.expect("creating the dataset");
    line.collect(&mut crate::line::Walker, writer, &config, &mut Control::default()).expect("the collection succeeds");
    let reader = swm_data::open(&path).expect("opening the dataset");
    let starts =
        Starts::from_dataset(&*reader, world(1, 1).pool().env(0), vec![[0, 0]], 1, 0, VariationRequest::default(), &[]);
    let error = starts.expect_err("another environment");
    assert!(matches!(error, Error::Mismatch { .. }) && error.to_string().contains("swm/TwoRoom-v1"), "{error}");
}
