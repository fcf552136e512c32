//! [`Cem`]: the cross-entropy method.
//!
//! Rubinstein and Kroese, *The Cross-Entropy Method* (2004), as algorithm "CEM solver" of the
//! stable-worldmodel paper: a diagonal Gaussian over action sequences is sampled, its cheapest samples (the
//! elites) refit it, and the last mean is the plan. The first candidate of every iteration is the mean itself.
//!
//! What the paper leaves open, and how it is decided here:
//! - The standard deviation of the elites is the unbiased one (divided by `elites - 1`), as in the reference
//!   implementation (`solver/cem.py` calls `std` with its default). So there must be at least two elites.
//! - `sigma` is the first standard deviation, as in the paper's σ₀; the reference calls it `var_scale` and uses
//!   it in the same way.
//!
//! Deviations from the paper and the reference, on purpose:
//! - Candidates are clipped to the bounds of the problem, the first one included. Neither the paper's algorithm
//!   nor the reference clips here: their model then judges actions that the environment would clip before
//!   executing, so the plan's cost is not the cost of what happens. Infinite bounds give their algorithm.
//! - Every candidate draws from its own stream, keyed by (plan key, iteration, sample), where the reference draws
//!   all environments from one generator. A plan is the same bytes whichever other environments are planned
//!   in the call, and for any number of threads.
//! - Equal costs are ordered by index; costs that are not finite are errors.
//! - [`Plan::costs`] is the lowest cost of the last iteration; the reference reports the elites' mean, which
//!   is in the trace here.

use crate::problem::continuous;
use crate::sampling::{Belief, Samples, Settings, average, search};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use swm_core::{CostModel, Plan, PlanProblem, Result, Solver};

const ID: &str = "cem";

/// The cross-entropy method; the defaults are those of the paper's experiments.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Cem {
    /// Candidates an iteration, N.
    pub samples: usize,
    /// Iterations, L.
    pub iterations: usize,
    /// Candidates that refit the distribution, E.
    pub elites: usize,
    /// The first standard deviation, σ₀, in model action units.
    pub sigma: f32,
}

impl Default for Cem {
    fn default() -> Self {
        Self { samples: 300, iterations: 30, elites: 30, sigma: 1.0 }
    }
}

impl Solver for Cem {
    fn solve(&mut self, cost: &mut dyn CostModel, problem: PlanProblem<'_>) -> Result<Plan> {
        self.check()?;
        let bounds = continuous(ID, cost, &problem)?;
        let mut beliefs = Belief::start(&problem, self.sigma);
        let mut samples = Samples::new(ID, &problem, self.samples);

        search(self.iterations, &problem, |iteration| {
            samples.draw(iteration, &beliefs, bounds, None);
            samples.score(cost, iteration)?;
            beliefs.par_iter_mut().enumerate().for_each(|(env, Belief { mean, std, trace, order })| {
                let elites = samples.of(env).elites(self.elites, order);
                elites.refit(0.0, mean, std);
                elites.note(trace, average(std));
            });
            Ok(())
        })?;
        Ok(Belief::plan(beliefs))
    }
}

impl Cem {
    fn check(&self) -> Result<()> {
        let settings = Settings(ID);
        settings.some("iterations", self.iterations)?;
        settings.elites(self.elites, 2, self.samples)?;
        settings.positive("sigma", self.sigma)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::golden;
    use rand::Rng as _;
    use swm_core::{Batch, Candidates, Key, PlanSpace};

    const HORIZON: usize = 4;
    const DIM: usize = 3;

    /// A bowl whose lowest point derives from the environment's number: `Σ (j + 1) (a_j - target_j)²`.
    struct Bowl {
        targets: Vec<Vec<f32>>,
        /// Answers this instead for one candidate `(env, sample)`.
        wrong: Option<(usize, usize, f32)>,
    }

    fn target(env: usize) -> Vec<f32> {
        let mut rng = Key::new(env as u64).with("target").rng();
        (0..HORIZON * DIM).map(|_| rng.random_range(-1.0..1.0)).collect()
    }

    impl Bowl {
        fn of(envs: &[usize]) -> Self {
            Self { targets: envs.iter().map(|&env| target(env)).collect(), wrong: None }
        }
    }

    impl CostModel for Bowl {
        fn observe(&mut self, _: &Batch, envs: &[usize]) -> Result<()> {
            *self = Self::of(envs);
            Ok(())
        }

        fn cost(&mut self, candidates: Candidates<'_>, costs: &mut [f32]) -> Result<()> {
            for (i, actions) in candidates.actions.chunks_exact(HORIZON * DIM).enumerate() {
                let target = &self.targets[i / candidates.samples];
                let terms = actions.iter().zip(target).enumerate();
                costs[i] = terms.map(|(j, (a, t))| (j + 1) as f32 * (a - t).powi(2)).sum();
            }
            if let Some((env, sample, cost)) = self.wrong {
                costs[env * candidates.samples + sample] = cost;
            }
            Ok(())
        }
    }

    fn plan(cem: &Cem, envs: &[usize]) -> Plan {
        let keys: Vec<Key> = envs.iter().map(|&env| Key::new(9).at(env as u64)).collect();
        solve(cem, &mut Bowl::of(envs), &keys, None).expect("a plan")
    }

    fn solve(cem: &Cem, bowl: &mut Bowl, keys: &[Key], init: Option<&[f32]>) -> Result<Plan> {
        let (low, high) = (&[-1.0; DIM][..], &[0.5, 1.0, f32::INFINITY][..]);
        let space = PlanSpace::Continuous { low, high };
        cem.clone().solve(bowl, PlanProblem { horizon: HORIZON, space, keys, init, deadline: None })
    }

    fn small() -> Cem {
        Cem { samples: 64, iterations: 5, elites: 8, sigma: 1.0 }
    }

    #[test]
    fn the_lowest_point_within_bounds_is_found() {
        let plan = plan(&Cem::default(), &[3, 4]);
        for (env, actions) in [3, 4].into_iter().zip(plan.actions.chunks_exact(HORIZON * DIM)) {
            for (j, (action, target)) in actions.iter().zip(target(env)).enumerate() {
                let best = if j % DIM == 0 { target.min(0.5) } else { target };
                assert!((action - best).abs() < 5e-3, "environment {env}, number {j}: {action}, not {best}");
            }
        }
        for (trace, cost) in plan.trace.iter().zip(&plan.costs) {
            assert_eq!(trace.best.len(), 30);
            assert_eq!(trace.best.last(), Some(cost));
            assert!(trace.mean[29] < trace.mean[0] / 10.0 && trace.spread[29] < trace.spread[0] / 10.0);
            assert!(trace.best.iter().zip(&trace.mean).all(|(best, mean)| best <= mean));
        }
    }

    #[test]
    fn updates_are_the_references() {
        let mut belief = golden::begin();
        for update in golden::updates(ID) {
            golden::assert_near(&golden::candidates(&update, &belief, f32::INFINITY), &update.candidates);
            let elites = update.population().elites(golden::ELITES, &mut belief.order);
            elites.refit(0.0, &mut belief.mean, &mut belief.std);
            golden::assert_near(&belief.mean, &update.mean);
            golden::assert_near(&belief.std, &update.var);
        }
    }

    #[test]
    fn the_first_candidate_is_the_mean() {
        // One iteration from the lowest point: the mean itself must win.
        let bowl = &mut Bowl::of(&[1]);
        bowl.targets[0].iter_mut().for_each(|target| *target *= 0.4);
        let init = bowl.targets[0].clone();
        let cem = Cem { iterations: 1, ..small() };
        let plan = solve(&cem, bowl, &[Key::new(0)], Some(&init)).expect("a plan");
        assert_eq!(plan.costs, [0.0]);
        assert_eq!(plan.trace[0].best, [0.0]);
    }

    #[test]
    fn wrong_settings_and_costs_say_so() {
        let keys = [Key::new(0), Key::new(1)];
        let message = |cem: Cem, wrong| {
            let mut bowl = Bowl { wrong, ..Bowl::of(&[0, 1]) };
            solve(&cem, &mut bowl, &keys, None).expect_err("wrong").to_string()
        };
        assert!(message(Cem { elites: 65, ..small() }, None).contains("65 of 64 samples"));
        assert!(message(Cem { elites: 1, ..small() }, None).contains("at least 2"));
        assert!(message(Cem { iterations: 0, ..small() }, None).contains("iterations"));
        assert!(message(Cem { sigma: f32::NAN, ..small() }, None).contains("sigma"));
        for cost in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            let message = message(small(), Some((1, 17, cost)));
            assert!(message.contains("candidate 17 of planned environment 1 in iteration 0"), "{message}");
        }
        let wrong_init = solve(&small(), &mut Bowl::of(&[0, 1]), &keys, Some(&[0.0; 5])).expect_err("short");
        assert!(wrong_init.to_string().contains("5 numbers"), "{wrong_init}");
        let (low, high) = (&[0.0; DIM][..], &[1.0; DIM][..]);
        let space = PlanSpace::Continuous { low, high };
        let empty = PlanProblem { horizon: 0, space, keys: &keys, init: None, deadline: None };
        let message = small().solve(&mut Bowl::of(&[0, 1]), empty).expect_err("nothing to plan").to_string();
        assert!(message.contains("horizon"), "{message}");
    }
}
