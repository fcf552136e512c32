//! Trainings, collections and evaluations that pages of the lab start: this program in a process of its own.

use crate::cli::{run_record, signals};
use std::ffi::OsString;
use std::path::Path;
use std::process::{Child, Command};
use swm_core::{Error, Result};
use swm_lab::processes::{Family, Program};
use swm_models::FAMILIES;

/// Starts this program.
pub struct OwnProgram;

impl Program for OwnProgram {
    fn families(&self) -> Vec<Family> {
        let on_data = FAMILIES.rows.iter().filter(|row| matches!((row.requirements)(), Ok(Some(_))));
        let families = on_data.map(|row| Family {
            id: row.id.to_owned(),
            summary: row.summary.to_owned(),
            presets: row.presets.iter().map(|preset| (preset.id.to_owned(), preset.summary.to_owned())).collect(),
        });
        families.collect()
    }

    fn command(&self, arguments: &[OsString]) -> Result<Command> {
        let program = std::env::current_exe().map_err(|error| Error::external("finding this program", error))?;
        let mut command = Command::new(program);
        command.args(arguments);
        signals::react_to_interrupts(&mut command);
        Ok(command)
    }

    #[allow(unsafe_code, reason = "sending a signal is a function of the C library")]
    fn interrupt(&self, process: &Child) -> Result<()> {
        let failed = |error| Error::external("stopping a process", error);
        let id = libc::pid_t::try_from(process.id()).map_err(|error| Error::external("stopping a process", error))?;
        // SAFETY: `kill` reads no memory of ours. The process is a child that was not waited for, so that its id is its own.
        match unsafe { libc::kill(id, libc::SIGINT) } {
            0 => Ok(()),
            _ => Err(failed(std::io::Error::last_os_error())),
        }
    }

    fn can_continue(&self, output: &Path) -> bool {
        // `swm train --resume` begins a run that has its record and no checkpoint yet.
        run_record::read(output).is_ok()
    }
}
