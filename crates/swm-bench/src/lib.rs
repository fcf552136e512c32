//! Benchmarks: steps, frames, clips, plans and training steps per second.
//!
//! Every benchmark compares with the reference implementation where `SWM_REFERENCE_PYTHON` names a Python that has it
//! ([`REFERENCE_PYTHON`]). The drivers of the reference are Python scripts in `reference/`, run as a process.
//!
//! Measurements of both sides alternate within one run, so that both are subject to the same load of the machine. The
//! reported figure is the median over the ratios of successive measurements: ratios are reproducible on a shared
//! machine, absolute rates are not.

mod data;
mod envs;
mod model;
mod plan;
mod reference;
mod render;

pub use data::{DataBenchConfig, DataBenchReport, DataBenchRow, bench_data};
pub use envs::{BenchConfig, BenchReport, BenchRow, bench_envs};
pub use model::{ModelBenchConfig, ModelBenchReport, ModelBenchRow, Subject, Work, bench_model};
pub use plan::{PlanBenchConfig, PlanBenchReport, PlanBenchRow, bench_plan};
pub use reference::REFERENCE_PYTHON;
pub use render::{Drawing, RenderBenchConfig, RenderRow, bench_render};
