//! Planning costs and gradients of LeWM do not depend on other environments or threads.

use crate::dots::{SIDE, draw};
use crate::training::config;
use swm_core::{Batch, Candidates, ColumnSpec, CostModel, DType, Key, Manifest, Schema};
use swm_models::lewm::{Lewm, LewmCost};
use swm_models::train::DatasetInfo;
use swm_models::{Checkpoint, Device};
use swm_plan::ActionScale;

const ENVS: usize = 3;
pub const SAMPLES: usize = 37;
pub const HORIZON: usize = 4;
pub const DIM: usize = 4;

pub fn checkpoint(device: &Device) -> Checkpoint<Lewm> {
    let config = config(&[]);
    let model = Lewm::init(&config.model, DIM, &swm_models::nn::Init::new(Key::new(3), device));
    // Modulations are zero-initialised, so actions have no effect before training.
    let mut values = swm_models::nn::parameters::values(&model);
    for (name, tensor) in &mut values {
        if name.contains("adaLN") {
            for (i, value) in tensor.values.iter_mut().enumerate() {
                *value = ((i * 37 % 101) as f32 / 101.0 - 0.5) * 0.4;
            }
        }
    }
    let model = swm_models::nn::parameters::load(model, &values);
    let dataset_info = DatasetInfo { action: ActionScale::identity(2), columns: Default::default(), env: None };
    let manifest = Manifest::new("train", 0, serde_json::Value::Null);
    Checkpoint { model, config, dataset_info, manifest }
}

pub fn infos(history: bool) -> Batch {
    let mut columns = vec![ColumnSpec::image("pixels", SIDE, SIDE), ColumnSpec::image("goal", SIDE, SIDE)];
    if history {
        columns.push(ColumnSpec::new("history.length", DType::Int32, []));
        columns.push(ColumnSpec::new("history.action", DType::Float32, [1, DIM]));
        columns.push(ColumnSpec::new("history.pixels", DType::U8, [1, SIDE, SIDE, 3]));
    }
    let mut infos = Batch::zeros(&Schema::new(columns).expect("creating the schema"), ENVS);
    for env in 0..ENVS {
        let mut row = infos.row_mut(env);
        draw([3.0 + env as f32, 5.0], row.at::<u8>(0));
        draw([10.0, 3.0 + 2.0 * env as f32], row.at::<u8>(1));
        if history {
            row.set(2, &[env as i32 % 2]);
            row.set(3, &[0.5, -0.5, env as f32, 0.25]);
            draw([2.0 + env as f32, 5.0], row.at::<u8>(4));
        }
    }
    infos
}

pub fn candidates() -> Vec<f32> {
    use rand::Rng as _;
    let mut rng = Key::new(9).rng();
    (0..ENVS * SAMPLES * HORIZON * DIM).map(|_| rng.random_range(-1.0..1.0f32)).collect()
}

fn costs(infos: &Batch, envs: &[usize], threads: usize) -> Vec<f32> {
    let per_env = SAMPLES * HORIZON * DIM;
    let all = candidates();
    let actions: Vec<f32> = envs.iter().flat_map(|&env| all[env * per_env..][..per_env].to_vec()).collect();
    let mut cost = LewmCost::new(&checkpoint(&crate::device()));
    let mut costs = vec![f32::NAN; envs.len() * SAMPLES];
    swm_core::pool::threads(threads).expect("creating the thread pool").install(|| {
        cost.observe(infos, envs).expect("observing the environments");
        let candidates =
            Candidates { actions: &actions, envs: envs.len(), samples: SAMPLES, horizon: HORIZON, dim: DIM };
        cost.cost(candidates, &mut costs).expect("computing the costs");
    });
    costs
}

#[test]
fn costs_do_not_depend_on_other_environments_or_threads() {
    for history in [false, true] {
        let infos = infos(history);
        let together = costs(&infos, &[0, 1, 2], 2);
        assert!(together.iter().all(|cost| cost.is_finite()));
        assert!(together.windows(2).any(|pair| pair[0] != pair[1]), "actions have no effect");
        assert_eq!(together, costs(&infos, &[0, 1, 2], 1));
        for env in 0..ENVS {
            assert_eq!(together[env * SAMPLES..][..SAMPLES], costs(&infos, &[env], 2)[..]);
        }
    }
}

#[test]
fn history_changes_the_cost() {
    let (with, without) = (costs(&infos(true), &[0, 1], 1), costs(&infos(false), &[0, 1], 1));
    // Environment 0 has a history of length 0, environment 1 of length 1.
    assert_eq!(with[..SAMPLES], without[..SAMPLES]);
    assert_ne!(with[SAMPLES..], without[SAMPLES..]);
}

#[test]
fn invalid_candidates_and_observations_are_refused() {
    let mut cost = LewmCost::new(&checkpoint(&crate::device()));
    cost.observe(&infos(false), &[0]).expect("observing the environments");
    let actions = vec![0.0; 6];
    let wrong = Candidates { actions: &actions, envs: 1, samples: 1, horizon: 2, dim: 3 };
    let message = cost.cost(wrong, &mut [0.0]).expect_err("actions of dimension 3").to_string();
    assert!(message.contains("4 action elements a model step"), "{message}");
    let schema = Schema::new([ColumnSpec::image("pixels", SIDE, SIDE)]).expect("creating the schema");
    let message = cost.observe(&Batch::zeros(&schema, 1), &[0]).expect_err("infos without a goal").to_string();
    assert!(message.contains("'goal'"), "{message}");
    let large = Schema::new([ColumnSpec::image("pixels", 2 * SIDE, 2 * SIDE), ColumnSpec::image("goal", SIDE, SIDE)])
        .expect("creating the schema");
    let message = cost.observe(&Batch::zeros(&large, 1), &[0]).expect_err("images of 32 pixels").to_string();
    assert!(message.contains("[16, 16, 3]"), "{message}");
}

/// Returns a cost that has observed environments 0 and 1 with their histories.
fn observed() -> LewmCost {
    let mut cost = LewmCost::new(&checkpoint(&crate::device()));
    cost.observe(&infos(true), &[0, 1]).expect("observing the environments");
    cost
}

#[test]
fn gradients_match_finite_differences() {
    let (samples, width) = (5, HORIZON * DIM);
    let actions = &candidates()[..2 * samples * width];
    fn candidates_of(actions: &[f32]) -> Candidates<'_> {
        Candidates { actions, envs: 2, samples: 5, horizon: HORIZON, dim: DIM }
    }
    let mut model = observed();
    let (mut costs, mut slopes) = (vec![0.0; 2 * samples], vec![0.0; actions.len()]);
    let differentiable = model.differentiable().expect("a LeWM has a gradient");
    differentiable.cost_and_gradient(candidates_of(actions), &mut costs, &mut slopes).expect("computing the gradients");
    let mut plain = vec![0.0; 2 * samples];
    model.cost(candidates_of(actions), &mut plain).expect("computing the costs");
    for (cost, plain) in costs.iter().zip(&plain) {
        assert!((cost - plain).abs() < 1e-4 * plain.abs(), "{cost}, not {plain}");
    }
    // Central differences for some elements of some candidates.
    let mut moved = |i: usize, by: f32| {
        let mut actions = actions.to_vec();
        actions[i] += by;
        model.cost(candidates_of(&actions), &mut plain).expect("computing the costs");
        f64::from(plain[i / width])
    };
    let largest = slopes.iter().fold(0.0, |most, slope| slope.abs().max(most));
    assert!(largest > 1e-4, "gradients are almost zero: {largest}");
    for i in (0..slopes.len()).step_by(7) {
        let (step, slope) = (2e-2, f64::from(slopes[i]));
        let difference = (moved(i, step) - moved(i, -step)) / (2.0 * f64::from(step));
        assert!((difference - slope).abs() < 0.02 * f64::from(largest), "element {i}: {slope}, not {difference}");
    }
}

#[test]
fn gradients_do_not_depend_on_other_environments_or_threads() {
    let (samples, width) = (SAMPLES, HORIZON * DIM);
    let all = candidates();
    let run = |envs: &[usize], threads: usize| {
        let actions: Vec<f32> =
            envs.iter().flat_map(|&env| all[env * samples * width..][..samples * width].to_vec()).collect();
        let mut model = LewmCost::new(&checkpoint(&crate::device()));
        let (mut costs, mut slopes) = (vec![0.0; envs.len() * samples], vec![0.0; actions.len()]);
        swm_core::pool::threads(threads).expect("creating the thread pool").install(|| {
            model.observe(&infos(true), envs).expect("observing the environments");
            let candidates = Candidates { actions: &actions, envs: envs.len(), samples, horizon: HORIZON, dim: DIM };
            let model = model.differentiable().expect("a LeWM has a gradient");
            model.cost_and_gradient(candidates, &mut costs, &mut slopes).expect("computing the gradients");
        });
        slopes
    };
    let together = run(&[0, 1, 2], 2);
    assert_eq!(together, run(&[0, 1, 2], 1));
    assert_eq!(together[samples * width..2 * samples * width], run(&[1], 2)[..]);
}

#[test]
fn vector_jacobian_products_match_finite_differences() {
    let mut model = observed();
    let latent = model.latent().expect("a LeWM has latents");
    let width = latent.latent_dim();
    let (mut start, mut goal) = (vec![0.0; 2 * width], vec![0.0; 2 * width]);
    latent.encode(&mut start, &mut goal).expect("encoding the latents");
    assert_ne!(start, goal);
    let actions = candidates()[..2 * DIM].to_vec();
    let mut next = vec![0.0; 2 * width];
    latent.predict(&start, &actions, &mut next).expect("predicting the next latent");
    // The vector-Jacobian products with the vector `pull` are the gradients of the scalar `next · pull`.
    let pull: Vec<f32> = (0..2 * width).map(|i| ((i * 29 % 17) as f32 - 8.0) / 8.0).collect();
    let (mut by_latent, mut by_action) = (vec![0.0; 2 * width], vec![0.0; 2 * DIM]);
    latent
        .predict_vjp(&start, &actions, &pull, &mut by_latent, &mut by_action)
        .expect("computing the vector-Jacobian products");
    let mut value = |start: &[f32], actions: &[f32]| {
        latent.predict(start, actions, &mut next).expect("predicting the next latent");
        next.iter().zip(&pull).map(|(a, b)| f64::from(a * b)).sum::<f64>()
    };
    let step = 2e-2f32;
    for (values, slopes, is_action) in [(&start, &by_latent, false), (&actions, &by_action, true)] {
        for i in (0..values.len()).step_by(3) {
            let mut at = |by: f32| {
                let mut moved = values.clone();
                moved[i] += by;
                if is_action { value(&start, &moved) } else { value(&moved, &actions) }
            };
            let difference = (at(step) - at(-step)) / f64::from(2.0 * step);
            let slope = f64::from(slopes[i]);
            let largest = slopes.iter().fold(0.0, |most, slope| slope.abs().max(most));
            assert!((difference - slope).abs() < 0.02 * f64::from(largest), "{i}: {slope}, not {difference}");
        }
    }
    let message =
        latent.predict(&start, &actions[..DIM], &mut goal).expect_err("one action for two latents").to_string();
    assert!(message.contains("actions"), "{message}");
}
