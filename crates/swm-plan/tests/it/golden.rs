//! Golden test: every iteration of a short search by every solver equals `tests/golden/plans.json`.
//!
//! Published results depend on these values, so changing them is a breaking change. After an intended change,
//! `BLESS=1 cargo test --release -p swm-plan golden` rewrites the file.

use crate::solvers::{solves, trial};
use crate::toys::{Model, TOYS, solve};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;
use swm_core::Plan;
use swm_plan::{SOLVERS, SolverEntry};

/// The plan of one environment and the trace of its search, rounded to six digits.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Golden {
    toy: String,
    actions: Vec<f64>,
    best: Vec<f64>,
    mean: Vec<f64>,
    spread: Vec<f64>,
}

/// The toys in order of preference: the test of a solver uses the first toy that the solver can solve.
const PREFERRED: [&str; 4] = ["multi-modal", "discrete", "constrained", "reach-bounded"];

const ENV: usize = 4;

fn short_search(row: &SolverEntry) -> Golden {
    let toys = PREFERRED.iter().flat_map(|name| TOYS.iter().filter(move |toy| toy.name == *name));
    let toy = toys.into_iter().find(|toy| solves(row, toy)).expect("a toy for this solver");
    let settings = serde_json::from_str(trial(row.id).short).expect("parsing the settings");
    let mut solver = (row.make)(&settings).expect("creating the solver");
    let plan = solve(&mut *solver, &mut Model::new(toy, &[ENV]), toy, &[ENV]).expect("the solver returns a plan");
    let Plan { actions, trace, .. } = plan;
    let round =
        |values: &[f32]| values.iter().map(|v| format!("{v:.5e}").parse().expect("parsing a rounded value")).collect();
    Golden {
        toy: toy.name.to_owned(),
        actions: round(&actions),
        best: round(&trace[0].best),
        mean: round(&trace[0].mean),
        spread: round(&trace[0].spread),
    }
}

#[test]
fn iterations_equal_golden_plans() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden/plans.json");
    let ours: BTreeMap<&str, Golden> = SOLVERS.rows.iter().map(|row| (row.id, short_search(row))).collect();
    if std::env::var_os("BLESS").is_some() {
        std::fs::write(&path, serde_json::to_string_pretty(&ours).expect("serialising to JSON") + "\n")
            .expect("the file is written");
    }
    let text = std::fs::read_to_string(&path).expect("reading the golden plans");
    let published: BTreeMap<String, Golden> = serde_json::from_str(&text).expect("parsing the golden plans");
    assert!(ours.keys().eq(published.keys()), "BLESS=1 adds a new solver");
    for (ours, (solver, published)) in ours.values().zip(&published) {
        assert_eq!(ours.toy, published.toy, "{solver}");
        for (what, ours, published) in [
            ("actions", &ours.actions, &published.actions),
            ("best", &ours.best, &published.best),
            ("mean", &ours.mean, &published.mean),
            ("spread", &ours.spread, &published.spread),
        ] {
            assert_eq!(ours.len(), published.len(), "{solver}: {what}");
            for (i, (ours, published)) in ours.iter().zip(published).enumerate() {
                // The system's `exp` and `cos`, used by some solvers and toys, may differ in the last bit.
                let tolerance = 1e-4 * (1.0 + published.abs());
                assert!((ours - published).abs() < tolerance, "{solver}: {what} {i} is {ours}, was {published}");
            }
        }
    }
}
