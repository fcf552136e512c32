//! The solvers, one file each, and their list, [`SOLVERS`].
//!
//! Each file holds the settings of the algorithm, its `solve`, and its registry row as `pub const ENTRY`. A new solver
//! is a new file and one line in the list below.

pub mod augmented_lagrangian;
pub mod categorical_cem;
pub mod cem;
pub mod gradient_descent;
pub mod grasp;
pub mod icem;
pub mod mppi;
pub mod pgd;
pub mod predictive_sampling;

pub use augmented_lagrangian::AugmentedLagrangian;
pub use categorical_cem::CategoricalCem;
pub use cem::Cem;
pub use gradient_descent::GradientDescent;
pub use grasp::{Grasp, LinearSchedule};
pub use icem::ICem;
pub use mppi::Mppi;
pub use pgd::Pgd;
pub use predictive_sampling::PredictiveSampling;

use crate::entry::{ActionKind, Need, SolverEntry};
use crate::search::{misfit, offers};
use swm_core::{CostModel, Registry, Result};

/// Every solver.
pub static SOLVERS: Registry<SolverEntry> = Registry {
    kind: "solver",
    hint: "`swm solvers` lists them",
    rows: &[
        predictive_sampling::ENTRY,
        cem::ENTRY,
        icem::ENTRY,
        mppi::ENTRY,
        categorical_cem::ENTRY,
        gradient_descent::ENTRY,
        pgd::ENTRY,
        augmented_lagrangian::ENTRY,
        grasp::ENTRY,
    ],
};

/// Checks that the solver `id` can plan actions of the kind `actions` with the model `cost`.
///
/// # Errors
/// When the id is unknown, or the solver does not fit; the error names the solvers that fit.
pub fn pairing(id: &str, cost: &mut dyn CostModel, actions: ActionKind) -> Result<()> {
    let offers = offers(cost);
    let Some(obstacle) = SOLVERS.get(id)?.obstacle(actions, &offers) else {
        return Ok(());
    };
    let able: Vec<&str> =
        SOLVERS.rows.iter().filter(|row| row.obstacle(actions, &offers).is_none()).map(|row| row.id).collect();
    let fix = match (&able[..], offers.contains(&Need::Constraints)) {
        ([], true) => "add the constraints to the cost as a penalty; then any solver for these actions fits".to_owned(),
        ([], false) => "no solver fits these actions and this model".to_owned(),
        (able, true) => format!("choose {}, or add the constraints to the cost as a penalty", able.join(" or ")),
        (able, false) => format!("choose {}", able.join(" or ")),
    };
    Err(misfit(id, &obstacle, &fix))
}
