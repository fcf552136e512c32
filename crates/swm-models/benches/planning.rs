//! Times one iteration of the cross-entropy method (CEM) in a LeWM of the published size: 300 candidates of 5 model
//! steps, one environment. Compares the CPU rollout that planning uses ([`Rollout`]) with `Lewm::rollout` on the same
//! threads. Prints milliseconds and the ratio.
#![allow(clippy::print_stdout, reason = "a benchmark prints its result")]

use burn::tensor::{Device, Tensor, TensorData};
use rayon::prelude::*;
use std::time::Instant;
use swm_core::Key;
use swm_models::TrainConfig;
use swm_models::lewm::{Lewm, Rollout};
use swm_models::nn::Init;

const SAMPLES: usize = 300;
const HORIZON: usize = 5;
const ACTION_DIM: usize = 10;
const ROUNDS: usize = 5;

fn milliseconds(work: impl FnOnce()) -> f64 {
    let start = Instant::now();
    work();
    start.elapsed().as_secs_f64() * 1e3
}

fn median(mut times: Vec<f64>) -> f64 {
    times.sort_by(f64::total_cmp);
    times[times.len() / 2]
}

fn main() {
    let config = TrainConfig::<Lewm>::load("paper", &[]).expect("loading the preset");
    let latent = config.model.latent;
    let model = Lewm::init(&config.model, ACTION_DIM, &Init::new(Key::new(0), &Device::flex()));
    let rollout = Rollout::new(&model);
    let start = vec![0.1; latent];
    let actions: Vec<f32> = (0..SAMPLES * HORIZON * ACTION_DIM).map(|i| (i * 37 % 101) as f32 / 101.0 - 0.5).collect();
    let chunks = || actions.par_chunks(Rollout::chunk_size(SAMPLES) * HORIZON * ACTION_DIM);
    let (mut fast, mut plain) = (vec![], vec![]);
    for _ in 0..ROUNDS {
        fast.push(milliseconds(|| {
            chunks().for_each(|chunk| {
                let samples = chunk.len() / (HORIZON * ACTION_DIM);
                assert_eq!(rollout.run(&start, chunk, samples, HORIZON).len(), HORIZON + 1);
            });
        }));
        plain.push(milliseconds(|| {
            chunks().for_each(|chunk| {
                let samples = chunk.len() / (HORIZON * ACTION_DIM);
                let tensor = |values: Vec<f32>, shape: [usize; 3]| {
                    Tensor::<3>::from_data(TensorData::new(values, shape), &Device::flex())
                };
                let actions = tensor(chunk.to_vec(), [samples, HORIZON, ACTION_DIM]);
                let latents = model.rollout(tensor(start.repeat(samples), [samples, 1, latent]), actions);
                assert_eq!(latents.dims(), [samples, HORIZON + 1, latent]);
            });
        }));
    }
    let ratios: Vec<f64> = plain.iter().zip(&fast).map(|(plain, fast)| plain / fast).collect();
    println!("one CEM iteration, {SAMPLES} candidates x {HORIZON} steps, paper size:");
    println!(
        "  planning rollout {:.0} ms, model rollout {:.0} ms: {:.2} x",
        median(fast),
        median(plain),
        median(ratios)
    );
}
