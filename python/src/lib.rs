//! The Python extension module `stable_worldmodel._engine`: thin bindings, one concept per file. Users call the Python
//! package `stable_worldmodel`; this module is private to it.
//!
//! - [`errors`]: engine errors as Python exceptions, and signal handling; [`warnings`]: the engine's warnings.
//! - [`exit`]: the end of the interpreter.
//! - [`arrays`]: batches as numpy arrays, and back.
//! - [`world`], [`policy`]: batches of environments and the policies that act in them.
//! - [`cost`], [`solver`], [`model`]: models implemented in Python, planning, and the engine's checkpoints.
//! - [`data`]: datasets, the loader, the replay buffer, conversion.
//! - [`gym`]: third-party Gymnasium environments in this interpreter.
//! - [`env`](mod@env), [`frames`]: a single environment, and visual wrappers, for Gymnasium; videos.
//! - [`listing`]: the engine's registries, and the command line.
//! - [`study`]: the results of studies.
//! - [`objects`]: small files of runs that several machines share.
//! - [`training`]: training outside the engine.

mod arrays;
mod cost;
mod data;
mod env;
mod errors;
mod exit;
mod frames;
mod gym;
mod held;
mod listing;
mod model;
mod objects;
mod observer;
mod policy;
mod snapshots;
mod solver;
mod study;
mod training;
mod warnings;
mod world;

use pyo3::prelude::*;
use std::path::PathBuf;

/// The extension module `stable_worldmodel._engine`.
#[pymodule]
mod _engine {
    #[pymodule_export]
    use super::data::dataset::Dataset;
    #[pymodule_export]
    use super::data::loader::{Epoch, Loader, end_loaders};
    #[pymodule_export]
    use super::data::replay::{ReplayBuffer, ReplaySampler};
    #[pymodule_export]
    use super::data::tools::{
        check_replacement, convert, detect, doctor, find_dataset, has_no_dataset, inspect, pinned_dataset, recover,
        target, warning_of_starts,
    };
    #[pymodule_export]
    use super::data::writer::Writer;
    #[pymodule_export]
    use super::env::NativeEnv;
    #[pymodule_export]
    use super::exit::{end_calls, forget_calls};
    #[pymodule_export]
    use super::frames::{VisualWrappers, schedule, write_video};
    #[pymodule_export]
    use super::gym::bridge;
    #[pymodule_export]
    use super::listing::{command, envs, formats, home, solvers, spec, wrappers};
    #[pymodule_export]
    use super::model::Model;
    #[pymodule_export]
    use super::objects::{cpu_level, object_list, object_read, object_write, object_write_new};
    #[pymodule_export]
    use super::policy::Actor;
    #[pymodule_export]
    use super::solver::{check_plan, solve};
    #[pymodule_export]
    use super::study::{studies, study_export, study_results};
    #[pymodule_export]
    use super::training::{begin_training, record, save_checkpoint, training_config};
    #[pymodule_export]
    use super::world::World;

    use super::*;
    use swm::models::run_folder::{FOLDER, OLD_FOLDER};

    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        let _call = exit::Call::begin();
        if module.py().import("stable_worldmodel._exit")?.getattr("check_thread")?.call0()?.extract()? {
            exit::begin_end();
        }
        data::process::record_process();
        warnings::collect();
        let finder = module.py().import("stable_worldmodel._zoo")?;
        if let Some(folder) = finder.getattr("data_wheel")?.call0()?.extract::<Option<PathBuf>>()? {
            swm::zoo::set_data_wheel(folder);
        }
        module.add("CHECKPOINT_FOLDERS", [FOLDER, OLD_FOLDER])?;
        module.add("__version__", env!("CARGO_PKG_VERSION"))
    }
}
