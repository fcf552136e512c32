//! The device of the tests computes what the CPU computes: the training step of every family, planning with every solver,
//! stored models and probes. `make test-gpu` names a device; without one, the CPU is compared with itself.

use crate::dots::Dots;
use crate::planning;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use swm_core::run::Control;
use swm_core::{Batch, Candidates, ColumnSpec, CostModel, DType, Key, Plan, PlanProblem, PlanSpace, Schema};
use swm_data::{Loader, LoaderConfig, Reader as _};
use swm_models::lewm::{EncoderConfig, Lewm, LewmCost};
use swm_models::nn::parameters::{self, HostTensor, Named};
use swm_models::nn::{BackboneConfig, ConvConfig, Init};
use swm_models::probe::{self, ReconstructionConfig, StateConfig};
use swm_models::train::{AdamW, ColumnInfo, DatasetInfo, StepContext};
use swm_models::{
    Checkpoint, Device, FAMILIES, StoredCheckpoint, TrainConfig, TrainOptions, Trainable, load_stored, train,
};
use swm_plan::{ActionKind, ActionScale, Need, SOLVERS, objective};

/// The largest difference between the device and the CPU, relative to the largest value of a tensor.
const TOLERANCE: f32 = 1e-4;

/// Checks that values differ by at most [`TOLERANCE`] of the largest expected value, or of `floor` if that is larger.
/// Returns the difference.
fn check(what: &str, actual: &[f32], expected: &[f32], floor: f32) -> f32 {
    assert_eq!(actual.len(), expected.len(), "{what}");
    let scale = expected.iter().fold(floor.max(f32::MIN_POSITIVE), |most, value| most.max(value.abs()));
    let error = actual.iter().zip(expected).fold(0.0f32, |most, (a, b)| most.max((a - b).abs())) / scale;
    assert!(error <= TOLERANCE, "{what} differs by {error:.1e}");
    error
}

/// The first batch of a run on the dots.
fn batch<M: Trainable>(config: &TrainConfig<M>) -> (DatasetInfo, Batch) {
    let reader = Arc::new(Dots::new(6, 0));
    let loader = M::loader_config(config, reader.schema()).expect("the clips of a batch");
    let goals = loader.goals.iter().flat_map(|goal| &goal.columns);
    let columns: Vec<String> = loader.clip.columns.iter().chain(goals).cloned().collect();
    let dataset_info = DatasetInfo::from_reader(&*reader, &columns, M::BOUNDED_ACTIONS).expect("dataset statistics");
    let loader = LoaderConfig { batch_size: config.data.batch_size, drop_last: true, ..loader };
    let loader = Loader::new(reader, loader).expect("creating the loader");
    let batch = loader.epoch(0, 0).next().expect("a batch").expect("reading the batch");
    (dataset_info, (*batch).clone())
}

/// A batch of transitions with states, rewards and ends of episodes, of which the dots have none.
fn transitions<M: Trainable>(config: &TrainConfig<M>) -> (DatasetInfo, Batch) {
    use rand::Rng as _;
    let steps = config.data.num_steps;
    let schema = Schema::new([
        ColumnSpec::new("state", DType::Float32, [steps, 3]),
        ColumnSpec::new("action", DType::Float32, [steps, 2]),
        ColumnSpec::new("reward", DType::Float32, [steps]),
        ColumnSpec::new("terminated", DType::Float32, [steps]),
    ]);
    let rows = config.data.batch_size;
    let mut batch = Batch::zeros(&schema.expect("creating the schema"), rows);
    let mut rng = Key::new(4).rng();
    for row in 0..rows {
        let mut row = batch.row_mut(row);
        for column in 0..3 {
            for value in row.at::<f32>(column) {
                *value = rng.random_range(-1.0..1.0);
            }
        }
    }
    let unit = |value: f64| vec![value; 3];
    let state = ColumnInfo { shape: vec![3], mean: unit(0.0), std: unit(1.0), min: unit(-1.0), max: unit(1.0) };
    let columns = BTreeMap::from([("state".to_owned(), state)]);
    (DatasetInfo { action: ActionScale::identity(2), columns, env: None }, batch)
}

/// What a training step computes, on the host.
struct Step {
    metrics: Vec<(&'static str, f64)>,
    gradients: Named<HostTensor>,
    weights: Named<HostTensor>,
}

/// Makes a training step on a device, from weights without zeros, so that every part of the model has an effect. The
/// optimizer gets `gradients` if they are given, because its first step depends on the signs of vanishing gradients.
fn step<M: Trainable>(
    config: &TrainConfig<M>,
    (dataset_info, batch): &(DatasetInfo, Batch),
    device: &Device,
    gradients: Option<&Named<HostTensor>>,
) -> Step {
    let model = M::new(config, dataset_info, &Init::new(Key::new(config.seed), device)).expect("creating the model");
    let mut values = parameters::values(&model);
    for tensor in values.values_mut().filter(|tensor| tensor.values.iter().all(|value| *value == 0.0)) {
        for (i, value) in tensor.values.iter_mut().enumerate() {
            *value = ((i * 37 % 101) as f32 / 101.0 - 0.5) * 0.2;
        }
    }
    let model = parameters::load(model, &values);
    let context = StepContext { config, dataset_info, key: Key::new(1), device, training: true };
    let output = model.step(&context, batch).expect("computing the losses");
    let on_host = |tensor: &burn::tensor::Tensor<1>| HostTensor {
        shape: tensor.dims().to_vec(),
        values: tensor.to_data().iter::<f32>().collect(),
    };
    let own: Named<HostTensor> = output.gradients.iter().map(|(name, value)| (name.clone(), on_host(value))).collect();
    let tensor = |host: &HostTensor| burn::tensor::Tensor::<1>::from_floats(host.values.as_slice(), device);
    let given = gradients.unwrap_or(&own).iter().map(|(name, value)| (name.clone(), tensor(value))).collect();
    let (model, _) = AdamW::new(config.optim.clone()).step(model, 1.0, given, M::parameter_group);
    let model = model.after_step(&context, output.buffers);
    Step { metrics: output.metrics, gradients: own, weights: parameters::values(&model) }
}

/// Compares a training step on the device of the tests with the CPU's: losses, gradients, and weights after the step.
fn compare<M: Trainable>(config: &TrainConfig<M>, inputs: &(DatasetInfo, Batch)) {
    let expected = step(config, inputs, &Device::flex(), None);
    let found = step(config, inputs, &crate::device(), Some(&expected.gradients));
    let family = M::FAMILY;
    // A term may be a mean that cancels, such as that of cosines: it is compared with a tenth of the loss, the first metric.
    let floor = expected.metrics.first().map_or(0.0, |(_, loss)| loss.abs() as f32 / 10.0).max(1e-3);
    for ((name, found), (_, expected)) in found.metrics.iter().zip(&expected.metrics) {
        assert!(expected.is_finite(), "{family}: {name} is {expected}");
        check(&format!("{family}: {name}"), &[*found as f32], &[*expected as f32], floor);
    }
    assert_eq!(found.gradients.keys().collect::<Vec<_>>(), expected.gradients.keys().collect::<Vec<_>>(), "{family}");
    // The gradients of parameters without effect, such as the bias of keys, are zero up to rounding. Those of a bias before a batch
    // normalisation are sums over the batch that cancel, and are compared with the gradients of the same layer's weights.
    let largest = expected.gradients.values().flat_map(|g| &g.values).fold(0.0f32, |most, v| most.max(v.abs()));
    let gradients = &expected.gradients;
    let compare = |what: &str, found: &Named<HostTensor>, expected: &Named<HostTensor>, floor: f32| {
        let errors = expected.iter().map(|(name, expected)| {
            let layer = name.strip_suffix(".bias").and_then(|layer| gradients.get(&format!("{layer}.weight")));
            let of_layer = layer.iter().flat_map(|weight| &weight.values).fold(0.0f32, |most, v| most.max(v.abs()));
            let floor = if what == "gradient" { floor.max(of_layer) } else { floor };
            let label = format!("{family}: {what} of {name}");
            (check(&label, &found[name].values, &expected.values, floor), name)
        });
        let worst = errors.max_by(|a, b| a.0.total_cmp(&b.0)).expect("a tensor");
        println!("{family}: worst {what}: {:.1e} ({})", worst.0, worst.1);
    };
    compare("gradient", &found.gradients, &expected.gradients, 1e-3 * largest);
    compare("weight", &found.weights, &expected.weights, 0.0);
}

/// An encoder of overlapping convolutions, for which the CPU has kernels of its own.
fn conv() -> ConvConfig {
    ConvConfig { channels: vec![6, 9], hidden: 0, dim: 10 }
}

#[test]
fn a_training_step_of_lewm_equals_that_of_the_cpu() {
    let mut config = crate::training::config(&["loss.temp_straight=0.1"]);
    compare(&config, &batch(&config));
    config.model.encoder = EncoderConfig::Conv(conv());
    compare(&config, &batch(&config));
    // The features of an untrained vision transformer hardly differ, so that their normalisation enlarges the rounding: its
    // gradients are compared with the recorded ones.
    let config = crate::training::keypoints_config();
    compare(&config, &batch(&config));
}

#[test]
fn a_training_step_of_pldm_equals_that_of_the_cpu() {
    let config = crate::pldm::config(&["loss.idm=1"]).expect("loading the configuration");
    compare(&config, &batch(&config));
}

#[test]
fn a_training_step_of_dino_wm_equals_that_of_the_cpu() {
    for settings in [&[crate::dino_wm::POSITIONS, "model.decoder=16"][..], &[crate::dino_wm::IMAGES]] {
        let config = crate::dino_wm::config(settings).expect("loading the configuration");
        compare(&config, &batch(&config));
    }
}

#[test]
fn a_training_step_of_goal_conditioned_models_equals_that_of_the_cpu() {
    use swm_models::gcrl::{Gcbc, Gciql, Gcivl, GcrlConfig, GoalConditioned};
    fn both<M: GoalConditioned<Config = GcrlConfig>>() {
        let mut config = crate::gcrl::config::<M>(&["model.head.dropout=0.1"]);
        compare(&config, &batch(&config));
        config.model.encoder = BackboneConfig::Conv(conv());
        compare(&config, &batch(&config));
    }
    both::<Gcbc>();
    both::<Gcivl>();
    both::<Gciql>();
}

#[test]
fn a_training_step_of_reinforcement_learning_equals_that_of_the_cpu() {
    let config = crate::online::config::<swm_models::sac::Sac>(&[]);
    compare(&config, &transitions(&config));
    let config = crate::online::config::<swm_models::tdmpc2::Tdmpc2>(&[]);
    compare(&config, &transitions(&config));
}

/// Plans for some environments with the model of the planning tests.
fn plan(solver: &str, device: &Device, envs: &[usize]) -> Plan {
    let entry = SOLVERS.get(solver).expect("a solver");
    let mut settings = (entry.defaults)();
    for (name, value) in [("samples", 16), ("iterations", 3), ("elites", 6), ("outer_iterations", 2)] {
        if settings.get(name).is_some() {
            settings[name] = value.into();
        }
    }
    let mut solver = (entry.make)(&settings).expect("creating the solver");
    let mut cost: Box<dyn CostModel> = Box::new(LewmCost::new(&planning::checkpoint(device)));
    if entry.needs.contains(&Need::Constraints) {
        let limit = serde_json::json!({ "constraints": [{ "constraint": "action_norm", "limit": 0.9 }] });
        let limit: objective::ObjectiveConfig = serde_json::from_value(limit).expect("a constraint");
        cost = limit.apply(cost).expect("constraining the model");
    }
    cost.observe(&planning::infos(true), envs).expect("observing the environments");
    let keys: Vec<Key> = envs.iter().map(|&env| Key::new(5).at(env as u64)).collect();
    let (low, high) = (vec![-1.0; planning::DIM], vec![1.0; planning::DIM]);
    let space = match entry.actions {
        ActionKind::Continuous => PlanSpace::Continuous { low: &low, high: &high },
        ActionKind::Discrete => PlanSpace::Discrete { choices: &[2, 2] },
    };
    let horizon = planning::HORIZON;
    let problem = PlanProblem { horizon, space, keys: &keys, init: None, deadline: None, observer: None };
    swm_core::pool::threads(2)
        .expect("creating the thread pool")
        .install(|| solver.solve(&mut *cost, problem))
        .expect("planning")
}

#[test]
fn plans_of_every_solver_equal_those_of_the_cpu_and_do_not_depend_on_other_environments() {
    let elements = planning::HORIZON * planning::DIM;
    assert_eq!(SOLVERS.rows.len(), 9);
    for entry in SOLVERS.rows {
        let id = entry.id;
        let (expected, found) = (plan(id, &Device::flex(), &[0, 1, 2]), plan(id, &crate::device(), &[0, 1, 2]));
        let costs = check(&format!("{id}: costs"), &found.costs, &expected.costs, 0.0);
        let actions = found.actions.iter().zip(&expected.actions).fold(0.0f32, |most, (a, b)| most.max((a - b).abs()));
        println!("{id}: costs differ by {costs:.1e}, actions by {actions:.1e}");
        // Steps of gradient solvers are normalised by the size of the gradient, which magnifies rounding.
        assert!(actions <= 10.0 * TOLERANCE, "{id}: actions differ by {actions:.1e}");
        for env in [0, 2] {
            let alone = plan(id, &crate::device(), &[env]);
            assert_eq!(alone.actions, found.actions[env * elements..][..elements], "{id}: environment {env} alone");
            assert_eq!(alone.costs, found.costs[env..=env], "{id}: environment {env} alone");
        }
        assert_eq!(plan(id, &crate::device(), &[0, 1, 2]).actions, found.actions, "{id}: planned again");
    }
}

#[test]
fn costs_and_latents_equal_those_of_the_cpu() {
    let candidates = planning::candidates();
    let costs = |device: &Device| {
        let mut cost = LewmCost::new(&planning::checkpoint(device));
        cost.observe(&planning::infos(true), &[0, 1, 2]).expect("observing the environments");
        let mut costs = vec![0.0; 3 * planning::SAMPLES];
        let (samples, horizon, dim) = (planning::SAMPLES, planning::HORIZON, planning::DIM);
        let candidates = Candidates { actions: &candidates, envs: 3, samples, horizon, dim };
        cost.cost(candidates, &mut costs).expect("computing the costs");
        costs
    };
    let error = check("costs", &costs(&crate::device()), &costs(&Device::flex()), 0.0);
    println!("costs: {error:.1e}");
}

/// Trains a small LeWM on the device of the tests.
fn trained(out: &Path) -> Checkpoint<Lewm> {
    let config = crate::training::config(&["schedule.steps=3"]);
    let options = TrainOptions { device: crate::device(), ..TrainOptions::default() };
    train(&config, Arc::new(Dots::new(6, 0)), out, &options, &mut Control::new()).expect("training the model");
    Checkpoint::load(out, &crate::device()).expect("loading the checkpoint")
}

#[test]
fn models_are_stored_with_the_same_bytes_from_every_device() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let (out, again) = (folder.path().join("run"), folder.path().join("again"));
    let mut on_device = trained(&out);
    let mut on_cpu = Checkpoint::<Lewm>::load(&out, &Device::flex()).expect("loading the checkpoint");
    assert_eq!(parameters::values(&on_device.model), parameters::values(&on_cpu.model));
    assert_eq!(on_device.manifest.device, swm_models::device::name(&crate::device()));
    let hashes = [on_device.save_to(&again).expect("saving"), on_cpu.save_to(&again).expect("saving")];
    assert_eq!(hashes[0], hashes[1]);
    assert_eq!(hashes[0], on_device.hash());
}

#[test]
fn probes_and_predictors_read_the_same_latents_on_every_device() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let out = folder.path().join("run");
    drop(trained(&out));
    let stored = StoredCheckpoint::read(&out).expect("reading the checkpoint");
    let reader = Dots::new(20, 0);
    let read = |device: &Device| {
        let loaded = load_stored(FAMILIES.rows, &stored, device).expect("loading the model");
        let encoder = loaded.encoder().expect("a LeWM encodes images");
        let mut images = vec![0; 3 * 16 * 16 * 3];
        images.iter_mut().enumerate().for_each(|(i, byte)| *byte = (i * 37 % 251) as u8);
        let mut latents = encoder.encode(&images).expect("encoding images");
        let mut predictor = loaded.predictor().expect("a LeWM predicts latents");
        let columns = Schema::new([ColumnSpec::image("pixels", 16, 16)]).expect("creating the schema");
        let mut rows = Batch::zeros(&columns, 1);
        rows.row_mut(0).at::<u8>(0).copy_from_slice(&images[..16 * 16 * 3]);
        let mut start = vec![0.0; predictor.latent_dim()];
        predictor.encode(&rows, &mut start).expect("encoding a row");
        let mut predicted = vec![0.0; 2 * start.len()];
        predictor.rollout(&start, &[0.3, -0.2, 0.1, 0.5, -0.4, 0.2, 0.0, 0.7], 2, &mut predicted).expect("predicting");
        latents.extend(start.into_iter().chain(predicted));
        let mut config = StateConfig { frames: 200, ..StateConfig::new(vec!["position".to_owned()]) };
        config.fit.steps = 20;
        let report = probe::read_state(&*encoder, &reader, &config, &mut Control::new()).expect("fitting the probe");
        let mut config = ReconstructionConfig { frames: 100, ..ReconstructionConfig::default() };
        config.fit.steps = 5;
        let decoded = probe::reconstruct_images(&*encoder, &reader, &config, &mut Control::new());
        let images = decoded.expect("fitting the decoder").report;
        (latents, report.linear.iter().map(|score| score.rmse as f32).collect::<Vec<_>>(), images.rmse as f32)
    };
    let (found, expected) = (read(&crate::device()), read(&Device::flex()));
    let error = check("latents", &found.0, &expected.0, 0.0);
    println!("latents: {error:.1e}; probes: {:?} and {:?}", found.1, expected.1);
    for (found, expected) in found.1.iter().zip(&expected.1).chain([(&found.2, &expected.2)]) {
        assert!((found - expected).abs() < 1e-2 * expected, "an error of {found}, on the CPU {expected}");
    }
}
