//! Prints a table of the success counts of every expert of every environment. The READMEs quote these counts.
//!
//!     cargo run --release -p swm-envs --example experts [PART OF AN ID] [EPISODES]
//!
//! Episode k starts from `reset(k)`, with the default variation and with all factors varied, and is truncated at the
//! time limit of the environment. Episodes that are solved at the start are counted separately.

use std::io::Write as _;
use std::time::{Duration, Instant};
use swm_core::policy::Expert;
use swm_core::{Action, Batch, Env, EnvEntry, ExpertEntry, Key, ResetOptions, Result, Schema, Space, VariationRequest};
use swm_envs::ENVS;

/// Episodes per row, unless the command line gives another number.
const EPISODES: u64 = 200;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let id_part = arguments.first().map_or("", String::as_str).to_lowercase();
    let episodes = arguments.get(1).map_or(Ok(EPISODES), |number| number.parse())?;
    let mut out = std::io::stdout();
    writeln!(
        out,
        "| environment | expert | factors varied | success | steps, median | solved at start | steps/s of a core |"
    )?;
    writeln!(out, "| --- | --- | --- | --- | --- | --- | --- |")?;
    for entry in ENVS.rows.iter().filter(|entry| entry.id.to_lowercase().contains(&id_part)) {
        for expert in entry.experts {
            for (factors, variation) in [("default", None), ("all", Some(vec!["all".to_owned()]))] {
                let variation = VariationRequest { variation, ..VariationRequest::default() };
                let tally = play(entry, expert, &ResetOptions { variation, ..ResetOptions::default() }, episodes)?;
                writeln!(out, "| `{}` | `{}` | {factors} | {tally} |", entry.id, expert.id)?;
            }
        }
    }
    Ok(())
}

/// The results of some episodes.
#[derive(Default)]
struct Tally {
    episodes: usize,
    solved_at_start: usize,
    /// The number of steps of every successful episode.
    successes: Vec<usize>,
    steps: usize,
    time: Duration,
}

impl std::fmt::Display for Tally {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let mut successes = self.successes.clone();
        successes.sort_unstable();
        let median = successes.get(successes.len() / 2).map_or("–".to_owned(), ToString::to_string);
        let speed = self.steps as f64 / self.time.as_secs_f64();
        let tried = self.episodes - self.solved_at_start;
        write!(f, "{} of {tried} | {median} | {} | {speed:.0}", successes.len(), self.solved_at_start)
    }
}

/// Plays episodes 0, 1, … on all cores.
fn play(entry: &EnvEntry, expert: &ExpertEntry, options: &ResetOptions, episodes: u64) -> Result<Tally> {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let tallies = std::thread::scope(|scope| {
        let workers: Vec<_> = (0..cores)
            .map(|first| {
                scope.spawn(move || {
                    let mut player = Player::new(entry, expert)?;
                    (first as u64..episodes).step_by(cores).try_for_each(|seed| player.episode(seed, options))?;
                    Ok(player.tally)
                })
            })
            .collect();
        workers
            .into_iter()
            .map(|worker| worker.join().expect("joining a worker thread"))
            .collect::<Result<Vec<Tally>>>()
    })?;
    Ok(tallies.into_iter().fold(Tally::default(), |mut sum, tally| {
        sum.episodes += tally.episodes;
        sum.solved_at_start += tally.solved_at_start;
        sum.successes.extend(tally.successes);
        sum.steps += tally.steps;
        sum.time += tally.time;
        sum
    }))
}

/// An environment, its expert, and the results so far.
struct Player {
    env: Box<dyn Env>,
    expert: Box<dyn Expert>,
    row: Batch,
    tally: Tally,
}

impl Player {
    fn new(entry: &EnvEntry, expert: &ExpertEntry) -> Result<Self> {
        let env = entry.env().expect("creating the environment");
        let row = Batch::zeros(&Schema::new(env.spec().columns.clone())?, 1);
        Ok(Self { env, expert: (expert.make)(), row, tally: Tally::default() })
    }

    fn episode(&mut self, seed: u64, options: &ResetOptions) -> Result<()> {
        self.env.reset(seed, options)?;
        self.expert.begin(Key::new(seed));
        self.tally.episodes += 1;
        if self.env.is_success() {
            self.tally.solved_at_start += 1;
            return Ok(());
        }
        let begun = Instant::now();
        for step in 1..=self.env.spec().max_episode_steps {
            let terminated = self.step()?;
            self.tally.steps += 1;
            if self.env.is_success() {
                self.tally.successes.push(step);
            }
            if terminated || self.env.is_success() {
                break;
            }
        }
        self.tally.time += begun.elapsed();
        Ok(())
    }

    fn step(&mut self) -> Result<bool> {
        let mut action = vec![0.0; self.env.spec().action_dim()];
        self.env.observe(&mut self.row.row_mut(0));
        self.expert.act(self.row.row(0), &mut action)?;
        let transition = match self.env.spec().action_space {
            Space::Box { .. } => {
                self.env.step(Action::Continuous(&action.iter().map(|&v| v as f32).collect::<Vec<_>>()))
            }
            _ => self.env.step(Action::Discrete(&action.iter().map(|&v| v as i64).collect::<Vec<_>>())),
        }?;
        Ok(transition.terminated || transition.truncated)
    }
}
