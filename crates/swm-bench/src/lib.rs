//! Benchmarks: steps, frames, clips, plans and training steps per second.
//!
//! Every benchmark except [`bench_render`] compares with the reference implementation if the environment variable
//! `SWM_REFERENCE_PYTHON` ([`REFERENCE_PYTHON`]) names a Python interpreter that has the reference. The Python scripts
//! in `reference/` run the reference in a process.
//!
//! Measurements of this implementation and of the reference alternate within one run, so that the load of the machine
//! affects both measurements in the same way. The reported figure is the median over the ratios of successive
//! measurements, because ratios are reproducible on a shared machine and absolute rates are not.

mod data;
mod envs;
mod formats;
mod model;
mod plan;
mod reference;
mod render;

pub use data::{DataBenchConfig, DataBenchReport, DataBenchRow, bench_data};
pub use envs::{BenchConfig, BenchReport, BenchRow, bench_envs};
pub use formats::{FormatBench, FormatCost};
pub use model::{ModelBenchConfig, ModelBenchReport, ModelBenchRow, Subject, Work, bench_model};
pub use plan::{PlanBenchConfig, PlanBenchReport, PlanBenchRow, bench_plan};
pub use reference::REFERENCE_PYTHON;
pub use render::{Drawing, RenderBenchConfig, RenderRow, bench_render};

use swm_core::{Error, Result};

/// Checks the number and the duration of measurements.
fn check_measurements(pairs: usize, seconds: f64) -> Result<()> {
    if pairs > 0 && seconds > 0.0 && seconds.is_finite() {
        return Ok(());
    }
    let given = format!("{pairs} pairs of measurements of {seconds} seconds");
    Err(Error::config("benchmark", given, "choose at least 1 pair of more than 0 seconds"))
}
