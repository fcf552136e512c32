//! Online training gives the same bytes with any number of threads, interrupted or not.

use crate::training::stop_after;
use std::path::Path;
use std::sync::Arc;
use swm_core::run::Control;
use swm_core::{Batch, ColumnSpec, DType, EnvPool, Result, Schema};
use swm_data::{Constants, ReplayBuffer, WriteOptions};
use swm_models::online::{Agent, OnlineSummary, train_online};
use swm_models::sac::Sac;
use swm_models::tdmpc2::Tdmpc2;
use swm_models::{TrainConfig, TrainOptions, Trainable, run_folder, train};

const PENDULUM: &str = "swm/PendulumControl-v1";

/// Networks of a few hundred parameters, episodes of 20 steps.
pub fn config<M: Trainable>(settings: &[&str]) -> TrainConfig<M> {
    let family: &[&str] = match M::FAMILY {
        "sac" => &["model.hidden=8"],
        _ => &[
            "model.encoding=[{ column = \"state\", latent = 8 }]",
            "model.simplex=4",
            "model.encoder=8",
            "model.hidden=8",
            "model.bins.count=7",
            "model.dropout=0.1",
            "online.planner.samples=12",
            "online.planner.elites=4",
            "online.planner.proposals=3",
            "online.planner.iterations=2",
        ],
    };
    let small = [
        "data.batch_size=16",
        "schedule.steps=24",
        "online.envs=3",
        "online.updates=2",
        "online.warmup=60",
        "online.capacity=200",
        "online.part=8",
        "online.evaluate_every=8",
        "online.evaluate_episodes=4",
        "log_every=8",
    ];
    let settings: Vec<String> =
        family.iter().chain(&small).chain(settings).map(|&setting| setting.to_owned()).collect();
    TrainConfig::load("tiny", &settings).expect("loading the configuration")
}

/// Makes pools of the environment `id`, whose episodes are truncated after `steps` steps.
fn pools(id: &'static str, steps: Option<usize>) -> impl Fn(usize) -> Result<EnvPool> {
    move |count| {
        let entry = swm_envs::ENVS.get(id)?;
        let envs = (0..count).map(|_| entry.env()).collect::<Result<Vec<_>>>()?;
        EnvPool::new(envs, None, steps, swm_core::pool::threads(2)?)
    }
}

fn run<M: Agent>(config: &TrainConfig<M>, out: &Path, options: &TrainOptions, stop_at: usize) -> Result<OnlineSummary> {
    train_online(config, &pools(PENDULUM, Some(20)), out, options, &mut stop_after(stop_at))
}

/// Reads the files of a run that its configuration determines.
fn files(run: &Path) -> Vec<Vec<u8>> {
    let of = |folder: &str, name: &str| std::fs::read(run.join(folder).join(name)).expect(name);
    let data_folders = std::fs::read_dir(run)
        .expect("listing a folder")
        .map(|entry| entry.expect("reading the folder entry").file_name());
    let data_folders: Vec<String> = data_folders
        .map(|name| name.to_string_lossy().into_owned())
        .filter(|name| name.starts_with("played-"))
        .collect();
    assert_eq!(data_folders.len(), 1, "{data_folders:?}");
    let mut files: Vec<Vec<u8>> = ["config.json", "weights.safetensors", "optimizer.safetensors", "state.json"]
        .map(|name| of("checkpoint", name))
        .to_vec();
    files.push(of(&data_folders[0], "place.json"));
    files
}

/// The lines of the log without the values that depend on time.
pub fn lines(run: &Path) -> Vec<serde_json::Value> {
    let lines = std::fs::read_to_string(run.join("train.jsonl")).expect("reading train.jsonl");
    let fixed = |line: &str| {
        let mut line: serde_json::Value = serde_json::from_str(line).expect("parsing the JSON");
        for name in ["clips_per_second", "playing", "data_wait", "seconds"] {
            line.as_object_mut().expect("an object").remove(name);
        }
        line
    };
    lines.lines().map(fixed).collect()
}

fn check_threads<M: Agent>() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let config = config::<M>(&[]);
    let out = |name: &str| folder.path().join(name);
    for (name, threads) in [("one", 1), ("three", 3)] {
        let options = TrainOptions { threads, ..crate::options() };
        let summary = run(&config, &out(name), &options, 0).expect("training the model");
        assert_eq!((summary.steps, summary.interrupted), (24, false));
        // The warm-up makes 60 environment steps; each of the 12 later rounds makes one step of 3 environments.
        assert_eq!(summary.env_steps, 60 + 12 * 3);
        assert!(summary.evaluated.is_some() && summary.best.is_some());
    }
    assert_eq!(files(&out("one")), files(&out("three")));
    assert_eq!(lines(&out("one")), lines(&out("three")));
    let other = self::config::<M>(&["seed=1"]);
    run(&other, &out("other"), &crate::options(), 0).expect("training the model");
    assert_ne!(files(&out("other"))[1], files(&out("one"))[1]);
}

#[test]
fn online_results_do_not_depend_on_threads() {
    check_threads::<Sac>();
    check_threads::<Tdmpc2>();
}

#[test]
fn resumed_online_run_gives_the_files_of_an_uninterrupted_run() {
    check_resuming::<Sac>();
    // Its policy remembers its last plan.
    check_resuming::<Tdmpc2>();
}

fn check_resuming<M: Agent>() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let (complete, resumed) = (folder.path().join("complete"), folder.path().join("resumed"));
    let config = config::<M>(&[]);
    let options = crate::options();
    run(&config, &complete, &options, 0).expect("training the model");
    let first = run(&config, &resumed, &options, 10).expect("training the model");
    assert_eq!((first.steps, first.interrupted), (10, true));
    let refused = run(&config, &resumed, &options, 0).expect_err("the folder holds a run").to_string();
    assert!(refused.contains("resume"), "{refused}");
    let resume = TrainOptions { resume: true, ..options };
    // A changed number of the running episodes is noticed.
    let place = resumed.join("played-10/place.json");
    let stored = std::fs::read(&place).expect("reading the running episodes");
    let mut changed = stored.clone();
    let digit = changed.iter_mut().find(|byte| byte.is_ascii_digit()).expect("a number");
    *digit = if *digit == b'1' { b'2' } else { b'1' };
    std::fs::write(&place, changed).expect("writing");
    let damaged = run(&config, &resumed, &resume, 0).expect_err("damaged episodes").to_string();
    assert!(damaged.contains("its hash differs"), "{damaged}");
    std::fs::write(&place, stored).expect("writing");
    let second = run(&config, &resumed, &resume, 0).expect("training the model");
    assert_eq!((second.steps, second.interrupted), (24, false));
    assert_eq!(files(&complete), files(&resumed));
    assert_eq!(lines(&complete), lines(&resumed), "each line averages the steps since the line before");
    let other = run(&self::config::<M>(&["optim.lr=1e-4"]), &resumed, &resume, 0)
        .expect_err("another configuration")
        .to_string();
    assert!(other.contains("optim.lr"), "{other}");
}

#[test]
fn run_is_not_resumed_with_another_time_limit() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let (config, out) = (config::<Sac>(&[]), folder.path());
    run(&config, out, &crate::options(), 10).expect("training the model");
    let options = TrainOptions { resume: true, ..crate::options() };
    let resumed =
        |limit| train_online(&config, &pools(PENDULUM, limit), out, &options, &mut stop_after(12)).map(|run| run.steps);
    for (limit, steps) in [(Some(30), 30), (Some(10), 10), (None, 200)] {
        let error = resumed(limit).expect_err("another time limit").to_string();
        let expected = format!("another time limit of episodes (stored 20 steps, requested {steps})");
        assert!(error.contains(&expected), "{error}");
    }
    // Earlier programs stored neither the time limit nor the hash.
    let place = out.join("played-10/place.json");
    let text = std::fs::read_to_string(&place).expect("reading the running episodes");
    let text = text.lines().next().expect("a line").replace("\"max_steps\":20,", "");
    assert!(!text.contains("max_steps"), "{text}");
    std::fs::write(&place, text).expect("writing");
    assert_eq!(resumed(Some(20)).expect("continuing the run"), 12);
}

#[test]
fn run_whose_best_weights_are_missing_or_damaged_is_not_resumed() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let (config, out) = (config::<Sac>(&[]), folder.path());
    run(&config, out, &crate::options(), 10).expect("training the model");
    let resume = TrainOptions { resume: true, ..crate::options() };
    let refused = |fault: &str| {
        let error = run(&config, out, &resume, 0).expect_err("it has no best weights").to_string();
        assert!(error.contains(&format!("the best weights of the run, those of step 8, are {fault}")), "{error}");
    };
    let (best, moved) = (out.join("best"), out.join("moved"));
    std::fs::rename(&best, &moved).expect("moving the best checkpoint");
    refused("missing");
    std::fs::rename(&moved, &best).expect("moving it back");
    let weights = best.join("checkpoint/weights.safetensors");
    let stored = std::fs::read(&weights).expect("reading the weights");
    let mut changed = stored.clone();
    *changed.last_mut().expect("a byte") ^= 1;
    std::fs::write(&weights, changed).expect("changing the weights");
    refused("damaged");
    std::fs::write(&weights, stored).expect("restoring the weights");
    assert_eq!(run(&config, out, &resume, 0).expect("continuing the run").steps, 24);
}

#[test]
fn columns_that_single_precision_does_not_tell_apart_are_refused() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let schema = Schema::new([
        ColumnSpec::new("state", DType::Float64, [2]),
        ColumnSpec::new("action", DType::Float32, [1]),
        ColumnSpec::new("reward", DType::Float32, []),
        ColumnSpec::new("terminated", DType::Bool, []),
    ])
    .expect("creating the schema");
    let trained = |name: &str, value: &dyn Fn(usize) -> f64| {
        let replay = ReplayBuffer::new(&schema, 1000).expect("a buffer");
        for episode in 0..4 {
            let mut rows = Batch::zeros(&schema, 20);
            for step in 0..20 {
                rows.row_mut(step).set(0, &[0.5, value(20 * episode + step)]);
                rows.row_mut(step).set(1, &[if step == 19 { f32::NAN } else { (step as f32).sin() }]);
            }
            replay.add(&rows, &Constants::default()).expect("an episode");
        }
        let data = folder.path().join(format!("{name}.lance"));
        replay.save(&data, WriteOptions::default()).expect("a dataset");
        let (config, reader) = (config::<Tdmpc2>(&[]), swm_data::open(data).expect("a dataset"));
        let out = folder.path().join(name);
        train(&config, reader, &out, &crate::options(), &mut Control::new()).map(drop).map_err(|e| e.to_string())
    };
    let wave = |step: usize| (step as f64).sin();
    for (name, value) in [
        ("offset", &(|step: usize| f64::from(1 << 30) + wave(step)) as &dyn Fn(usize) -> f64),
        ("huge", &|step: usize| if step == 7 { -1e39 } else { wave(step) }),
    ] {
        let error = trained(name, value).expect_err(name);
        assert!(error.contains("column 'state'") && error.contains("element 1") && error.contains("offset"), "{error}");
        assert!(!folder.path().join(name).exists());
    }
    // A body at rest, a counter, and a coordinate.
    trained("rest", &|step: usize| 1.0 + 1e-5 * wave(step)).expect("a body at rest");
    trained("counter", &|step: usize| 1e3 * step as f64).expect("a counter");
    trained("far", &|step: usize| 100.0 + wave(step)).expect("a coordinate");
}

#[test]
fn invalid_settings_and_data_are_refused() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let refused = |config: &TrainConfig<Sac>, id: &'static str| {
        let out = folder.path().join("refused");
        let error = train_online(config, &pools(id, None), &out, &crate::options(), &mut Control::new());
        error.expect_err("the call must fail").to_string()
    };
    let discrete = refused(&config(&[]), "swm/CartPoleControl-v1");
    assert!(discrete.contains("continuous actions"), "{discrete}");
    let column = refused(&config(&["model.columns=[\"stat\"]"]), PENDULUM);
    assert!(column.contains("stat") && column.contains("state"), "{column}");
    let mut offline = config::<Sac>(&[]);
    offline.online = None;
    let missing = refused(&offline, PENDULUM);
    assert!(missing.contains("online") && missing.contains("--data"), "{missing}");

    let message = |setting: &str| {
        TrainConfig::<Tdmpc2>::load("tiny", &[setting.to_owned()]).expect_err("loading must fail").to_string()
    };
    assert!(message("model.simplex=7").contains("multiple"), "{}", message("model.simplex=7"));
    assert!(message("data.frameskip=5").contains("rewards"), "{}", message("data.frameskip=5"));
    assert!(message("loss.discount=1.5").contains("loss.discount"));

    let without_rewards = Arc::new(crate::dots::Dots::new(6, 0));
    let error = train(
        &config::<Tdmpc2>(&[]),
        without_rewards,
        &folder.path().join("dots"),
        &crate::options(),
        &mut Control::new(),
    );
    let error = error.expect_err("a dataset without rewards").to_string();
    assert!(error.contains("'reward'") && error.contains("swm collect"), "{error}");
}

#[test]
fn settings_without_effect_are_refused() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    for settings in [
        &["optim.accumulate=2"][..],
        &["optim.ema=0.9"],
        &["data.hold_out=true"],
        &["data.hold_out=true", "validation.every=4"],
    ] {
        let error =
            run(&config::<Sac>(settings), folder.path(), &TrainOptions::default(), 1).expect_err("it is refused");
        let text = error.to_string();
        assert!(text.contains("has no effect when a model learns in an environment"), "{settings:?}: {text}");
    }
    let shards = TrainConfig::<Sac>::load("tiny", &["shards=2".to_owned()]).expect_err("SAC has no shards").to_string();
    assert!(shards.contains("leave it at 1"), "{shards}");
    assert_eq!(std::fs::read_dir(folder.path()).expect("listing the folder").count(), 0);
}

#[test]
fn removed_run_keeps_files_among_its_replay_data() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let out = folder.path().join("run");
    run(&config::<Sac>(&[]), &out, &crate::options(), 0).expect("the run");
    let thesis = out.join("played-24/replay.lance/data/thesis.lance");
    std::fs::write(&thesis, "thesis").expect("writing a file of the user");
    let remaining = run_folder::remove(&out).expect("removing the run");
    assert_eq!(remaining, [out.join("played-24")]);
    assert_eq!(std::fs::read(&thesis).expect("reading the file of the user"), b"thesis");
    let entries = |path: &Path| std::fs::read_dir(path).expect("listing a folder").count();
    let data = thesis.parent().expect("the folder of the file");
    assert_eq!((entries(data), entries(data.parent().expect("the dataset"))), (1, 1));
}
