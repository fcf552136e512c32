//! The Python extension `stable_worldmodel._engine`: thin bindings, a file a concept. What users see is the Python package
//! beside this crate; nothing here is meant to be called by them.
//!
//! - [`errors`]: what goes wrong, as Python's exceptions; signals.
//! - [`arrays`]: batches as numpy arrays, and back.
//! - [`world`], [`policy`]: many environments at once and who acts in them.
//! - [`cost`], [`solver`], [`model`]: models of Python's to plan in, planning, models of our own.
//! - [`data`]: datasets, the loader, the replay buffer, conversion.
//! - [`gym`]: environments of others, in this interpreter.
//! - [`env`](mod@env), [`pictures`]: one environment, and visual wrappers, for Gymnasium.

mod arrays;
mod cost;
mod data;
mod env;
mod errors;
mod gym;
mod listing;
mod model;
mod pictures;
mod policy;
mod solver;
mod world;

use pyo3::prelude::*;

/// The engine.
#[pymodule]
mod _engine {
    #[pymodule_export]
    use super::data::dataset::Dataset;
    #[pymodule_export]
    use super::data::loader::{Epoch, Loader, end_loaders};
    #[pymodule_export]
    use super::data::replay::{ReplayBuffer, ReplaySampler};
    #[pymodule_export]
    use super::data::work::{convert, detect, doctor, find_dataset, inspect, target};
    #[pymodule_export]
    use super::data::writer::Writer;
    #[pymodule_export]
    use super::env::NativeEnv;
    #[pymodule_export]
    use super::gym::bridge;
    #[pymodule_export]
    use super::listing::{command, envs, formats, home, solvers, spec, wrappers};
    #[pymodule_export]
    use super::model::Model;
    #[pymodule_export]
    use super::pictures::{Pictures, schedule};
    #[pymodule_export]
    use super::policy::Actor;
    #[pymodule_export]
    use super::solver::solve;
    #[pymodule_export]
    use super::world::World;

    use super::*;

    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        data::process::begin();
        module.add("__version__", env!("CARGO_PKG_VERSION"))
    }
}
