//! With perfect dynamics, planners reach their goals. The example `simulator` plays the same tasks from more starts.

#[allow(dead_code, reason = "the example prints times, which are not tested")]
#[path = "../../examples/simulator/play.rs"]
mod play;
#[path = "../../examples/simulator/rows.rs"]
mod rows;

use play::{Outcome, play, starts};
use rows::Task;
use serde_json::Value;

fn run(task: &Task, solver: &'static str, n: usize) -> Outcome {
    let starts = starts(task.entry, task.protocol, n).expect("creating the starts");
    let planner = rows::planner(task, solver, &Value::Null).expect("creating the planner");
    play(task, &starts, &planner).expect("the planner plays the starts")
}

#[test]
fn planning_with_true_dynamics_solves_two_room() {
    for solver in rows::SOLVERS {
        let found = run(&rows::TASKS[0], solver, 40);
        assert!(found.success.rate >= 0.95, "{solver}: {:?}", found.success);
    }
}

#[test]
fn planning_with_true_dynamics_solves_push_t_from_demonstrations() {
    // CEM is not tested here, because it takes five times as long.
    for solver in ["icem", "mppi"] {
        let found = run(&rows::TASKS[1], solver, 5);
        assert!(found.success.rate >= 0.8, "{solver}: {:?}", found.success);
    }
}
