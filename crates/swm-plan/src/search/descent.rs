//! [`Descent`]: the optimisation loop of all gradient solvers.
//!
//! Each step computes costs and gradients, lets the solver adjust the gradient, moves the candidates, adds noise, and
//! projects the candidates onto the feasible set (action bounds or probability simplices).

use super::optimizer::{Memory, Optimizer};
use super::population::Population;
use super::problem::{UNWRITTEN, check_costs, differentiable};
use swm_core::{CostModel, Error, Iteration, Plan, PlanProblem, PlanTrace, Result};

/// The optimizer and the noise of one step.
#[derive(Clone, Copy)]
pub struct Step<'a> {
    /// Turns a gradient into a step.
    pub optimizer: &'a Optimizer,
    /// The standard deviation of the noise added after the step; 0 for none.
    pub action_noise: f32,
}

/// Moves actions to the nearest allowed actions.
type Projection<'p> = Box<dyn Fn(&mut [f32]) + 'p>;

/// Candidates that descend the gradient of their cost.
pub struct Descent<'p> {
    /// The candidates.
    pub population: Population,
    /// The gradient of each candidate's cost, `[envs, samples, horizon, dim]`.
    pub gradient: Vec<f32>,
    /// The trace of the search of every environment, `[envs]`.
    pub trace: Vec<PlanTrace>,
    /// The number of steps done so far.
    pub steps: usize,
    solver: &'static str,
    memory: Memory,
    problem: PlanProblem<'p>,
    project: Projection<'p>,
}

impl<'p> Descent<'p> {
    /// Creates `samples` candidates for each environment: the initial guess, and random candidates around the guess
    /// with the standard deviation `sigma`. `project` moves actions to the nearest allowed actions, now and after every
    /// step.
    ///
    /// # Errors
    /// As [`Population::new`].
    pub fn new(
        solver: &'static str,
        problem: &PlanProblem<'p>,
        samples: usize,
        sigma: f32,
        project: impl Fn(&mut [f32]) + 'p,
    ) -> Result<Self> {
        let mut population = Population::around(solver, problem, samples, sigma)?;
        project(&mut population.actions);
        Ok(Self {
            gradient: vec![0.0; population.actions.len()],
            trace: vec![PlanTrace::default(); problem.keys.len()],
            steps: 0,
            solver,
            memory: Memory::new(population.actions.len()),
            population,
            problem: *problem,
            project: Box::new(project),
        })
    }

    /// Takes up to `steps` steps; returns whether the search goes on: time is left before the deadline, and the observer
    /// of the problem has not ended it.
    ///
    /// `prepare` runs after costs and gradients are computed; it records the trace and adjusts the gradient. The observer
    /// reads the gradient before it is adjusted.
    ///
    /// # Errors
    /// When the model fails, a cost or a gradient is missing or not finite, or `prepare` fails.
    pub fn run(
        &mut self,
        cost: &mut dyn CostModel,
        steps: usize,
        step: Step<'_>,
        mut prepare: impl FnMut(&mut Self, &mut dyn CostModel) -> Result<()>,
    ) -> Result<bool> {
        for _ in 0..steps {
            self.differentiate(cost)?;
            let goes_on = self.observed(&self.population.costs)?;
            prepare(self, cost)?;
            self.step(step);
            if !goes_on || self.problem.is_late() {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// Shows the candidates with `costs` and their gradient to the observer of the problem; returns whether the search
    /// goes on.
    ///
    /// # Errors
    /// The error of the observer.
    pub fn observed(&self, costs: &[f32]) -> Result<bool> {
        self.problem.observed(|| Iteration {
            index: self.steps,
            candidates: self.population.candidates(),
            costs,
            elites: vec![],
            gradient: Some(&self.gradient),
        })
    }

    /// Computes the cost and the gradient of every candidate.
    fn differentiate(&mut self, cost: &mut dyn CostModel) -> Result<()> {
        let (candidates, costs) = self.population.split();
        costs.fill(UNWRITTEN);
        self.gradient.fill(UNWRITTEN);
        differentiable(self.solver, cost)?.cost_and_gradient(candidates, costs, &mut self.gradient)?;
        check_costs(&self.population.costs, self.population.samples(), self.steps)?;
        self.check_gradient()
    }

    /// Checks that the gradient is finite.
    ///
    /// # Errors
    /// When a value of the gradient is not finite; the message names the step and the candidate.
    pub fn check_gradient(&self) -> Result<()> {
        let Some(i) = self.gradient.iter().position(|g| !g.is_finite()) else {
            return Ok(());
        };
        let (population, iteration) = (&self.population, self.steps);
        let (step, candidate) = (i / population.dim() % self.problem.horizon, i / population.len());
        Err(Error::NotFinite {
            what: "the gradient of a candidate's cost".to_owned(),
            given: format!(
                "{} at step {step} for candidate {} of planned environment {} in iteration {iteration}",
                self.gradient[i],
                candidate % population.samples(),
                candidate / population.samples()
            ),
            fix: "the gradient explodes over this horizon or was not written: shorten the horizon, clip the gradient, take \
                  smaller steps, or check the checkpoint"
                .to_owned(),
        })
    }

    /// Moves every candidate once against its gradient, adds noise and projects.
    pub fn step(&mut self, step: Step<'_>) {
        step.optimizer.step(&mut self.memory, &mut self.population.actions, &self.gradient);
        self.population.perturb(step.action_noise, self.steps);
        (self.project)(&mut self.population.actions);
        self.steps += 1;
    }

    /// Clears the memory of the optimizer.
    pub fn forget(&mut self) {
        self.memory.clear();
    }

    /// Records the current costs in the trace; returns the cheapest candidate of every environment.
    pub fn record(&mut self) -> Vec<usize> {
        let best = self.population.cheapest();
        self.population.record(&mut self.trace, &best);
        best
    }

    /// Evaluates the current candidates and returns the cheapest of every environment as its plan.
    ///
    /// # Errors
    /// When the model fails, or a cost is missing or not finite.
    pub fn finish(mut self, cost: &mut dyn CostModel) -> Result<Plan> {
        self.population.evaluate(cost, self.steps)?;
        let best = self.record();
        Ok(self.population.plan(&best, self.trace))
    }
}
