//! The planning cost of an environment depends on that environment alone.

use crate::dots::{SIDE, draw};
use crate::training::config;
use burn::tensor::Device;
use swm_core::{Batch, Candidates, ColumnSpec, CostModel, DType, Key, Manifest, Schema};
use swm_models::Checkpoint;
use swm_models::lewm::{Lewm, LewmCost};
use swm_plan::ActionScale;

const ENVS: usize = 3;
const SAMPLES: usize = 37;
const HORIZON: usize = 4;
const DIM: usize = 4;

fn checkpoint() -> Checkpoint {
    let config = config(&[]);
    let model = Lewm::new(&config.model, DIM, Key::new(3), &Device::flex());
    // Modulations are zero before training; without them actions have no effect.
    let mut values = swm_models::nn::parameters::values(&model);
    for (name, tensor) in &mut values {
        if name.contains("adaLN") {
            for (i, value) in tensor.values.iter_mut().enumerate() {
                *value = ((i * 37 % 101) as f32 / 101.0 - 0.5) * 0.4;
            }
        }
    }
    let model = swm_models::nn::parameters::load(model, &values);
    let action = ActionScale::identity(2);
    let manifest = Manifest::new("train", 0, serde_json::Value::Null);
    Checkpoint { model, config, action, env: None, manifest }
}

fn infos(history: bool) -> Batch {
    let mut columns = vec![ColumnSpec::image("pixels", SIDE, SIDE), ColumnSpec::image("goal", SIDE, SIDE)];
    if history {
        columns.push(ColumnSpec::new("history.length", DType::Int32, []));
        columns.push(ColumnSpec::new("history.action", DType::Float32, [1, DIM]));
        columns.push(ColumnSpec::new("history.pixels", DType::U8, [1, SIDE, SIDE, 3]));
    }
    let mut infos = Batch::zeros(&Schema::new(columns).expect("columns"), ENVS);
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

fn candidates() -> Vec<f32> {
    use rand::Rng as _;
    let mut rng = Key::new(9).rng();
    (0..ENVS * SAMPLES * HORIZON * DIM).map(|_| rng.random_range(-1.0..1.0f32)).collect()
}

fn costs(infos: &Batch, envs: &[usize], threads: usize) -> Vec<f32> {
    let per_env = SAMPLES * HORIZON * DIM;
    let all = candidates();
    let actions: Vec<f32> = envs.iter().flat_map(|&env| all[env * per_env..][..per_env].to_vec()).collect();
    let mut cost = LewmCost::new(&checkpoint());
    let mut costs = vec![f32::NAN; envs.len() * SAMPLES];
    swm_core::pool::threads(threads).expect("threads").install(|| {
        cost.observe(infos, envs).expect("observed");
        let candidates =
            Candidates { actions: &actions, envs: envs.len(), samples: SAMPLES, horizon: HORIZON, dim: DIM };
        cost.cost(candidates, &mut costs).expect("costs");
    });
    costs
}

#[test]
fn neighbours_and_threads_do_not_change_a_cost() {
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
fn the_past_matters_where_there_is_one() {
    let (with, without) = (costs(&infos(true), &[0, 1], 1), costs(&infos(false), &[0, 1], 1));
    // Environment 0 has a past of length 0, environment 1 of length 1.
    assert_eq!(with[..SAMPLES], without[..SAMPLES]);
    assert_ne!(with[SAMPLES..], without[SAMPLES..]);
}

#[test]
fn what_does_not_fit_is_refused() {
    let mut cost = LewmCost::new(&checkpoint());
    cost.observe(&infos(false), &[0]).expect("observed");
    let actions = vec![0.0; 6];
    let wrong = Candidates { actions: &actions, envs: 1, samples: 1, horizon: 2, dim: 3 };
    let message = cost.cost(wrong, &mut [0.0]).expect_err("three numbers").to_string();
    assert!(message.contains("4 numbers a model step"), "{message}");
    let schema = Schema::new([ColumnSpec::image("pixels", SIDE, SIDE)]).expect("a column");
    let message = cost.observe(&Batch::zeros(&schema, 1), &[0]).expect_err("no goal").to_string();
    assert!(message.contains("'goal'"), "{message}");
    let large = Schema::new([ColumnSpec::image("pixels", 2 * SIDE, 2 * SIDE), ColumnSpec::image("goal", SIDE, SIDE)])
        .expect("columns");
    let message = cost.observe(&Batch::zeros(&large, 1), &[0]).expect_err("32 pixels").to_string();
    assert!(message.contains("[16, 16, 3]"), "{message}");
}
