//! The tasks of the example and the settings of the planners.

use super::play::{Planner, Protocol, Violated};
use serde_json::{Value, json};
use std::f64::consts::TAU;
use swm_core::{EnvEntry, Error, Result, RowRef};
use swm_envs::{push_t, two_room};
use swm_plan::{MpcConfig, Score};

/// An environment, the origin of its starts, and the time limit of an episode.
pub struct Task {
    pub entry: &'static EnvEntry,
    pub protocol: Protocol,
    pub budget: usize,
    pub settings: fn(&str) -> Value,
    pub violated: Violated,
}

pub static TASKS: [Task; 3] = [
    Task {
        entry: &two_room::ENTRY,
        protocol: Protocol::Episodic,
        budget: 100,
        settings: two_room,
        violated: |_| Ok(vec!["position"]),
    },
    demonstrated("expert"),
    demonstrated("paper-speed"),
];

/// Push-T from states that an expert visits.
const fn demonstrated(expert: &'static str) -> Task {
    let protocol = Protocol::Demonstrated(expert);
    Task { entry: &push_t::ENTRY, protocol, budget: 50, settings: push_t, violated }
}

/// The parts of Push-T's success criterion: each body within 20 pixels, the block within 20 degrees, and both bodies together
/// within 20 pixels.
fn violated(row: RowRef<'_>) -> Result<Vec<&'static str>> {
    let (state, goal) = (row.to_f64("state")?, row.to_f64("goal_state")?);
    let distance = |at: usize| (state[at] - goal[at]).hypot(state[at + 1] - goal[at + 1]);
    let angle = (state[4] - goal[4]).rem_euclid(TAU);
    let (agent, block, angle) = (distance(0), distance(2), angle.min(TAU - angle).to_degrees());
    let together = agent.hypot(block) >= 20.0 && agent < 20.0 && block < 20.0;
    let parts = [("agent", agent >= 20.0), ("block", block >= 20.0), ("angle", angle >= 20.0), ("both", together)];
    Ok(parts.into_iter().filter(|part| part.1).map(|part| part.0).collect())
}

pub const SOLVERS: [&str; 3] = ["cem", "icem", "mppi"];

/// The settings for `TwoRoom`. A third of the paper's candidates suffices for every solver, because candidates are
/// scored by the time to the goal.
fn two_room(_: &str) -> Value {
    json!({ "score": "reach", "solver": { "samples": 100, "iterations": 10, "elites": 10 } })
}

/// The settings for `PushT`. The horizon is the paper's 25 steps, planned individually, so that noise can be coloured
/// along these steps.
///
/// The search is hard because most candidates do not touch the block, and those that do rarely push it in the right
/// direction. Frequent replanning helps every solver more than a long search, because the spread of CEM collapses
/// around the first push with a lower cost. MPPI keeps its spread, and the coloured noise of iCEM moves in straighter
/// lines than white noise.
fn push_t(solver: &str) -> Value {
    let (solver, receding_horizon) = match solver {
        "cem" => (json!({ "samples": 300, "iterations": 5, "elites": 20, "sigma": 0.7 }), 1),
        "icem" => (json!({ "samples": 300, "iterations": 10, "elites": 30, "sigma": 0.7, "beta": 2.0 }), 5),
        _ => (json!({ "samples": 300, "iterations": 10, "elites": 30, "sigma": 0.4, "temperature": 0.1 }), 5),
    };
    let mpc = json!({ "horizon": 25, "action_block": 1, "receding_horizon": receding_horizon });
    json!({ "score": "reach", "solver": solver, "mpc": mpc })
}

/// The planner of a task and a solver, with `changes` merged into the settings.
pub fn planner(task: &Task, solver: &'static str, changes: &Value) -> Result<Planner> {
    let mut settings = (task.settings)(solver);
    merge(&mut settings, changes);
    let wrong = |error: serde_json::Error| Error::config("settings", error.to_string(), "see `rows.rs` of the example");
    let section = |name: &str| settings.get(name).cloned().filter(|value| !value.is_null());
    Ok(Planner {
        solver,
        settings: section("solver").unwrap_or_else(|| json!({})),
        mpc: section("mpc").map_or(Ok(MpcConfig::default()), |mpc| serde_json::from_value(mpc).map_err(wrong))?,
        score: section("score").map_or(Ok(Score::default()), |score| serde_json::from_value(score).map_err(wrong))?,
    })
}

fn merge(value: &mut Value, changes: &Value) {
    match (value, changes) {
        (Value::Object(value), Value::Object(changes)) => {
            for (key, change) in changes {
                merge(value.entry(key.clone()).or_insert(Value::Null), change);
            }
        }
        (_, Value::Null) => {}
        (value, change) => *value = change.clone(),
    }
}
