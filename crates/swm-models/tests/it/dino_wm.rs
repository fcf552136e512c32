//! DINO-WM: training does not depend on threads and keeps the encoder frozen; costs do not depend on other
//! environments.

use crate::dots::{Dots, SIDE, draw};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use swm_core::run::Control;
use swm_core::{Batch, Candidates, ColumnSpec, CostModel, DType, Key, Manifest, Result, Schema};
use swm_models::dino_wm::{DinoWm, DinoWmCost};
use swm_models::nn::{BackboneConfig, Init, parameters};
use swm_models::train::DatasetInfo;
use swm_models::{Checkpoint, TrainConfig, TrainOptions, TrainSummary, Trainable, train, weights};

const ENVS: usize = 3;
const SAMPLES: usize = 19;
const HORIZON: usize = 3;
const DIM: usize = 4;

/// The setting of a model that observes images, positions and actions.
pub const POSITIONS: &str = "model.columns=[{ name = \"position\", dim = 3 }, { name = \"action\", dim = 5 }]";
/// The setting of a model that observes images and actions.
pub const IMAGES: &str = "model.columns=[{ name = \"action\", dim = 5 }]";

/// A model of a few thousand parameters.
pub fn config(overrides: &[&str]) -> Result<TrainConfig<DinoWm>> {
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
    let overrides = crate::overridden(&small, overrides);
    TrainConfig::load("tiny", &overrides)
}

fn run(config: &TrainConfig<DinoWm>, out: &Path, threads: usize) -> Result<TrainSummary> {
    let options = TrainOptions { threads, ..crate::options() };
    train(config, Arc::new(Dots::new(6, 0)), out, &options, &mut Control::new())
}

fn dataset_info(config: &TrainConfig<DinoWm>) -> DatasetInfo {
    let columns: Vec<String> = config.model.columns.iter().map(|column| column.name.clone()).collect();
    DatasetInfo::from_reader(&Dots::new(2, 0), &columns, false).expect("computing the dataset statistics")
}

#[test]
fn columns_of_other_types_train_as_their_float32_values() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let config = config(&[POSITIONS]).expect("loading the configuration");
    // Bytes have no fractions.
    for (other, is_whole) in [(DType::U8, true), (DType::Float64, false)] {
        let weights = [DType::Float32, other].map(|dtype| {
            let value = |value: f32| f64::from(if is_whole { value.round() } else { value });
            let reader = Arc::new(Dots::new(6, 0).stored_as(2, dtype, value));
            let out = folder.path().join(format!("{} {}", other.name(), dtype.name()));
            train(&config, reader, &out, &crate::options(), &mut Control::new()).expect("training the model").weights
        });
        assert_eq!(weights[0], weights[1], "{}", other.name());
    }
}

#[test]
fn results_do_not_depend_on_threads_and_the_encoder_is_frozen() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let config = config(&[POSITIONS, "model.decoder=16"]).expect("loading the configuration");
    let one = run(&config, &folder.path().join("1"), 1).expect("training the model");
    let two = run(&config, &folder.path().join("2"), 2).expect("training the model");
    assert_eq!(one.weights, two.weights);
    let loaded =
        Checkpoint::<DinoWm>::load(&folder.path().join("1"), &crate::device()).expect("loading the checkpoint");
    let init = Init::new(Key::new(config.seed).with("init"), &crate::device());
    let fresh = DinoWm::new(&config, &loaded.dataset_info, &init).expect("creating the model");
    let (before, after) = (parameters::values(&fresh), parameters::values(&loaded.model));
    for (name, value) in &before {
        assert_eq!(name.starts_with("backbone."), after[name] == *value, "{name}");
    }
}

#[test]
fn the_encoder_of_another_model_is_used_and_frames_are_encoded_once() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let other = crate::training::keypoints_config();
    let lewm = folder.path().join("lewm");
    train(&other, Arc::new(Dots::new(6, 0)), &lewm, &crate::options(), &mut Control::new()).expect("training LeWM");
    let mut with_idm = crate::pldm::config(&[]).expect("loading the configuration");
    with_idm.model.encoder = other.model.encoder.clone();
    let pldm = folder.path().join("pldm");
    train(&with_idm, Arc::new(Dots::new(6, 0)), &pldm, &crate::options(), &mut Control::new()).expect("training PLDM");
    for (from, prefix) in [(lewm, "encoder."), (pldm, "model.encoder.")] {
        let file = from.join("checkpoint/weights.safetensors");
        let mut config = config(&[IMAGES]).expect("loading the configuration");
        config.model.encoder = other.model.encoder.clone();
        config.model.weights = file.display().to_string();
        let (out, dots) = (from.join("dino"), Arc::new(Dots::new(6, 0)));
        train(&config, Arc::<Dots>::clone(&dots), &out, &crate::options(), &mut Control::new()).expect("training");
        assert_eq!(dots.frames_read.load(Ordering::Relaxed), 6 * 24);
        let trained = Checkpoint::<DinoWm>::load(&out, &crate::device()).expect("loading the checkpoint").model;
        let found = weights::read(&file).expect("reading the weights");
        let frozen = parameters::values(&trained.backbone);
        assert!(!frozen.is_empty());
        for (name, value) in frozen {
            assert_eq!(found[&format!("{prefix}{name}")], value, "{name}");
        }
        // The encoder of a DINO-WM is one as well; a damaged file of a checkpoint is none.
        let (nested, damaged) = (from.join("nested"), from.join("damaged"));
        config.model.weights = out.join("checkpoint/weights.safetensors").display().to_string();
        run(&config, &nested, 1).expect("training on the encoder of a DINO-WM");
        let bytes = std::fs::read(&file).expect("reading the weights");
        let mut changed = bytes.clone();
        changed[bytes.len() - 3] ^= 1;
        std::fs::write(&file, changed).expect("damaging the weights");
        config.model.weights = file.display().to_string();
        let error = run(&config, &damaged, 1).expect_err("damaged weights").to_string();
        assert!(error.contains("hash"), "{error}");
        std::fs::write(&file, bytes).expect("restoring the weights");
        let text = file.with_file_name("config.json");
        let stored = std::fs::read(&text).expect("reading the configuration");
        std::fs::write(&text, "{").expect("damaging the configuration");
        let error = run(&config, &damaged, 1).expect_err("a damaged configuration").to_string();
        assert!(error.contains("config.json"), "{error}");
        let changed = String::from_utf8(stored.clone()).expect("a text").replacen("\"seed\": ", "\"seed\": 1", 1);
        std::fs::write(&text, changed).expect("changing the configuration");
        let error = run(&config, &damaged, 1).expect_err("a changed configuration").to_string();
        assert!(error.contains("config.json"), "{error}");
        std::fs::write(&text, stored).expect("restoring the configuration");
        // The trained layers read other features than those they were trained with.
        let BackboneConfig::Keypoints(keypoints) = &mut config.model.encoder else {
            unreachable!("an encoder of keypoints")
        };
        keypoints.colours.reverse();
        let refused = |config: &TrainConfig<DinoWm>| {
            run(config, &from.join("refused"), 1).expect_err("other features").to_string()
        };
        let error = refused(&config);
        assert!(error.contains("set model.encoder.keypoints.colours=[[1.0, 0.5, -1.0], "), "{error}");
        config.model.weights.clear();
        assert!(refused(&config).contains("model.weights"), "an encoder that nobody trains");
    }
}

#[test]
fn training_reduces_every_loss() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let overrides = [
        POSITIONS,
        "model.decoder=16",
        "schedule.steps=200",
        "log_every=20",
        "model.predictor.dropout=0",
        "optim.lr=3e-3",
    ];
    run(&config(&overrides).expect("loading the configuration"), folder.path(), 2).expect("training the model");
    let lines = std::fs::read_to_string(folder.path().join("train.jsonl")).expect("reading train.jsonl");
    let value = |line: Option<&str>, name: &str| {
        let line: serde_json::Value =
            serde_json::from_str(line.expect("the log has a line")).expect("parsing the JSON");
        line[name].as_f64().unwrap_or_else(|| panic!("{name} in {line}"))
    };
    for name in ["loss", "prediction", "pixels", "reconstruction"] {
        let (first, last) = (value(lines.lines().next(), name), value(lines.lines().last(), name));
        assert!(last < 0.5 * first, "{name}: {first} to {last}");
    }
}

#[test]
fn invalid_settings_and_data_are_refused() {
    let message = |overrides: &[&str]| config(overrides).expect_err("the call must fail").to_string();
    assert!(message(&["model.columns=[]"]).contains("name = \"action\""));
    assert!(message(&[IMAGES, "model.encoder.vit.patch=7"]).contains("model.encoder"));
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let trained = |overrides: &[&str]| {
        let config = config(overrides).expect("loading the configuration");
        run(&config, &folder.path().join("none"), 1).expect_err("training must fail").to_string()
    };
    let missing = "model.columns=[{ name = \"velocity\", dim = 3 }, { name = \"action\", dim = 5 }]";
    assert!(trained(&[missing]).contains("velocity"), "{}", trained(&[missing]));
    assert!(trained(&[IMAGES, "model.image=32"]).contains("[32, 32, 3]"));
    let weights = trained(&[IMAGES, "model.weights=nowhere.pt"]);
    assert!(weights.contains("nowhere.pt") && weights.contains("facebook/dinov2-small"), "{weights}");
}

fn checkpoint(overrides: &[&str]) -> Checkpoint<DinoWm> {
    let config = config(overrides).expect("loading the configuration");
    let dataset_info = dataset_info(&config);
    let model =
        DinoWm::new(&config, &dataset_info, &Init::new(Key::new(3), &crate::device())).expect("creating the model");
    Checkpoint { model, config, dataset_info, manifest: Manifest::new("train", 0, serde_json::Value::Null) }
}

fn infos(extra_columns: &[&str]) -> Batch {
    let mut columns = vec![ColumnSpec::image("pixels", SIDE, SIDE), ColumnSpec::image("goal", SIDE, SIDE)];
    columns.extend(extra_columns.iter().map(|name| match *name {
        "history.length" => ColumnSpec::new(*name, DType::Int32, []),
        "history.action" => ColumnSpec::new(*name, DType::Float32, [1, DIM]),
        "history.pixels" => ColumnSpec::new(*name, DType::U8, [1, SIDE, SIDE, 3]),
        position => ColumnSpec::new(position, DType::Float32, [2]),
    }));
    let mut infos = Batch::zeros(&Schema::new(columns).expect("creating the schema"), ENVS);
    for env in 0..ENVS {
        let mut row = infos.row_mut(env);
        draw([3.0 + env as f32, 5.0], row.at::<u8>(0));
        draw([10.0, 3.0 + 2.0 * env as f32], row.at::<u8>(1));
        for (index, name) in extra_columns.iter().enumerate() {
            match *name {
                "history.length" => row.set(2 + index, &[env as i32 % 2]),
                "history.action" => row.set(2 + index, &[0.5, -0.5, env as f32, 0.25]),
                "history.pixels" => draw([2.0 + env as f32, 5.0], row.at::<u8>(2 + index)),
                "position" => row.set(2 + index, &[3.0 + env as f32, 5.0]),
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

/// Costs `[envs * samples]` and their gradients `[envs * samples, horizon, dim]`.
fn costs(overrides: &[&str], infos: &Batch, envs: &[usize], threads: usize) -> (Vec<f32>, Vec<f32>) {
    let (per_env, all) = (SAMPLES * HORIZON * DIM, candidates());
    let actions: Vec<f32> = envs.iter().flat_map(|&env| all[env * per_env..][..per_env].to_vec()).collect();
    let mut model = DinoWmCost::new(&checkpoint(overrides));
    let (mut plain, mut costs) = (vec![f32::NAN; envs.len() * SAMPLES], vec![f32::NAN; envs.len() * SAMPLES]);
    let mut slopes = vec![f32::NAN; actions.len()];
    swm_core::pool::threads(threads).expect("creating the thread pool").install(|| {
        model.observe(infos, envs).expect("observing the environments");
        let candidates =
            Candidates { actions: &actions, envs: envs.len(), samples: SAMPLES, horizon: HORIZON, dim: DIM };
        model.cost(candidates, &mut plain).expect("computing the costs");
        let differentiable = model.differentiable().expect("a differentiable cost");
        differentiable.cost_and_gradient(candidates, &mut costs, &mut slopes).expect("computing the gradients");
    });
    for (cost, plain) in costs.iter().zip(&plain) {
        assert!((cost - plain).abs() < 1e-4 * plain.abs(), "{cost}, not {plain}");
    }
    (plain, slopes)
}

#[test]
fn costs_do_not_depend_on_other_environments_or_threads() {
    let history = ["history.length", "history.action", "history.pixels"];
    for (overrides, extra_columns) in
        [(IMAGES, &[][..]), (IMAGES, &history), (POSITIONS, &["position", "goal_position"])]
    {
        let infos = infos(extra_columns);
        let together = costs(&[overrides], &infos, &[0, 1, 2], 2);
        assert!(together.0.windows(2).any(|pair| pair[0] != pair[1]), "actions have no effect");
        assert_eq!(together, costs(&[overrides], &infos, &[0, 1, 2], 1));
        for env in 0..ENVS {
            let (alone, slopes) = costs(&[overrides], &infos, &[env], 2);
            assert_eq!(together.0[env * SAMPLES..][..SAMPLES], alone[..]);
            let per_env = SAMPLES * HORIZON * DIM;
            assert_eq!(together.1[env * per_env..][..per_env], slopes[..]);
        }
    }
}

#[test]
fn gradients_match_finite_differences() {
    let (infos, all) = (infos(&["position", "goal_position"]), candidates());
    let width = HORIZON * DIM;
    let mut model = DinoWmCost::new(&checkpoint(&[POSITIONS]));
    model.observe(&infos, &[1]).expect("observing the environments");
    let slopes = costs(&[POSITIONS], &infos, &[1], 1).1;
    let mut cost_at = |i: usize, by: f32| {
        let mut actions = all[SAMPLES * width..][..width].to_vec();
        actions[i] += by;
        let mut cost = [0.0];
        let one = Candidates { actions: &actions, envs: 1, samples: 1, horizon: HORIZON, dim: DIM };
        model.cost(one, &mut cost).expect("computing the cost");
        cost[0]
    };
    let largest = slopes[..width].iter().fold(0.0f32, |most, slope| slope.abs().max(most));
    for (i, slope) in slopes[..width].iter().enumerate() {
        let difference = (cost_at(i, 2e-2) - cost_at(i, -2e-2)) / 4e-2;
        assert!((difference - slope).abs() < 0.03 * largest, "element {i}: {slope}, not {difference}");
    }
}

#[test]
fn columns_of_float64_cost_as_their_float32_values() {
    let mut single = infos(&["position", "goal_position"]);
    let mut columns = single.schema().columns().to_vec();
    columns[2..].iter_mut().for_each(|column| column.dtype = DType::Float64);
    let mut double = Batch::zeros(&Schema::new(columns).expect("creating the schema"), ENVS);
    for env in 0..ENVS {
        single.row_mut(env).at::<f32>(2)[0] += 0.1;
        let (from, mut to) = (single.row(env), double.row_mut(env));
        (0..2).for_each(|image| to.set(image, from.at::<u8>(image)));
        for (column, name) in [(2, "position"), (3, "goal_position")] {
            to.set(column, &from.to_f64(name).expect("the values"));
        }
    }
    let [single, double] = [single, double].map(|infos| costs(&[POSITIONS], &infos, &[0, 1], 1));
    assert_eq!(single, double);
}

#[test]
fn history_and_column_goals_change_the_cost() {
    let history = ["history.length", "history.action", "history.pixels"];
    let (with, without) = (costs(&[IMAGES], &infos(&history), &[0, 1], 1), costs(&[IMAGES], &infos(&[]), &[0, 1], 1));
    // Environment 0 has a history of length 0, environment 1 of length 1.
    assert_eq!(with.0[..SAMPLES], without.0[..SAMPLES]);
    assert_ne!(with.0[SAMPLES..], without.0[SAMPLES..]);
    let (with, without) = (
        costs(&[POSITIONS], &infos(&["position", "goal_position"]), &[0], 1),
        costs(&[POSITIONS], &infos(&["position"]), &[0], 1),
    );
    assert!(
        with.0.iter().zip(&without.0).all(|(with, without)| with > without),
        "the cost includes the distance of the column"
    );
    let mut model = DinoWmCost::new(&checkpoint(&[POSITIONS]));
    let message = model.observe(&infos(&[]), &[0]).expect_err("infos without a position").to_string();
    assert!(message.contains("position"), "{message}");
}

#[test]
fn the_closest_frame_is_the_last_one_of_the_cheapest_shorter_plan() {
    // Predictions of random weights are far from every goal, the first ones least.
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let settings = [IMAGES, "schedule.steps=150", "optim.lr=3e-3", "model.predictor.dropout=0"];
    run(&config(&settings).expect("loading the configuration"), folder.path(), 2).expect("training the model");
    let trained = Checkpoint::<DinoWm>::load(folder.path(), &crate::device()).expect("loading the checkpoint");
    let all = candidates();
    let mut steps = std::collections::BTreeSet::new();
    for (checkpoint, extra) in [(&trained, &[][..]), (&checkpoint(&[POSITIONS]), &["position", "goal_position"])] {
        let infos = infos(extra);
        for env in 0..ENVS {
            let cost = |horizon: usize, closest: bool| {
                let of_env = all[env * SAMPLES * HORIZON * DIM..][..SAMPLES * HORIZON * DIM].chunks(HORIZON * DIM);
                let shorter: Vec<f32> = of_env.flat_map(|all| all[..horizon * DIM].to_vec()).collect();
                let mut model = DinoWmCost::new(checkpoint);
                assert!(!closest || model.compare_closest());
                model.observe(&infos, &[env]).expect("observing the environment");
                let candidates = Candidates { actions: &shorter, envs: 1, samples: SAMPLES, horizon, dim: DIM };
                let (mut costs, mut again) = (vec![f32::NAN; SAMPLES], vec![f32::NAN; SAMPLES]);
                let mut gradient = vec![f32::NAN; shorter.len()];
                model.cost(candidates, &mut costs).expect("computing the costs");
                let differentiable = model.differentiable().expect("a differentiable cost");
                differentiable.cost_and_gradient(candidates, &mut again, &mut gradient).expect("computing gradients");
                for (cost, again) in costs.iter().zip(&again) {
                    assert!((cost - again).abs() < 1e-4 * cost, "cost {cost}, with its gradient {again}");
                }
                (costs, gradient)
            };
            let (closest, gradient) = cost(HORIZON, true);
            let shorter: Vec<Vec<f32>> = (1..=HORIZON).map(|horizon| cost(horizon, false).0).collect();
            for sample in 0..SAMPLES {
                let of = |step: usize| shorter[step][sample];
                let step = (0..HORIZON).min_by(|&a, &b| of(a).total_cmp(&of(b))).expect("steps");
                assert!((closest[sample] - of(step)).abs() < 1e-5 * of(step), "{} of {shorter:?}", closest[sample]);
                let gradient = &gradient[sample * HORIZON * DIM..][..HORIZON * DIM];
                assert!(gradient[..DIM].iter().any(|&slope| slope != 0.0));
                assert!(gradient[(step + 1) * DIM..].iter().all(|&slope| slope == 0.0), "later actions have no effect");
                steps.insert(step);
            }
        }
    }
    assert!(steps.len() > 1, "all plans are closest after step {steps:?}");
}
