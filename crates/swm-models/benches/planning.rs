//! One CEM iteration of a LeWM of the published size (300 candidates of 5 model steps, one environment): the
//! rollout that plans with, beside the model's own on the same threads. Prints milliseconds and the ratio.
#![allow(clippy::print_stdout)]

use burn::tensor::{Device, Tensor, TensorData};
use rayon::prelude::*;
use std::time::Instant;
use swm_core::Key;
use swm_models::TrainConfig;
use swm_models::lewm::{Lewm, Rollout};

const SAMPLES: usize = 300;
const HORIZON: usize = 5;
const NUMBERS: usize = 10;
const ROUNDS: usize = 5;

fn milliseconds(work: impl FnOnce()) -> f64 {
    let begun = Instant::now();
    work();
    begun.elapsed().as_secs_f64() * 1e3
}

fn median(mut times: Vec<f64>) -> f64 {
    times.sort_by(f64::total_cmp);
    times[times.len() / 2]
}

fn main() {
    let config = TrainConfig::<Lewm>::load("paper", &[]).expect("a preset");
    let latent = config.model.latent;
    let model = Lewm::init(&config.model, NUMBERS, Key::new(0), &Device::flex());
    let rollout = Rollout::new(&model);
    let start = vec![0.1; latent];
    let actions: Vec<f32> = (0..SAMPLES * HORIZON * NUMBERS).map(|i| (i * 37 % 101) as f32 / 101.0 - 0.5).collect();
    let chunks = || actions.par_chunks(Rollout::part(SAMPLES) * HORIZON * NUMBERS);
    let (mut fast, mut plain) = (vec![], vec![]);
    for _ in 0..ROUNDS {
        fast.push(milliseconds(|| {
            chunks().for_each(|chunk| {
                let samples = chunk.len() / (HORIZON * NUMBERS);
                assert_eq!(rollout.run(&start, chunk, samples, HORIZON).len(), HORIZON + 1);
            });
        }));
        plain.push(milliseconds(|| {
            chunks().for_each(|chunk| {
                let samples = chunk.len() / (HORIZON * NUMBERS);
                let tensor = |values: Vec<f32>, shape: [usize; 3]| {
                    Tensor::<3>::from_data(TensorData::new(values, shape), &Device::flex())
                };
                let actions = tensor(chunk.to_vec(), [samples, HORIZON, NUMBERS]);
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
