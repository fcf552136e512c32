//! Tests of Gymnasium environments in worker processes.
//!
//! They require the variable `$SWM_PYTHON`, the path of a Python with Gymnasium. Without the variable they are skipped
//! with a message; with a Python that lacks Gymnasium they fail.

mod atari;
mod dataset_start;
mod describing;
mod hostile;
mod parents;
mod play;
mod robust;
mod spaces;

use std::path::PathBuf;
use std::time::Duration;
use swm_core::Origin;
use swm_gym::{GymConfig, Python, TrustedId};

/// The configuration of the tests; `None` skips the test.
fn config() -> Option<GymConfig> {
    let program = std::env::var_os("SWM_PYTHON").filter(|value| !value.is_empty());
    let Some(program) = program else {
        skip("$SWM_PYTHON names no Python with Gymnasium");
        return None;
    };
    Some(GymConfig {
        python: Python { program: PathBuf::from(program), origin: "named by $SWM_PYTHON" },
        start_timeout: Duration::from_secs(1800),
        call_timeout: Duration::from_secs(60),
        restarts: 2,
    })
}

/// An id that the user chose.
fn id(text: &str) -> TrustedId {
    TrustedId::new(text, &Origin::User).expect(text)
}

/// Returns whether the Python of the tests can import a module.
fn can_import(config: &GymConfig, module: &str) -> bool {
    let program = &config.python.program;
    let status = std::process::Command::new(program).args(["-c", &format!("import {module}")]).output();
    let found = status.expect("$SWM_PYTHON starts").status.success();
    if !found {
        skip(&format!("{} has no {module}", program.display()));
    }
    found
}

#[allow(clippy::print_stderr, reason = "a skipped test must be visible")]
fn skip(why: &str) {
    eprintln!("skipped: {why}");
}
