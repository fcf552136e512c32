//! Success rates of planners with perfect dynamics: an upper bound for every model, and a measure of the search without
//! model errors.
//!
//!     cargo run --release -p swm-plan --example simulator [PART OF A TASK] [SOLVER] [STARTS] [SETTINGS]
//!
//! A task is an environment and the origin of its starts, such as `PushT` or `paper-speed`. A start that is already solved is
//! counted separately and not played. SETTINGS is JSON that overrides the settings in `rows.rs`, as in
//! `{"solver": {"samples": 100}, "mpc": {"horizon": 3}}`.

mod play;
mod rows;

use play::{play, starts};
use serde_json::Value;
use std::io::Write as _;

/// The default number of starts of each row.
const STARTS: usize = 100;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let filter = |i: usize| arguments.get(i).map_or(String::new(), |text| text.to_lowercase());
    let (env, solver) = (filter(0), filter(1));
    let n = arguments.get(2).map_or(Ok(STARTS), |text| text.parse())?;
    let changes: Value = arguments.get(3).map_or(Ok(Value::Null), |text| serde_json::from_str(text))?;
    let mut out = std::io::stdout();
    writeln!(
        out,
        "| environment | starts | solver | solved at start | success | 95 % | median steps | median time per plan | total time | failed by |"
    )?;
    writeln!(out, "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |")?;
    let name = |task: &rows::Task| format!("{} {:?}", task.entry.id, task.protocol).to_lowercase();
    for task in rows::TASKS.iter().filter(|task| name(task).contains(&env)) {
        let starts = starts(task.entry, task.protocol, n)?;
        for id in rows::SOLVERS.into_iter().filter(|id| solver.is_empty() || *id == solver) {
            let planner = rows::planner(task, id, &changes)?;
            let found = play(task, &starts, &planner)?;
            let success = &found.success;
            writeln!(
                out,
                "| `{}` | {:?} | `{id}` | {} | {} of {} | {:.1}–{:.1} % | {:.0} | {:.2} s | {:.0} s | {} |",
                task.entry.id,
                task.protocol,
                found.solved_at_start,
                success.successes,
                success.n,
                100.0 * success.low,
                100.0 * success.high,
                found.steps.map_or(f64::NAN, |steps| steps.median),
                found.plan.map_or(f64::NAN, |plan| plan.median),
                found.seconds,
                found.violated.iter().map(|(part, count)| format!("{part} {count}")).collect::<Vec<_>>().join(", "),
            )?;
            out.flush()?;
        }
    }
    Ok(())
}
