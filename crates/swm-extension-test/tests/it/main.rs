//! Collects, stores, trains, loads, plans and evaluates with the extensions of this crate.
#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod env;
mod family;
mod format;
mod solver;

use std::sync::Arc;
use swm::core::registry::{Registry, concat};
use swm::core::run::Control;
use swm::core::{EnvEntry, RandomPolicy, VariationRequest};
use swm::data::{FormatEntry, WriteOptions};
use swm::eval::{CollectConfig, EvalConfig, Starts, World, WorldConfig};
use swm::models::{Device, FamilyEntry, TrainOptions, TrainRun, load_from};
use swm::plan::{MpcConfig, MpcPolicy, SolverEntry};

/// The built-in environments and the environment of this test, in one registry.
static ENVS: Registry<EnvEntry> = Registry { rows: &ENV_ROWS, ..swm::envs::ENVS };
const ENV_ROWS: [EnvEntry; swm::envs::ENVS.rows.len() + 1] = concat(swm::envs::ENVS.rows, &[env::ENTRY]);
static FORMATS: Registry<FormatEntry> = Registry { kind: "dataset format", hint: "", rows: &[format::ENTRY] };
static SOLVERS: Registry<SolverEntry> = Registry { kind: "solver", hint: "", rows: &[solver::ENTRY] };
static FAMILIES: Registry<FamilyEntry> = Registry { kind: "model", hint: "", rows: &[family::ENTRY] };

#[test]
fn registered_extensions_collect_train_plan_and_evaluate() {
    let folder = tempfile::tempdir().unwrap();
    let env = ENVS.choose("ext/Line-v0").unwrap();
    let config =
        WorldConfig { envs: 2, image: None, max_episode_steps: Some(20), threads: 2, ..WorldConfig::default() };
    let mut world = World::new(env, config).unwrap();

    let format = FORMATS.get("json").unwrap();
    let dataset = folder.path().join("line.extjson").into();
    let collecting = CollectConfig { episodes: 20, seed: 1, policy: "random".into(), ..CollectConfig::default() };
    let writer = format.create(&dataset, &world.collect_schema(&collecting).unwrap(), WriteOptions::default()).unwrap();
    let mut random = RandomPolicy::new(world.spec(), world.pool().len());
    world.collect(&mut random, writer, &collecting, &mut Control::new()).unwrap();
    let reader = format.open(&dataset).unwrap();
    assert_eq!(reader.episodes().len(), 20);

    let family = FAMILIES.get("line").unwrap();
    let requirements = (family.requirements)().unwrap().unwrap();
    assert_eq!((requirements.model, requirements.clip_rows), ("Line", 2));
    let run = folder.path().join("run");
    let options = TrainOptions { threads: 1, ..TrainOptions::default() };
    let training = (family.config)("tiny", &[]).unwrap();
    training
        .train(TrainRun { reader: Arc::clone(&reader), encoder: None, out: &run, options }, &mut Control::new())
        .unwrap();

    let model = load_from(FAMILIES.rows, &run, &Device::flex()).unwrap();
    let scale = model.info().unwrap().dataset_info.action;
    let solver = (SOLVERS.get("grid").unwrap().make)(&serde_json::json!({})).unwrap();
    let planning = MpcConfig { horizon: 3, receding_horizon: 1, action_block: 1, ..MpcConfig::default() };
    let slots = world.pool().len();
    let mut policy = MpcPolicy::new(solver, model.cost().unwrap(), planning, scale, world.spec(), slots).unwrap();
    let starts = Starts::episodic(10, 7, VariationRequest::default()).unwrap();
    let evaluation = EvalConfig { policy: "line".into(), ..EvalConfig::default() };
    let result = world.evaluate(&mut policy, &starts, &evaluation, &mut Control::new()).unwrap();
    assert_eq!(result.episodes.len(), 10);
    assert!(result.success.rate > 0.9, "{:?}", result.success);
}
