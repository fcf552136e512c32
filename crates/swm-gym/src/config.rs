//! [`GymConfig`]: the Python interpreter of worker processes and their timeouts.

use crate::assets;
use std::ffi::OsString;
use std::path::PathBuf;
use std::process::Command;
use std::time::Duration;

/// The Python interpreter of worker processes and their timeouts.
#[derive(Clone, Debug)]
pub struct GymConfig {
    /// The interpreter, with Gymnasium and the environment's package installed.
    pub python: Python,
    /// The timeout for making an environment: imports, compilation, a first reset and step.
    pub start_timeout: Duration,
    /// The timeout of a reset, a step or a frame.
    pub call_timeout: Duration,
    /// The maximum number of lost workers that are replaced within one request.
    pub restarts: usize,
}

impl Default for GymConfig {
    /// Half an hour to start (Craftax builds textures and compiles the first time) or `$SWM_GYM_START_TIMEOUT` seconds, a
    /// minute or `$SWM_GYM_TIMEOUT` seconds per call, two restarts.
    fn default() -> Self {
        let timeout = |name: &str, default: f64| {
            let seconds = std::env::var(name).ok().and_then(|text| text.parse().ok());
            Duration::from_secs_f64(seconds.filter(|given: &f64| *given > 0.0 && *given < 1e9).unwrap_or(default))
        };
        Self {
            python: Python::find(),
            start_timeout: timeout("SWM_GYM_START_TIMEOUT", 1800.0),
            call_timeout: timeout("SWM_GYM_TIMEOUT", 60.0),
            restarts: 2,
        }
    }
}

/// The origin of a Python that the user named.
const NAMED: &str = "named by $SWM_PYTHON";

/// A Python interpreter.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Python {
    /// The path of the program, or its name on the search path.
    pub program: PathBuf,
    /// The origin of the interpreter, for messages.
    pub origin: &'static str,
}

impl Python {
    /// `$SWM_PYTHON` if set, else the interpreter that `swm assets install` made, else as [`Python::of_user`].
    pub fn find() -> Self {
        let program = assets::python();
        let installed = || program.is_file().then_some(Self { program, origin: "made by `swm assets install`" });
        Self::named().or_else(installed).unwrap_or_else(Self::of_user)
    }

    /// `$SWM_PYTHON` if set, else the interpreter that runs this program, as the `swm` of the Python package says, else `python3` on
    /// the path.
    pub fn of_user() -> Self {
        let own = || Some(Self { program: variable("SWM_OWN_PYTHON")?.into(), origin: "which runs this program" });
        let on_path = || Self { program: "python3".into(), origin: "found on the path" };
        Self::named().or_else(own).unwrap_or_else(on_path)
    }

    fn named() -> Option<Self> {
        Some(Self { program: variable("SWM_PYTHON")?.into(), origin: NAMED })
    }
}

/// Returns the value of a variable of the environment, if it is set and not empty.
fn variable(name: &str) -> Option<OsString> {
    std::env::var_os(name).filter(|value| !value.is_empty())
}

/// `python -c` puts the current folder first, where a stranger's `json.py` would replace a module of the standard library. The
/// option `-P` leaves it out, but Python 3.10 does not know it.
const WITHOUT_CURRENT_FOLDER: &str = "import sys\nif sys.path[:1] == ['']:\n    del sys.path[0]\n";

impl Python {
    /// Returns a command that runs a program, to which arguments can be added. The program finds the modules of the installation
    /// and of `PYTHONPATH`, and none of the current folder. Every Python that this program starts is started so.
    pub fn script(&self, program: &str) -> Command {
        let mut command = Command::new(&self.program);
        command.arg("-c").arg(format!("{WITHOUT_CURRENT_FOLDER}{program}"));
        command
    }

    /// Returns a command that runs a module, as `python -m`, but finds no modules of the current folder.
    pub fn module(&self, name: &str) -> Command {
        self.script(&format!("import runpy\nrunpy.run_module('{name}', run_name='__main__', alter_sys=True)\n"))
    }

    /// Returns an instruction for installing one of the [`assets::PACKAGES`].
    pub(crate) fn fix(&self, asset: &str) -> String {
        if self.origin == NAMED {
            return format!(
                "install the package in this Python, or unset $SWM_PYTHON and run `swm assets install {asset}`"
            );
        }
        format!("run `swm assets install {asset}`, or set $SWM_PYTHON to a Python that has the package")
    }
}

impl std::fmt::Display for Python {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} ({})", self.program.display(), self.origin)
    }
}
