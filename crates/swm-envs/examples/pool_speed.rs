//! Speed of pools of several threads compared with pools of one thread, measured in turns:
//! `cargo run --release -p swm-envs --example pool_speed [-- THREADS [PAIRS]]`.
#![allow(clippy::print_stdout, reason = "a command-line program")]

use std::time::{Duration, Instant};
use swm_core::policy::{Policy, RandomPolicy};
use swm_core::pool::{EnvPool, Reset, threads};
use swm_core::{Batch, ColumnIndices, Env, Key, ResetOptions, Result, Schema};
use swm_envs::ENVS;

/// The environments of a pool.
const SLOTS: usize = 8;
/// The steps of an episode.
const EPISODE: usize = 50;
/// The time of one measurement.
const TURN: Duration = Duration::from_millis(400);

const CASES: [(&str, Option<usize>); 7] = [
    ("swm/TwoRoom-v1", None),
    ("swm/CartPoleControl-v1", None),
    ("swm/PushT-v1", None),
    ("swm/TwoRoom-v1", Some(64)),
    ("swm/PushT-v1", Some(64)),
    ("swm/PushT-v1", Some(224)),
    ("swm/TwoRoom-v1", Some(224)),
];

/// A pool with precomputed random actions.
struct Side {
    pool: EnvPool,
    actions: Vec<Batch>,
    ended: [usize; 2],
    episodes: u64,
}

impl Side {
    fn new(id: &str, side: Option<usize>, workers: usize) -> Result<Self> {
        let entry = ENVS.get(id)?;
        let envs: Result<Vec<Box<dyn Env>>> = (0..SLOTS).map(|_| entry.env()).collect();
        let pool = EnvPool::new(envs?, side.map(|side| (side, side)), Some(EPISODE), threads(workers)?)?;
        let columns = ColumnIndices::of(pool.infos().schema())?;
        let mut policy = RandomPolicy::new(pool.spec(), SLOTS);
        (0..SLOTS).for_each(|slot| policy.begin(slot, Key::new(slot as u64)));
        let mut actions = vec![];
        for _ in 0..64 {
            let mut batch = Batch::zeros(&Schema::new([pool.spec().action_column()])?, SLOTS);
            policy.act(pool.infos(), &[true; SLOTS], &mut batch)?;
            actions.push(batch);
        }
        let mut this = Self { pool, actions, ended: [columns.terminated, columns.truncated], episodes: 0 };
        this.reset(&(0..SLOTS).collect::<Vec<_>>())?;
        Ok(this)
    }

    fn reset(&mut self, slots: &[usize]) -> Result<()> {
        let first = self.episodes;
        self.episodes += slots.len() as u64;
        let reset = |(slot, seed): (&usize, u64)| Reset { slot: *slot, seed, options: ResetOptions::default() };
        self.pool.reset(&slots.iter().zip(first..).map(reset).collect::<Vec<_>>())
    }

    /// Environment steps per second.
    fn rate(&mut self) -> Result<f64> {
        let (clock, mut steps) = (Instant::now(), 0);
        while clock.elapsed() < TURN {
            for actions in &self.actions {
                self.pool.step(actions, &[true; SLOTS])?;
            }
            steps += self.actions.len() * SLOTS;
            let infos = self.pool.infos();
            let over = |&slot: &usize| self.ended.iter().any(|&column| infos.row(slot).at::<u8>(column)[0] > 0);
            let over: Vec<usize> = (0..SLOTS).filter(over).collect();
            if !over.is_empty() {
                self.reset(&over)?;
            }
        }
        Ok(steps as f64 / clock.elapsed().as_secs_f64())
    }
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

fn main() -> Result<()> {
    let mut arguments = std::env::args().skip(1).filter_map(|word| word.parse::<usize>().ok());
    let (workers, pairs) = (arguments.next().unwrap_or(2), arguments.next().unwrap_or(9));
    for (id, side) in CASES {
        let (mut one, mut many) = (Side::new(id, side, 1)?, Side::new(id, side, workers)?);
        let (mut alone, mut together, mut ratios) = (vec![], vec![], vec![]);
        for _ in 0..pairs {
            let (a, b) = (one.rate()?, many.rate()?);
            alone.push(a);
            together.push(b);
            ratios.push(b / a);
        }
        let frames = side.map_or("no frames".to_owned(), |side| format!("{side} px"));
        let (least, most) = ratios.iter().fold((f64::MAX, 0.0_f64), |(low, high), &r| (low.min(r), high.max(r)));
        println!(
            "{id:<24} {frames:<10} {:>11.0} steps/s on 1 thread, {:>11.0} on {workers}: {:.2} x [{least:.2}, {most:.2}]",
            median(alone),
            median(together),
            median(ratios)
        );
    }
    Ok(())
}
