//! Every random draw is keyed, so the plan of an environment has the same bytes on any number of threads and for any
//! set of environments planned in the same call.

use crate::solvers::{solves, trial};
use crate::toys::{Model, TOYS, Toy, solve};
use swm_core::{Plan, PlanTrace};
use swm_plan::{SOLVERS, SolverEntry};

/// The bits of actions, costs and trace of each environment.
pub fn bits(plan: &Plan, envs: usize) -> Vec<Vec<u32>> {
    let len = plan.actions.len() / envs;
    let trace =
        |PlanTrace { best, mean, spread, violation, .. }: &PlanTrace| [&best[..], mean, spread, violation].concat();
    let env =
        |env: usize| [&plan.actions[env * len..][..len], &plan.costs[env..=env], &trace(&plan.trace[env])].concat();
    (0..envs).map(|i| env(i).into_iter().map(f32::to_bits).collect()).collect()
}

fn plan(row: &SolverEntry, toy: &'static Toy, envs: &[usize]) -> Vec<Vec<u32>> {
    let settings = serde_json::from_str(trial(row.id).short).expect("parsing the settings");
    let mut solver = (row.make)(&settings).expect("creating the solver");
    bits(&solve(&mut *solver, &mut Model::new(toy, envs), toy, envs).expect("the solver returns a plan"), envs.len())
}

/// The first toy a solver can solve.
pub fn toy_for(row: &SolverEntry) -> &'static Toy {
    TOYS.iter().find(|toy| solves(row, toy)).expect("a toy for this solver")
}

#[test]
fn plans_do_not_depend_on_batches_or_threads() {
    let envs: Vec<usize> = (0..50).collect();
    for row in SOLVERS.rows {
        let run = |threads, size| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("creating the thread pool");
            pool.install(|| envs.chunks(size).flat_map(|envs| plan(row, toy_for(row), envs)).collect::<Vec<_>>())
        };
        let alone = run(1, 1);
        for (threads, size) in [(2, 1), (1, 7), (2, 7), (1, 50), (2, 50)] {
            assert!(run(threads, size) == alone, "{}: {size} environments on {threads} threads", row.id);
        }
        assert!(alone[0] != alone[1], "{}: different environments have different plans", row.id);
    }
}

#[test]
fn plans_do_not_depend_on_other_environments() {
    for row in SOLVERS.rows {
        let toy = toy_for(row);
        let [first, second] = [[3, 11, 40], [27, 8, 11]].map(|envs| plan(row, toy, &envs));
        assert!(first[1] == second[2], "{}", row.id);
    }
}
