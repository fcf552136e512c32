//! What a plan is for: objectives that compose, and constraints, over the latents and actions of a candidate.
//!
//! An [`Objective`] prices one [`Trajectory`] and says how the price changes with every latent and action; a list of
//! objectives is their sum. A [`Constraint`] is an inequality, satisfied when its value is at most 0. Two models apply them:
//! [`ObjectiveCost`] rolls out any latent dynamics and prices what comes, with the gradient by back-propagation through
//! time; [`Regularised`] keeps the cost of a model and adds what depends on actions alone. [`ObjectiveConfig`] describes
//! both in a file.
//!
//! Actions are in the model's (normalised) units throughout, latents in the model's.

mod config;
mod constraint;
mod cost;
mod regularised;
mod term;

pub use config::{Limit, ObjectiveConfig, Term};
pub use constraint::{ActionNorm, Constraint, CustomConstraint, LatentBox};
pub use cost::ObjectiveCost;
pub use regularised::Regularised;
pub use term::{Change, Control, Goal, When};

use serde::{Deserialize, Serialize};
use std::ops::Range;
use swm_core::{Candidates, Error, Result};

/// One candidate and where it leads.
#[derive(Clone, Copy, Debug)]
pub struct Trajectory<'a> {
    /// The latents, the present first, `[horizon + 1, latent]`; empty where the model shows none.
    pub latents: &'a [f32],
    /// The latent of the goal, `[latent]`; empty where the model shows none.
    pub goal: &'a [f32],
    /// The actions, `[horizon, dim]`.
    pub actions: &'a [f32],
    /// Numbers of one model step.
    pub dim: usize,
}

/// How a price changes with a trajectory: gradients are added here.
#[derive(Debug)]
pub struct Slope<'a> {
    /// With every latent, `[horizon + 1, latent]`; that of the present leads nowhere.
    pub latents: &'a mut [f32],
    /// With every action, `[horizon, dim]`.
    pub actions: &'a mut [f32],
}

/// How large trajectories are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shape {
    /// Model steps.
    pub horizon: usize,
    /// Numbers of one latent; 0 where the model shows none.
    pub latent: usize,
    /// Numbers of one model step.
    pub dim: usize,
}

/// A price of trajectories.
pub trait Objective: Send + Sync {
    /// Whether it looks at latents.
    fn needs_latents(&self) -> bool;

    /// Checks the settings, for trajectories of this shape.
    ///
    /// # Errors
    /// When they contradict each other or the shape.
    fn check(&self, shape: Shape) -> Result<()>;

    /// The price.
    fn cost(&self, trajectory: Trajectory<'_>) -> f32;

    /// Adds the gradient of the price.
    fn add_gradient(&self, trajectory: Trajectory<'_>, slope: &mut Slope<'_>);
}

impl<O: Objective + ?Sized> Objective for Box<O> {
    fn needs_latents(&self) -> bool {
        (**self).needs_latents()
    }

    fn check(&self, shape: Shape) -> Result<()> {
        (**self).check(shape)
    }

    fn cost(&self, trajectory: Trajectory<'_>) -> f32 {
        (**self).cost(trajectory)
    }

    fn add_gradient(&self, trajectory: Trajectory<'_>, slope: &mut Slope<'_>) {
        (**self).add_gradient(trajectory, slope);
    }
}

/// The sum.
impl<O: Objective> Objective for Vec<O> {
    fn needs_latents(&self) -> bool {
        self.iter().any(Objective::needs_latents)
    }

    fn check(&self, shape: Shape) -> Result<()> {
        self.iter().try_for_each(|term| term.check(shape))
    }

    fn cost(&self, trajectory: Trajectory<'_>) -> f32 {
        self.iter().map(|term| term.cost(trajectory)).sum()
    }

    fn add_gradient(&self, trajectory: Trajectory<'_>, slope: &mut Slope<'_>) {
        self.iter().for_each(|term| term.add_gradient(trajectory, slope));
    }
}

/// Some numbers of a latent: one, or those from the first up to, but without, the second. In a file, `3` or `[8, 16]`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Pick {
    /// One.
    One(usize),
    /// Several.
    Range([usize; 2]),
}

impl Pick {
    fn range(self) -> Range<usize> {
        match self {
            Self::One(i) => i..i + 1,
            Self::Range([from, to]) => from..to,
        }
    }
}

/// The numbers of a latent that are picked; all of them where none is named.
fn picked(picks: &[Pick], latent: usize) -> impl Iterator<Item = usize> + '_ {
    let all = picks.is_empty().then_some(0..latent);
    picks.iter().map(|pick| pick.range()).chain(all).flatten()
}

/// Checks that picks are numbers of a latent, each once.
fn check_picks(what: &str, picks: &[Pick], latent: usize) -> Result<()> {
    let mut seen = vec![false; latent];
    for pick in picks {
        let range = pick.range();
        if range.is_empty() || range.end > latent {
            return Err(Error::OutOfSpace {
                what: format!("{what}, latents"),
                given: format!("{}..{}", range.start, range.end),
                expected: format!("numbers of a latent, within 0..{latent}"),
            });
        }
        for i in range {
            if std::mem::replace(&mut seen[i], true) {
                return Err(Error::config(format!("{what}, latents"), format!("{i} is named twice"), "name it once"));
            }
        }
    }
    Ok(())
}

/// Checks that there are latents to look at.
fn check_latents(what: &str, shape: Shape) -> Result<()> {
    if shape.latent > 0 {
        return Ok(());
    }
    Err(Error::config(
        what,
        "it looks at latents, and this model shows none",
        "choose a term on actions, or another model",
    ))
}

/// Checks a setting that must be finite and not negative.
fn check_positive(what: &str, name: &str, value: f32) -> Result<()> {
    if value.is_finite() && value >= 0.0 {
        return Ok(());
    }
    Err(Error::config(format!("{what}, {name}"), value.to_string(), "choose a finite number of at least 0"))
}

/// Checks that a model step is a whole number of actions.
fn check_block(what: &str, block: usize, dim: usize) -> Result<()> {
    if block > 0 && dim.is_multiple_of(block) {
        return Ok(());
    }
    let given = format!("{block} actions in a model step of {dim} numbers");
    Err(Error::config(format!("{what}, block"), given, "give the action block that plans are made with"))
}

/// Candidates and where they lead.
///
/// # Shapes
/// `latents` is `[envs, samples, horizon + 1, latent]`, `goals` is `[envs, latent]`.
#[derive(Clone, Copy)]
struct Rolled<'a> {
    candidates: Candidates<'a>,
    latents: &'a [f32],
    goals: &'a [f32],
    latent: usize,
}

impl<'a> Rolled<'a> {
    /// Numbers of the latents and of the actions of a candidate.
    fn sizes(&self) -> (usize, usize) {
        let Candidates { horizon, dim, .. } = self.candidates;
        ((horizon + 1) * self.latent, horizon * dim)
    }

    /// Every candidate.
    fn trajectories(self) -> impl Iterator<Item = Trajectory<'a>> {
        let (way, len) = self.sizes();
        (0..self.candidates.envs * self.candidates.samples).map(move |i| Trajectory {
            latents: &self.latents[i * way..][..way],
            goal: &self.goals[i / self.candidates.samples * self.latent..][..self.latent],
            actions: &self.candidates.actions[i * len..][..len],
            dim: self.candidates.dim,
        })
    }

    /// Adds the price of every candidate to `costs`, `[envs, samples]`.
    fn add_costs(self, objective: &dyn Objective, costs: &mut [f32]) {
        self.trajectories().zip(costs).for_each(|(trajectory, cost)| *cost += objective.cost(trajectory));
    }

    /// Adds the gradients of the prices to those of latents and actions.
    fn add_gradients(self, objective: &dyn Objective, latents: &mut [f32], actions: &mut [f32]) {
        let (way, len) = self.sizes();
        for (i, trajectory) in self.trajectories().enumerate() {
            let (latents, actions) = (&mut latents[i * way..][..way], &mut actions[i * len..][..len]);
            objective.add_gradient(trajectory, &mut Slope { latents, actions });
        }
    }

    /// How many values the constraints of all candidates have.
    fn count(self, constraints: &[Box<dyn Constraint>]) -> usize {
        let each: usize =
            constraints.iter().map(|constraint| constraint.count(self.candidates.horizon, self.latent)).sum();
        self.candidates.envs * self.candidates.samples * each
    }

    /// Writes the values of all constraints, `[envs, samples, constraints]`.
    fn constrain(self, constraints: &[Box<dyn Constraint>], values: &mut [f32]) {
        let mut rest = values;
        for trajectory in self.trajectories() {
            for constraint in constraints {
                let (values, tail) = rest.split_at_mut(constraint.count(self.candidates.horizon, self.latent));
                constraint.values(trajectory, values);
                rest = tail;
            }
        }
    }

    /// Adds the gradients of the constraints, each times its weight, to those of latents and actions.
    fn add_constraint_gradients(
        self,
        constraints: &[Box<dyn Constraint>],
        weights: &[f32],
        latents: &mut [f32],
        actions: &mut [f32],
    ) {
        let (way, len) = self.sizes();
        let mut rest = weights;
        for (i, trajectory) in self.trajectories().enumerate() {
            let (latents, actions) = (&mut latents[i * way..][..way], &mut actions[i * len..][..len]);
            let slope = &mut Slope { latents, actions };
            for constraint in constraints {
                let (weights, tail) = rest.split_at(constraint.count(self.candidates.horizon, self.latent));
                constraint.add_gradient(trajectory, weights, slope);
                rest = tail;
            }
        }
    }
}

/// Checks that trajectories of this shape can be priced and constrained so.
fn check_all(shape: Shape, objective: &dyn Objective, constraints: &[Box<dyn Constraint>]) -> Result<()> {
    objective.check(shape)?;
    constraints.iter().try_for_each(|constraint| constraint.check(shape))
}

/// Checks that an array has as many numbers as there are for it.
fn check_room(what: &str, given: usize, expected: usize) -> Result<()> {
    if given == expected {
        return Ok(());
    }
    Err(Error::mismatch(what, format!("{given} numbers"), format!("{expected}")))
}
