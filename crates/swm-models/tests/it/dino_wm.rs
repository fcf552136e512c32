//! DINO-WM: training is exact and learns while its encoder stays as it is; its cost depends on one environment alone.

use crate::dots::{Dots, SIDE, draw};
use burn::tensor::Device;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use swm_core::{Batch, Candidates, ColumnSpec, CostModel, DType, Key, Manifest, Result, Schema};
use swm_models::dino_wm::{DinoWm, DinoWmCost};
use swm_models::nn::parameters;
use swm_models::train::DatasetInfo;
use swm_models::{Checkpoint, TrainConfig, TrainOptions, TrainSummary, Trainable, train};

const ENVS: usize = 3;
const SAMPLES: usize = 19;
const HORIZON: usize = 3;
const DIM: usize = 4;

/// Sees pictures, places and actions.
const PLACES: &str = "model.columns=[{ name = \"place\", dim = 3 }, { name = \"action\", dim = 5 }]";
/// Sees pictures and actions.
const PICTURES: &str = "model.columns=[{ name = \"action\", dim = 5 }]";

/// A model of a few thousand parameters.
fn config(words: &[&str]) -> Result<TrainConfig<DinoWm>> {
    let small = [
        "model.image=16",
        "model.encoder.vit.patch=8",
        "model.encoder.vit.dim=12",
        "model.encoder.vit.mlp=24",
        "model.predictor.history=2",
        "model.predictor.depth=1",
        "model.predictor.dim_head=8",
        "model.predictor.mlp=32",
        "model.predictor.dropout=0.1",
        "data.frameskip=2",
        "data.num_steps=4",
        "data.batch_size=16",
        "schedule.steps=10",
        "schedule.warmup=2",
        "log_every=5",
    ];
    let words: Vec<String> = small.iter().chain(words).map(|&word| word.to_owned()).collect();
    TrainConfig::load("tiny", &words)
}

fn run(config: &TrainConfig<DinoWm>, out: &Path, threads: usize) -> Result<TrainSummary> {
    let options = TrainOptions { threads, ..TrainOptions::default() };
    train(config, Arc::new(Dots::new(6, 0)), out, &options, &mut (), &AtomicBool::new(false))
}

fn dataset_info(config: &TrainConfig<DinoWm>) -> DatasetInfo {
    let columns: Vec<String> = config.model.columns.iter().map(|column| column.name.clone()).collect();
    DatasetInfo::from_reader(&Dots::new(2, 0), &columns, false).expect("facts")
}

#[test]
fn threads_do_not_change_a_byte_and_the_encoder_is_frozen() {
    let folder = tempfile::tempdir().expect("a folder");
    let config = config(&[PLACES, "model.decoder=16"]).expect("a configuration");
    let one = run(&config, &folder.path().join("1"), 1).expect("trained");
    let two = run(&config, &folder.path().join("2"), 2).expect("trained");
    assert_eq!(one.weights, two.weights);
    let loaded = Checkpoint::<DinoWm>::load(&folder.path().join("1"), &Device::flex()).expect("it loads");
    let key = Key::new(config.seed).with("init");
    let fresh = DinoWm::new(&config, &loaded.dataset_info, key, &Device::flex()).expect("a model");
    let (before, after) = (parameters::values(&fresh), parameters::values(&loaded.model));
    for (name, value) in &before {
        assert_eq!(name.starts_with("backbone."), after[name] == *value, "{name}");
    }
}

#[test]
fn training_learns_to_predict() {
    let folder = tempfile::tempdir().expect("a folder");
    let words = [
        PLACES,
        "model.decoder=16",
        "schedule.steps=200",
        "log_every=20",
        "model.predictor.dropout=0",
        "optim.lr=3e-3",
    ];
    run(&config(&words).expect("a configuration"), folder.path(), 2).expect("trained");
    let lines = std::fs::read_to_string(folder.path().join("train.jsonl")).expect("lines");
    let number = |line: Option<&str>, name: &str| {
        let line: serde_json::Value = serde_json::from_str(line.expect("a line")).expect("JSON");
        line[name].as_f64().unwrap_or_else(|| panic!("{name} in {line}"))
    };
    for name in ["loss", "prediction", "pixels", "reconstruction"] {
        let (first, last) = (number(lines.lines().next(), name), number(lines.lines().last(), name));
        assert!(last < 0.5 * first, "{name}: {first} to {last}");
    }
}

#[test]
fn what_does_not_fit_is_told() {
    let message = |words: &[&str]| config(words).expect_err("wrong").to_string();
    assert!(message(&["model.columns=[]"]).contains("name = \"action\""));
    assert!(message(&[PICTURES, "model.encoder.vit.patch=7"]).contains("model.encoder"));
    let folder = tempfile::tempdir().expect("a folder");
    let trained = |words: &[&str]| {
        let config = config(words).expect("a configuration");
        run(&config, &folder.path().join("none"), 1).expect_err("wrong").to_string()
    };
    let missing = "model.columns=[{ name = \"velocity\", dim = 3 }, { name = \"action\", dim = 5 }]";
    assert!(trained(&[missing]).contains("velocity"), "{}", trained(&[missing]));
    assert!(trained(&[PICTURES, "model.image=32"]).contains("[32, 32, 3]"));
    let weights = trained(&[PICTURES, "model.weights=nowhere.pt"]);
    assert!(weights.contains("nowhere.pt") && weights.contains("facebook/dinov2-small"), "{weights}");
}

fn checkpoint(words: &[&str]) -> Checkpoint<DinoWm> {
    let config = config(words).expect("a configuration");
    let dataset_info = dataset_info(&config);
    let model = DinoWm::new(&config, &dataset_info, Key::new(3), &Device::flex()).expect("a model");
    Checkpoint { model, config, dataset_info, manifest: Manifest::new("train", 0, serde_json::Value::Null) }
}

fn infos(more: &[&str]) -> Batch {
    let mut columns = vec![ColumnSpec::image("pixels", SIDE, SIDE), ColumnSpec::image("goal", SIDE, SIDE)];
    columns.extend(more.iter().map(|name| match *name {
        "history.length" => ColumnSpec::new(*name, DType::Int32, []),
        "history.action" => ColumnSpec::new(*name, DType::Float32, [1, DIM]),
        "history.pixels" => ColumnSpec::new(*name, DType::U8, [1, SIDE, SIDE, 3]),
        place => ColumnSpec::new(place, DType::Float32, [2]),
    }));
    let mut infos = Batch::zeros(&Schema::new(columns).expect("columns"), ENVS);
    for env in 0..ENVS {
        let mut row = infos.row_mut(env);
        draw([3.0 + env as f32, 5.0], row.at::<u8>(0));
        draw([10.0, 3.0 + 2.0 * env as f32], row.at::<u8>(1));
        for (index, name) in more.iter().enumerate() {
            match *name {
                "history.length" => row.set(2 + index, &[env as i32 % 2]),
                "history.action" => row.set(2 + index, &[0.5, -0.5, env as f32, 0.25]),
                "history.pixels" => draw([2.0 + env as f32, 5.0], row.at::<u8>(2 + index)),
                "place" => row.set(2 + index, &[3.0 + env as f32, 5.0]),
                _ => row.set(2 + index, &[10.0, 3.0 + 2.0 * env as f32]),
            }
        }
    }
    infos
}

fn candidates() -> Vec<f32> {
    use rand::Rng as _;
    let mut rng = Key::new(9).rng();
    (0..ENVS * SAMPLES * HORIZON * DIM).map(|_| rng.random_range(-1.0..1.0f32)).collect()
}

/// Costs and their gradients.
fn costs(words: &[&str], infos: &Batch, envs: &[usize], threads: usize) -> (Vec<f32>, Vec<f32>) {
    let (per_env, all) = (SAMPLES * HORIZON * DIM, candidates());
    let actions: Vec<f32> = envs.iter().flat_map(|&env| all[env * per_env..][..per_env].to_vec()).collect();
    let mut model = DinoWmCost::new(&checkpoint(words));
    let (mut plain, mut costs) = (vec![f32::NAN; envs.len() * SAMPLES], vec![f32::NAN; envs.len() * SAMPLES]);
    let mut slopes = vec![f32::NAN; actions.len()];
    swm_core::pool::threads(threads).expect("threads").install(|| {
        model.observe(infos, envs).expect("observed");
        let candidates =
            Candidates { actions: &actions, envs: envs.len(), samples: SAMPLES, horizon: HORIZON, dim: DIM };
        model.cost(candidates, &mut plain).expect("costs");
        let differentiable = model.differentiable().expect("it has a gradient");
        differentiable.cost_and_gradient(candidates, &mut costs, &mut slopes).expect("gradients");
    });
    for (cost, plain) in costs.iter().zip(&plain) {
        assert!((cost - plain).abs() < 1e-4 * plain.abs(), "{cost}, not {plain}");
    }
    (plain, slopes)
}

#[test]
fn neighbours_and_threads_do_not_change_a_cost() {
    let history = ["history.length", "history.action", "history.pixels"];
    for (words, more) in [(PICTURES, &[][..]), (PICTURES, &history), (PLACES, &["place", "goal_place"])] {
        let infos = infos(more);
        let together = costs(&[words], &infos, &[0, 1, 2], 2);
        assert!(together.0.windows(2).any(|pair| pair[0] != pair[1]), "actions have no effect");
        assert_eq!(together, costs(&[words], &infos, &[0, 1, 2], 1));
        for env in 0..ENVS {
            let (alone, slopes) = costs(&[words], &infos, &[env], 2);
            assert_eq!(together.0[env * SAMPLES..][..SAMPLES], alone[..]);
            let per_env = SAMPLES * HORIZON * DIM;
            assert_eq!(together.1[env * per_env..][..per_env], slopes[..]);
        }
    }
}

#[test]
fn gradients_are_slopes_of_the_cost() {
    let (infos, all) = (infos(&["place", "goal_place"]), candidates());
    let numbers = HORIZON * DIM;
    let mut model = DinoWmCost::new(&checkpoint(&[PLACES]));
    model.observe(&infos, &[1]).expect("observed");
    let slopes = costs(&[PLACES], &infos, &[1], 1).1;
    let mut moved = |i: usize, by: f32| {
        let mut actions = all[SAMPLES * numbers..][..numbers].to_vec();
        actions[i] += by;
        let mut cost = [0.0];
        let one = Candidates { actions: &actions, envs: 1, samples: 1, horizon: HORIZON, dim: DIM };
        model.cost(one, &mut cost).expect("a cost");
        cost[0]
    };
    let largest = slopes[..numbers].iter().fold(0.0f32, |most, slope| slope.abs().max(most));
    for (i, slope) in slopes[..numbers].iter().enumerate() {
        let difference = (moved(i, 2e-2) - moved(i, -2e-2)) / 4e-2;
        assert!((difference - slope).abs() < 0.03 * largest, "number {i}: {slope}, not {difference}");
    }
}

#[test]
fn pasts_and_goals_of_columns_count_where_there_are_such() {
    let history = ["history.length", "history.action", "history.pixels"];
    let (with, without) =
        (costs(&[PICTURES], &infos(&history), &[0, 1], 1), costs(&[PICTURES], &infos(&[]), &[0, 1], 1));
    // Environment 0 has a past of length 0, environment 1 of length 1.
    assert_eq!(with.0[..SAMPLES], without.0[..SAMPLES]);
    assert_ne!(with.0[SAMPLES..], without.0[SAMPLES..]);
    let (with, without) =
        (costs(&[PLACES], &infos(&["place", "goal_place"]), &[0], 1), costs(&[PLACES], &infos(&["place"]), &[0], 1));
    assert!(with.0.iter().zip(&without.0).all(|(with, without)| with > without), "a distance was added");
    let mut model = DinoWmCost::new(&checkpoint(&[PLACES]));
    let message = model.observe(&infos(&[]), &[0]).expect_err("no place").to_string();
    assert!(message.contains("place"), "{message}");
}
