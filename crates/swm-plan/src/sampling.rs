//! What the sampling solvers share: candidates drawn around a mean, what they cost, and the cheapest of them.

use crate::colour::Colour;
use crate::gaussian::{self, RUN};
use crate::problem::{Bounds, score};
use crate::topk::smallest;
use rayon::prelude::*;
use swm_core::{Candidates, CostModel, Error, Key, Plan, PlanProblem, PlanTrace, Result};

/// A diagonal Gaussian over the plans of one environment, and how it came about.
pub struct Belief {
    /// The mean, `[horizon, dim]`.
    pub mean: Vec<f32>,
    /// The standard deviation, `[horizon, dim]`.
    pub std: Vec<f32>,
    /// One entry an iteration.
    pub trace: PlanTrace,
    /// Scratch to choose elites in.
    pub order: Vec<usize>,
}

impl Belief {
    /// Where the search of every environment begins: at the first guess, moved into the bounds, or at the number within
    /// them that is nearest to 0; with the standard deviation `sigma`.
    pub fn start(problem: &PlanProblem<'_>, bounds: Bounds<'_>, sigma: f32) -> Vec<Self> {
        let len = problem.horizon * problem.space.dim();
        let start = |env| {
            let mut mean = problem.init.map_or_else(|| vec![0.0; len], |init| init[env * len..][..len].to_vec());
            bounds.clip(&mut mean);
            Self { mean, std: vec![sigma; len], trace: PlanTrace::default(), order: vec![] }
        };
        (0..problem.keys.len()).map(start).collect()
    }

    /// The plans: the means.
    pub fn plan(beliefs: Vec<Self>) -> Plan {
        let actions = beliefs.iter().flat_map(|belief| &belief.mean).copied().collect();
        finish(actions, beliefs.into_iter().map(|belief| belief.trace).collect())
    }
}

/// A plan from its actions and what was traced: its costs are the best of the last iteration.
pub fn finish(actions: Vec<f32>, trace: Vec<PlanTrace>) -> Plan {
    let costs = trace.iter().filter_map(|trace| trace.best.last().copied()).collect();
    Plan { actions, costs, trace }
}

/// Iterates until there is no time left, but at least once. The thread pool is entered here, once a plan: to enter it
/// from outside costs as much as to draw a population.
///
/// # Errors
/// Those of an iteration.
pub fn search(
    iterations: usize,
    problem: &PlanProblem<'_>,
    mut iterate: impl FnMut(usize) -> Result<()> + Send,
) -> Result<()> {
    if problem.keys.is_empty() {
        return Ok(());
    }
    rayon::scope(|_| {
        for iteration in 0..iterations {
            iterate(iteration)?;
            if problem.is_late() {
                break;
            }
        }
        Ok(())
    })
}

/// The candidates of one iteration in every environment.
///
/// # Shapes
/// `actions` is `[envs, samples, horizon, dim]`, `costs` is `[envs, samples]`.
pub struct Samples {
    streams: Vec<Key>,
    samples: usize,
    horizon: usize,
    dim: usize,
    actions: Vec<f32>,
    costs: Vec<f32>,
}

impl Samples {
    /// Room for `samples` candidates an environment. `solver` keeps their draws apart from other solvers'.
    pub fn new(solver: &str, problem: &PlanProblem<'_>, samples: usize) -> Self {
        let streams: Vec<Key> = problem.keys.iter().map(|key| key.with(solver)).collect();
        let (horizon, dim, costs) = (problem.horizon, problem.space.dim(), streams.len() * samples);
        Self { streams, samples, horizon, dim, actions: vec![0.0; costs * horizon * dim], costs: vec![0.0; costs] }
    }

    /// Numbers of one candidate.
    pub fn len(&self) -> usize {
        self.horizon * self.dim
    }

    /// Draws all candidates: `clip(mean + std ξ)` with standard normal ξ, of a colour where one is given; the first is the
    /// mean.
    ///
    /// The noise of an environment and an iteration is one keyed sequence in which every candidate has its place,
    /// whoever draws it and whatever is drawn beside it.
    pub fn draw(&mut self, iteration: usize, beliefs: &[Belief], bounds: Bounds<'_>, colour: Option<&Colour>) {
        let (len, all) = (self.len(), self.samples * self.len());
        let streams = &self.streams;
        self.actions.par_chunks_exact_mut(all).zip(beliefs).enumerate().for_each(|(env, (candidates, belief))| {
            let key = streams[env].at(iteration as u64);
            // As many candidates as numbers in a run: every task begins at a run.
            let tasks = candidates.par_chunks_mut(RUN * len).enumerate();
            tasks.for_each_init(Vec::new, |scratch, (task, candidates)| {
                gaussian::fill(key, task * len, candidates);
                for candidate in candidates.chunks_exact_mut(len) {
                    if let Some(colour) = colour {
                        colour.paint(candidate, scratch);
                    }
                    place(candidate, belief);
                    bounds.clip(candidate);
                }
            });
            candidates[..len].copy_from_slice(&belief.mean);
        });
    }

    /// Lets `write` write every candidate, given its environment, its number and its environment's stream.
    pub fn write(&mut self, iteration: usize, write: impl Fn(usize, usize, Key, &mut [f32]) + Sync) {
        let (len, all) = (self.len(), self.samples * self.len());
        let streams = &self.streams;
        self.actions.par_chunks_exact_mut(all).enumerate().for_each(|(env, candidates)| {
            let key = streams[env].at(iteration as u64);
            let candidates = candidates.par_chunks_exact_mut(len).enumerate().with_min_len(RUN);
            candidates.for_each(|(sample, candidate)| write(env, sample, key, candidate));
        });
    }

    /// Puts these candidates, `[n, horizon, dim]` for every environment, in the place of the second and those after it.
    pub fn replace(&mut self, candidates: &[Vec<f32>]) {
        let (len, all) = (self.len(), self.samples * self.len());
        for (population, candidates) in self.actions.chunks_exact_mut(all).zip(candidates) {
            population[len..][..candidates.len()].copy_from_slice(candidates);
        }
    }

    /// Asks the model what every candidate costs.
    ///
    /// # Errors
    /// When the model fails, or a cost is missing or not finite.
    pub fn score(&mut self, cost: &mut dyn CostModel, iteration: usize) -> Result<()> {
        let Self { samples, horizon, dim, .. } = *self;
        let candidates = Candidates { actions: &self.actions, envs: self.streams.len(), samples, horizon, dim };
        score(cost, candidates, iteration, &mut self.costs)
    }

    /// The candidates of one environment.
    pub fn of(&self, env: usize) -> Population<'_> {
        let (len, n) = (self.len(), self.samples);
        Population::new(&self.actions[env * n * len..][..n * len], &self.costs[env * n..][..n])
    }
}

/// From noise to an action sequence.
pub fn place(candidate: &mut [f32], belief: &Belief) {
    for ((number, mean), std) in candidate.iter_mut().zip(&belief.mean).zip(&belief.std) {
        *number = mean + std * *number;
    }
}

/// The candidates of one environment and their costs.
#[derive(Clone, Copy)]
pub struct Population<'a> {
    len: usize,
    actions: &'a [f32],
    costs: &'a [f32],
}

impl<'a> Population<'a> {
    /// Candidates, one after another, and what each costs.
    pub fn new(actions: &'a [f32], costs: &'a [f32]) -> Self {
        Self { len: actions.len() / costs.len(), actions, costs }
    }

    /// The `k` cheapest, cheapest first; `order` is scratch.
    pub fn elites<'e>(self, k: usize, order: &'e mut Vec<usize>) -> Elites<'e>
    where
        'a: 'e,
    {
        Elites { population: self, chosen: smallest(self.costs, k, order) }
    }
}

/// The cheapest candidates of one environment, cheapest first.
#[derive(Clone, Copy)]
pub struct Elites<'a> {
    population: Population<'a>,
    chosen: &'a [usize],
}

/// Numbers of a plan that are summed together; a sum in double precision is what keeps a processor waiting.
const LANES: usize = 8;

impl<'a> Elites<'a> {
    /// Their action sequences.
    pub fn actions(self) -> impl Iterator<Item = &'a [f32]> + Clone {
        let Population { len, actions, .. } = self.population;
        self.chosen.iter().map(move |&i| &actions[i * len..][..len])
    }

    /// How many.
    pub fn len(self) -> usize {
        self.chosen.len()
    }

    /// The cost of one.
    pub fn cost(self, elite: usize) -> f32 {
        self.population.costs[self.chosen[elite]]
    }

    /// The cheapest.
    pub fn best(self) -> &'a [f32] {
        let Population { len, actions, .. } = self.population;
        &actions[self.chosen[0] * len..][..len]
    }

    /// Moves a Gaussian to the mean and the unbiased standard deviation of the elites, number by number; it keeps the
    /// share `momentum` of what it was.
    #[allow(clippy::cast_possible_truncation, clippy::cast_precision_loss)]
    pub fn refit(self, momentum: f32, mean: &mut [f32], std: &mut [f32]) {
        let n = self.len() as f64;
        let keep = f64::from(momentum);
        let blend = |old: &mut f32, new: f64| *old = (keep * f64::from(*old) + (1.0 - keep) * new) as f32;
        for (block, (mean, std)) in mean.chunks_mut(LANES).zip(std.chunks_mut(LANES)).enumerate() {
            let centre = self.sum(block, |_, _, a| a).map(|sum| sum / n);
            let square = self.sum(block, |_, lane, a| (a - centre[lane]).powi(2));
            mean.iter_mut().zip(centre).for_each(|(mean, centre)| blend(mean, centre));
            std.iter_mut().zip(square).for_each(|(std, square)| blend(std, (square / (n - 1.0)).sqrt()));
        }
    }

    /// Writes the mean of the elites, each with its weight; weights add up to 1.
    #[allow(clippy::cast_possible_truncation)]
    pub fn weighted_mean(self, weights: &[f64], mean: &mut [f32]) {
        for (block, mean) in mean.chunks_mut(LANES).enumerate() {
            let sum = self.sum(block, |elite, _, a| weights[elite] * a);
            mean.iter_mut().zip(sum).for_each(|(mean, sum)| *mean = sum as f32);
        }
    }

    /// Sums `term(elite, lane, action)` for every number of a block of a plan, from the cheapest elite to the dearest, so
    /// that the sum is the same wherever it runs.
    fn sum(self, block: usize, term: impl Fn(usize, usize, f64) -> f64) -> [f64; LANES] {
        let mut sums = [0.0; LANES];
        for (elite, actions) in self.actions().enumerate() {
            for (lane, (sum, &action)) in sums.iter_mut().zip(&actions[block * LANES..]).enumerate() {
                *sum += term(elite, lane, f64::from(action));
            }
        }
        sums
    }

    /// Notes the iteration, with the spread that the distribution has now.
    #[allow(clippy::cast_possible_truncation, clippy::cast_precision_loss)]
    pub fn note(self, trace: &mut PlanTrace, spread: f32) {
        let sum: f64 = (0..self.len()).map(|elite| f64::from(self.cost(elite))).sum();
        trace.best.push(self.cost(0));
        trace.mean.push((sum / self.len() as f64) as f32);
        trace.spread.push(spread);
    }
}

/// The mean of some numbers.
#[allow(clippy::cast_possible_truncation, clippy::cast_precision_loss)]
pub fn average(values: &[f32]) -> f32 {
    (values.iter().map(|&value| f64::from(value)).sum::<f64>() / values.len() as f64) as f32
}

/// Checks the settings of one solver, and says in words what is wrong with one.
#[derive(Clone, Copy)]
pub struct Settings(pub &'static str);

impl Settings {
    /// At least one.
    pub fn some(self, name: &str, value: usize) -> Result<()> {
        self.check(value > 0, name, value, "ask for at least 1")
    }

    /// Elites that there are enough samples for; `least` of them are needed.
    pub fn elites(self, elites: usize, least: usize, samples: usize) -> Result<()> {
        let fix = match least {
            1 => "choose at least 1 and at most the number of samples",
            _ => "choose at least 2 (a spread needs two) and at most the number of samples",
        };
        self.check((least..=samples).contains(&elites), "elites", format!("{elites} of {samples} samples"), fix)
    }

    /// Not more than there are of something.
    pub fn at_most(self, name: &str, value: usize, most: usize, of: &str) -> Result<()> {
        self.check(value <= most, name, value, &format!("choose at most {most}, the number of {of}"))
    }

    /// A finite number above 0.
    pub fn positive(self, name: &str, value: f32) -> Result<()> {
        self.check(value.is_finite() && value > 0.0, name, value, "choose a finite number above 0")
    }

    /// A finite number that is not below 0.
    pub fn not_negative(self, name: &str, value: f32) -> Result<()> {
        self.check(value.is_finite() && value >= 0.0, name, value, "choose a finite number of at least 0")
    }

    /// A share of the past that is kept.
    pub fn momentum(self, value: f32) -> Result<()> {
        let fix = "choose a number of at least 0 and below 1 (1 would learn nothing)";
        self.check((0.0..1.0).contains(&value), "momentum", value, fix)
    }

    fn check(self, fine: bool, name: &str, given: impl ToString, fix: &str) -> Result<()> {
        if fine { Ok(()) } else { Err(Error::config(format!("{} {name}", self.0), given.to_string(), fix)) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn refitting_takes_the_unbiased_deviation_and_keeps_what_momentum_says() {
        let population = Population::new(&[1.0, 100.0, 3.0, 5.0], &[1.0, 9.0, 1.0, 0.0]);
        let (mut mean, mut std, mut order) = ([7.0], [4.0], vec![]);
        let elites = population.elites(3, &mut order);
        elites.refit(0.5, &mut mean, &mut std);
        assert_eq!((mean, std), ([5.0], [3.0]));
        elites.refit(0.0, &mut mean, &mut std);
        assert_eq!((mean, std), ([3.0], [2.0]));
        elites.weighted_mean(&[0.5, 0.25, 0.25], &mut mean);
        assert_eq!(mean, [3.5]);
    }
}
