//! [`GymConfig`]: which Python runs environments, and how patient one is with them.

use crate::assets;
use std::path::PathBuf;
use std::time::Duration;

/// Which Python runs environments, and how patient one is with them.
#[derive(Clone, Debug)]
pub struct GymConfig {
    /// The Python that has Gymnasium and the environment's package.
    pub python: Python,
    /// How long an environment may take to be made: imports, compilation, a first reset and step.
    pub start: Duration,
    /// How long a reset, a step or a picture may take.
    pub answer: Duration,
    /// How often a lost worker is replaced within one request.
    pub restarts: usize,
}

impl Default for GymConfig {
    /// Half an hour to start (at its first, Craftax makes textures and compiles), a minute for an answer or as many seconds
    /// as `$SWM_GYM_TIMEOUT` says, two restarts.
    fn default() -> Self {
        let seconds = std::env::var("SWM_GYM_TIMEOUT").ok().and_then(|text| text.parse().ok());
        let seconds = seconds.filter(|seconds: &f64| *seconds > 0.0 && *seconds < 1e9).unwrap_or(60.0);
        Self {
            python: Python::find(),
            start: Duration::from_secs(1800),
            answer: Duration::from_secs_f64(seconds),
            restarts: 2,
        }
    }
}

/// Why a Python that the user named is the one.
const NAMED: &str = "named by $SWM_PYTHON";

/// A Python interpreter.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Python {
    /// The program.
    pub program: PathBuf,
    /// Why this one.
    pub whence: &'static str,
}

impl Python {
    /// `$SWM_PYTHON` if that is set, else the one that `swm assets install` made, else `python3` on the path.
    pub fn find() -> Self {
        if let Some(program) = std::env::var_os("SWM_PYTHON").filter(|value| !value.is_empty()) {
            return Self { program: program.into(), whence: NAMED };
        }
        let program = assets::python();
        if program.is_file() {
            return Self { program, whence: "made by `swm assets install`" };
        }
        Self { program: "python3".into(), whence: "found on the path" }
    }
}

impl Python {
    /// What brings one of our packages.
    pub(crate) fn fix(&self, asset: &str) -> String {
        if self.whence == NAMED {
            return format!("install it there, or unset $SWM_PYTHON and say `swm assets install {asset}`");
        }
        format!("`swm assets install {asset}` brings it; or name a Python that has it in $SWM_PYTHON")
    }
}

impl std::fmt::Display for Python {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} ({})", self.program.display(), self.whence)
    }
}
