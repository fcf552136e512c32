//! The solver `grid`: evaluates constant action sequences on a grid, for one-dimensional actions.

use swm::core::{Candidates, CostModel, Plan, PlanProblem, PlanSpace, Result, Solver};
use swm::plan::{ActionKind, Family, SolverEntry};

pub const ENTRY: SolverEntry = SolverEntry {
    id: "grid",
    summary: "takes the cheapest constant action of a grid",
    family: Family::Sampling,
    actions: ActionKind::Continuous,
    needs: &[],
    paper: "",
    defaults: || serde_json::json!({}),
    make: |_| Ok(Box::new(Grid)),
};

/// Number of grid points.
const SAMPLES: usize = 41;

struct Grid;

impl Solver for Grid {
    fn solve(&mut self, cost: &mut dyn CostModel, problem: PlanProblem<'_>) -> Result<Plan> {
        let PlanSpace::Continuous { low, high } = problem.space else { unreachable!("the actions are continuous") };
        let (envs, horizon, dim) = (problem.keys.len(), problem.horizon, low.len());
        let candidate = |sample: usize| {
            let fraction = sample as f32 / (SAMPLES - 1) as f32;
            let action: Vec<f32> = low.iter().zip(high).map(|(low, high)| low + fraction * (high - low)).collect();
            action.repeat(horizon)
        };
        let grid: Vec<Vec<f32>> = (0..SAMPLES).map(candidate).collect();
        let actions = grid.concat().repeat(envs);
        let mut costs = vec![0.0; envs * SAMPLES];
        cost.cost(Candidates { actions: &actions, envs, samples: SAMPLES, horizon, dim }, &mut costs)?;
        let mut plan = Plan::default();
        for costs in costs.chunks_exact(SAMPLES) {
            let best = (0..SAMPLES).min_by(|&a, &b| costs[a].total_cmp(&costs[b])).unwrap_or(0);
            plan.actions.extend_from_slice(&grid[best]);
            plan.costs.push(costs[best]);
        }
        Ok(plan)
    }
}
