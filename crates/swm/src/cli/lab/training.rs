//! Trainings that pages of the lab start: this program as `swm train`, in a process of its own.

use crate::cli::{run_record, signals};
use std::path::Path;
use std::process::{Child, Command};
use swm_core::{Error, Result};
use swm_lab::trainings::{Family, Request, Training};
use swm_models::FAMILIES;

/// About how many points the curve of a training has.
const POINTS: usize = 200;

/// Starts this program.
pub struct OwnProgram {
    /// Threads of a training; 0 for one per core.
    pub threads: usize,
}

impl Training for OwnProgram {
    fn families(&self) -> Vec<Family> {
        let on_data = FAMILIES.rows.iter().filter(|row| matches!((row.requirements)(), Ok(Some(_))));
        let families = on_data.map(|row| Family {
            id: row.id.to_owned(),
            summary: row.summary.to_owned(),
            presets: row.presets.iter().map(|preset| (preset.id.to_owned(), preset.summary.to_owned())).collect(),
        });
        families.collect()
    }

    fn command(&self, request: &Request, data: &Path, output: &Path) -> Result<Command> {
        let program = std::env::current_exe().map_err(|error| Error::external("finding this program", error))?;
        let mut command = Command::new(program);
        command
            .args(["train", &request.family, "--preset", &request.preset, "--data"])
            .arg(data)
            .arg("--output")
            .arg(output);
        if self.threads > 0 {
            command.arg("--threads").arg(self.threads.to_string());
        }
        let every = (request.steps / POINTS).max(1);
        command.args([
            format!("schedule.steps={}", request.steps),
            format!("seed={}", request.seed),
            format!("log_every={every}"),
        ]);
        signals::react_to_interrupts(&mut command);
        Ok(command)
    }

    #[allow(unsafe_code, reason = "sending a signal is a function of the C library")]
    fn interrupt(&self, process: &Child) -> Result<()> {
        let failed = |error| Error::external("stopping a training", error);
        let id = libc::pid_t::try_from(process.id()).map_err(|error| Error::external("stopping a training", error))?;
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
