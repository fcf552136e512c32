//! The cost functions of the toys.

use super::{Landscape, draw};

/// A quadratic: `Σ (1 + j / 2) (a_j - target_j)²`, with every value of a plan between -bound and bound.
pub struct Bowl {
    pub target: Vec<f64>,
    pub bound: f64,
}

impl Bowl {
    /// The weights and distances of the terms.
    fn terms<'a>(&'a self, plan: &'a [f64]) -> impl Iterator<Item = (f64, f64)> + 'a {
        plan.iter().zip(&self.target).enumerate().map(|(j, (a, t))| (1.0 + j as f64 / 2.0, a - t))
    }
}

impl Landscape for Bowl {
    fn cost(&self, plan: &[f64]) -> f64 {
        self.terms(plan).map(|(weight, distance)| weight * distance.powi(2)).sum()
    }

    fn gradient(&self, plan: &[f64]) -> Vec<f64> {
        self.terms(plan).map(|(weight, distance)| 2.0 * weight * distance).collect()
    }

    fn optimum(&self) -> Vec<f64> {
        self.target.iter().map(|t| t.clamp(-self.bound, self.bound)).collect()
    }
}

/// A double well in every value, `(a² - 1)² + tilt a`: 2ⁿ minima. In the deepest minimum, all signs are opposite to the
/// tilts.
pub struct Wells {
    pub tilt: Vec<f64>,
}

impl Landscape for Wells {
    fn cost(&self, plan: &[f64]) -> f64 {
        plan.iter().zip(&self.tilt).map(|(a, tilt)| (a * a - 1.0).powi(2) + tilt * a).sum()
    }

    fn gradient(&self, plan: &[f64]) -> Vec<f64> {
        plan.iter().zip(&self.tilt).map(|(a, tilt)| 4.0 * a * (a * a - 1.0) + tilt).collect()
    }

    fn optimum(&self) -> Vec<f64> {
        // Newton's method on the derivative, from the bottom of the untilted well.
        let bottom = |tilt: f64| {
            (0..20).fold(-tilt.signum(), |a, _| a - (4.0 * a * (a * a - 1.0) + tilt) / (12.0 * a * a - 4.0))
        };
        self.tilt.iter().map(|&tilt| bottom(tilt)).collect()
    }
}

/// The squared distance to a target outside the unit ball, constrained to the ball: the optimum is on the sphere. A
/// second constraint, that the first value is at most 3, is never active.
pub struct Ball {
    pub target: Vec<f64>,
}

impl Landscape for Ball {
    fn cost(&self, plan: &[f64]) -> f64 {
        plan.iter().zip(&self.target).map(|(a, t)| (a - t).powi(2)).sum()
    }

    fn gradient(&self, plan: &[f64]) -> Vec<f64> {
        plan.iter().zip(&self.target).map(|(a, t)| 2.0 * (a - t)).collect()
    }

    fn optimum(&self) -> Vec<f64> {
        let norm = self.target.iter().map(|t| t * t).sum::<f64>().sqrt();
        self.target.iter().map(|t| t / norm).collect()
    }

    fn constraints(&self, plan: &[f64]) -> Vec<f64> {
        vec![plan.iter().map(|a| a * a).sum::<f64>() - 1.0, plan[0] - 3.0]
    }

    fn constraint_gradient(&self, plan: &[f64], weights: &[f64]) -> Vec<f64> {
        let mut gradient: Vec<f64> = plan.iter().map(|a| 2.0 * weights[0] * a).collect();
        gradient[0] += weights[1];
        gradient
    }
}

/// Two choices in each step, with a cost for every option and for every pair of options in neighbouring steps, so that
/// the best option depends on the following steps.
pub struct Chain {
    /// `[horizon, dim]`.
    price: Vec<f64>,
    /// `[horizon - 1, dim, dim]`.
    pair: Vec<f64>,
}

impl Chain {
    pub const CHOICES: &[usize] = &[3, 2];
    const DIM: usize = 5;

    pub fn new(env: usize) -> Self {
        let values = draw(env, 3 * Self::DIM + 2 * Self::DIM * Self::DIM, 1.0);
        let (price, pair) = values.split_at(3 * Self::DIM);
        Self { price: price.to_vec(), pair: pair.iter().map(|pair| 0.3 * pair).collect() }
    }

    fn pairs(&self) -> impl Iterator<Item = (usize, usize, f64)> + '_ {
        let dim = Self::DIM;
        self.pair.iter().enumerate().map(move |(i, &price)| {
            let (step, from, to) = (i / (dim * dim), i / dim % dim, i % dim);
            (step * dim + from, (step + 1) * dim + to, price)
        })
    }
}

impl Landscape for Chain {
    fn cost(&self, plan: &[f64]) -> f64 {
        let single: f64 = plan.iter().zip(&self.price).map(|(y, price)| y * price).sum();
        single + self.pairs().map(|(from, to, price)| plan[from] * plan[to] * price).sum::<f64>()
    }

    fn gradient(&self, plan: &[f64]) -> Vec<f64> {
        let mut gradient = self.price.clone();
        for (from, to, price) in self.pairs() {
            gradient[from] += plan[to] * price;
            gradient[to] += plan[from] * price;
        }
        gradient
    }

    fn optimum(&self) -> Vec<f64> {
        // Tries all 6³ sequences.
        let plans = (0..216usize).map(|mut code| {
            let mut plan = vec![0.0; 3 * Self::DIM];
            for step in plan.chunks_exact_mut(Self::DIM) {
                step[code % 3] = 1.0;
                step[3 + code / 3 % 2] = 1.0;
                code /= 6;
            }
            plan
        });
        plans.min_by(|a, b| self.cost(a).total_cmp(&self.cost(b))).expect("there is at least one plan")
    }
}

/// A point that moves by its action, `s' = s + a`; the cost is the squared distance to a goal after the last step.
pub struct Reach {
    pub start: Vec<f64>,
    pub goal: Vec<f64>,
    pub bound: f64,
}

impl Reach {
    /// The offset of the last state from the goal.
    fn offset(&self, plan: &[f64]) -> Vec<f64> {
        let dim = self.goal.len();
        (0..dim).map(|j| self.start[j] + plan.iter().skip(j).step_by(dim).sum::<f64>() - self.goal[j]).collect()
    }
}

impl Landscape for Reach {
    fn cost(&self, plan: &[f64]) -> f64 {
        self.offset(plan).iter().map(|offset| offset * offset).sum()
    }

    fn gradient(&self, plan: &[f64]) -> Vec<f64> {
        let offset = self.offset(plan);
        (0..plan.len()).map(|j| 2.0 * offset[j % offset.len()]).collect()
    }

    fn optimum(&self) -> Vec<f64> {
        let step = |j: usize| ((self.goal[j] - self.start[j]) / 3.0).clamp(-self.bound, self.bound);
        (0..6).map(|j| step(j % 2)).collect()
    }

    fn is_unique(&self) -> bool {
        // Many plans end at a goal that is within reach.
        self.cost(&self.optimum()) > 1e-12
    }

    fn system(&self) -> Option<&Reach> {
        Some(self)
    }
}
