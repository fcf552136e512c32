//! Plays episodes with planners that have perfect dynamics. Counting is strict: a start that is already solved is not
//! played.

use super::rows::Task;
use rand::seq::index::sample;
use std::collections::BTreeMap;
use std::time::Instant;
use swm_core::pool::threads;
use swm_core::results::{Proportion, Summary};
use swm_core::{Action, Batch, EnvEntry, EnvPool, Key, Policy, ResetOptions, Result, RowRef, Schema, Space};
use swm_plan::{ActionScale, MpcConfig, MpcPolicy, SOLVERS, Score, SimulatorCost};

/// The initial state and the goal of an episode.
pub struct Start {
    seed: u64,
    /// A start row and a goal row; without them, the reset chooses both.
    rows: Option<Batch>,
}

/// The origin of starts.
#[derive(Clone, Copy, Debug)]
pub enum Protocol {
    /// Start and goal from the reset of the environment.
    Episodic,
    /// Two rows from an episode of this expert, with 25 steps between them.
    Demonstrated(&'static str),
}

/// The number of steps from the start of a demonstrated episode to its goal.
const OFFSET: usize = 25;
/// The time limit of a demonstration.
const DEMONSTRATION: usize = 300;

/// A solver with its settings.
#[derive(Clone)]
pub struct Planner {
    /// The solver's id.
    pub solver: &'static str,
    /// The settings of the solver.
    pub settings: serde_json::Value,
    /// The horizons and the action block.
    pub mpc: MpcConfig,
    /// The cost of a candidate.
    pub score: Score,
}

/// The result of playing all starts with one planner.
pub struct Outcome {
    /// The number of starts that were already solved.
    pub solved_at_start: usize,
    /// The success rate of the starts that were not already solved.
    pub success: Proportion,
    /// Steps to the goal in successful episodes.
    pub steps: Option<Summary>,
    /// Seconds per plan, while the plans of other environments are computed on the same cores.
    pub plan: Option<Summary>,
    /// The total time, in seconds.
    pub seconds: f64,
    /// The number of failed episodes that violated each part of the success criterion when they were nearest to a success.
    pub violated: BTreeMap<&'static str, usize>,
}

/// Returns the parts of the success criterion that an observation violates.
pub type Violated = fn(RowRef<'_>) -> Result<Vec<&'static str>>;

/// The number of environments that are played and planned for at the same time.
const SLOTS: usize = 25;

/// The first `n` starts of an environment.
pub fn starts(entry: &EnvEntry, protocol: Protocol, n: usize) -> Result<Vec<Start>> {
    let Protocol::Demonstrated(expert) = protocol else {
        return Ok((0..n as u64).map(|seed| Start { seed, rows: None }).collect());
    };
    let demonstrations = (0..n as u64).map(|seed| demonstrate(entry, expert, seed)).collect::<Result<Vec<Batch>>>()?;
    let lengths = demonstrations.iter().map(|rows| rows.rows().saturating_sub(OFFSET));
    let all: Vec<(usize, usize)> = lengths.enumerate().flat_map(|(e, len)| (0..len).map(move |t| (e, t))).collect();
    let picks = sample(&mut Key::new(0).with("starts").rng(), all.len(), n);
    let start = |(seed, pick): (usize, usize)| {
        let (demonstration, t) = all[pick];
        let from = &demonstrations[demonstration];
        let mut rows = Batch::zeros(from.schema(), 2);
        rows.copy_row(0, from, t)?;
        rows.copy_row(1, from, t + OFFSET)?;
        Ok(Start { seed: seed as u64, rows: Some(rows) })
    };
    picks.into_iter().enumerate().map(start).collect()
}

/// The rows of one episode of an expert.
fn demonstrate(entry: &EnvEntry, expert: &str, seed: u64) -> Result<Batch> {
    let mut env = entry.env().expect("creating the environment");
    let expert = entry.experts.iter().find(|entry| entry.id == expert).expect("the environment has the expert");
    let mut expert = (expert.make)();
    env.reset(seed, &ResetOptions::default())?;
    expert.begin(Key::new(seed).with("expert"));
    let limit = DEMONSTRATION;
    let mut rows = Batch::zeros(&Schema::new(env.spec().columns.clone())?, limit + 1);
    let mut action = vec![0.0; env.spec().action_dim()];
    let mut step = 0;
    env.observe(&mut rows.row_mut(step));
    while step < limit && !env.is_success() {
        expert.act(rows.row(step), &mut action)?;
        let values: Vec<f32> = action.iter().map(|&v| v as f32).collect();
        let integers: Vec<i64> = action.iter().map(|&v| v as i64).collect();
        match env.spec().action_space {
            Space::Box { .. } => env.step(Action::Continuous(&values))?,
            _ => env.step(Action::Discrete(&integers))?,
        };
        step += 1;
        env.observe(&mut rows.row_mut(step));
    }
    rows.resize(step + 1);
    Ok(rows)
}

/// Plays every start of a task once.
pub fn play(task: &Task, starts: &[Start], planner: &Planner) -> Result<Outcome> {
    let (begun, Task { entry, budget, .. }) = (Instant::now(), task);
    let (mut solved_at_start, mut played, mut successes, mut latencies) = (0, 0, vec![], vec![]);
    let mut violated = BTreeMap::new();
    for starts in starts.chunks(SLOTS) {
        let envs = starts.iter().map(|_| entry.env().expect("creating the environment")).collect();
        let mut pool = EnvPool::new(envs, None, Some(*budget), threads(0)?)?;
        let slots: Vec<usize> = (0..starts.len()).collect();
        pool.restart(&slots, |slot, env| {
            env.reset(starts[slot].seed, &ResetOptions::default())?;
            starts[slot].rows.as_ref().map_or(Ok(()), |rows| env.restore_from(rows.row(0), rows.row(1)))
        })?;
        let mut policy = planner.policy(entry, &pool)?;
        let mut active: Vec<bool> = slots.iter().map(|&slot| !pool.env(slot).is_success()).collect();
        solved_at_start += active.iter().filter(|&&active| !active).count();
        played += active.iter().filter(|&&active| active).count();
        slots.iter().for_each(|&slot| policy.begin(slot, Key::new(starts[slot].seed)));
        let mut actions = Batch::zeros(&Schema::new([pool.spec().action_column()])?, pool.len());
        let mut nearest = vec![(f64::INFINITY, vec![]); starts.len()];
        for step in 1..=*budget {
            if !active.contains(&true) {
                break;
            }
            policy.observe_envs(&pool, &active)?;
            let infos = pool.infos();
            pool.threads().install(|| policy.act(infos, &active, &mut actions))?;
            pool.step(&actions, &active)?;
            for (slot, active) in active.iter_mut().enumerate().filter(|(_, active)| **active) {
                if pool.env(slot).is_success() {
                    successes.push(step as f64);
                    *active = false;
                    nearest[slot].1.clear();
                } else if pool.env(slot).success_distance() < nearest[slot].0 {
                    nearest[slot] = (pool.env(slot).success_distance(), (task.violated)(pool.infos().row(slot))?);
                }
            }
        }
        for part in nearest.into_iter().flat_map(|(_, parts)| parts) {
            *violated.entry(part).or_insert(0) += 1;
        }
        latencies.extend(policy.take_latencies());
    }
    Ok(Outcome {
        solved_at_start,
        success: Proportion::wilson(successes.len(), played),
        steps: Summary::of(&successes),
        plan: Summary::of(&latencies),
        seconds: begun.elapsed().as_secs_f64(),
        violated,
    })
}

impl Planner {
    fn policy(&self, entry: &EnvEntry, pool: &EnvPool) -> Result<MpcPolicy> {
        let solver = (SOLVERS.get(self.solver)?.make)(&self.settings)?;
        let scale = ActionScale::unscaled(pool.spec());
        let model = SimulatorCost::new(
            {
                let entry = *entry;
                move || entry.env()
            },
            scale.clone(),
            self.mpc.action_block,
            self.score,
        )?;
        MpcPolicy::new(solver, Box::new(model), self.mpc.clone(), scale, pool.spec(), pool.len())
    }
}
