//! The pinned Python packages that Gymnasium environments need, in a virtual environment.
//!
//! The virtual environment is the folder `python-gym` in the folder of all assets: `$SWM_ASSETS`, else
//! `$STABLEWM_HOME/assets`, else `~/.stable_worldmodel/assets`.

use std::path::PathBuf;
use std::process::Command;
use swm_core::{Error, Result};

/// A package and its requirements.
pub struct Package {
    /// The name of the package for `swm assets install`.
    pub name: &'static str,
    /// The pinned version.
    pub version: &'static str,
    /// The purpose of the package, in a few words.
    pub summary: &'static str,
    /// The Python distribution whose metadata shows that the package is installed.
    distribution: &'static str,
    /// The requirements for pip besides Gymnasium.
    requirements: &'static [&'static str],
}

/// Requirements of all packages; pygame renders Gymnasium's own environments.
const GYMNASIUM: &[&str] = &["gymnasium==1.4.0", "pygame==2.6.1"];

/// All packages that can be installed.
pub const PACKAGES: &[Package] = &[
    Package {
        name: "gymnasium",
        version: "1.4.0",
        summary: "Gymnasium and its classic control environments, in a separate virtual environment",
        distribution: "gymnasium",
        requirements: &[],
    },
    Package {
        name: "ale",
        version: "0.12.1",
        summary: "the Arcade Learning Environment: ALE/*",
        distribution: "ale_py",
        requirements: &["ale-py==0.12.1"],
    },
    Package {
        name: "craftax",
        version: "1.6.1",
        summary: "Craftax on JAX: swm/Craftax*",
        distribution: "craftax",
        requirements: &["craftax==1.6.1", "jax==0.10.2"],
    },
];

impl Package {
    /// The folder that the package is installed to.
    pub fn folder(&self) -> PathBuf {
        virtual_environment()
    }

    /// Returns whether the pinned version is installed.
    pub fn is_installed(&self) -> bool {
        let name = format!("{}-{}.dist-info", self.distribution, self.version);
        let Ok(entries) = std::fs::read_dir(virtual_environment().join("lib")) else { return false };
        entries.flatten().any(|entry| entry.path().join("site-packages").join(&name).is_dir())
    }
}

/// The folder of assets, which `swm-mujoco` shares.
pub(crate) fn folder() -> PathBuf {
    swm_core::home::installed_assets()
}

/// The folder of the virtual environment.
fn virtual_environment() -> PathBuf {
    folder().join("python-gym")
}

/// The interpreter of the virtual environment, which may not exist yet.
pub(crate) fn python() -> PathBuf {
    virtual_environment().join("bin").join("python")
}

/// Installs a package with pip and returns the folder of the virtual environment, which this function makes if it does
/// not exist.
///
/// # Errors
/// When Python or pip fails.
pub fn install(package: &Package) -> Result<PathBuf> {
    swm_core::home::assets()?;
    let folder = virtual_environment();
    if !python().is_file() {
        let mut make = Command::new("python3");
        run("making a Python environment with `python3 -m venv`", make.args(["-I", "-m", "venv"]).arg(&folder))?;
    }
    let mut pip = Command::new(python());
    // `-I` keeps modules of the current folder from replacing those of the installation.
    pip.args(["-I", "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]);
    pip.args(GYMNASIUM).args(package.requirements);
    run(&format!("installing {} {} with pip", package.name, package.version), &mut pip)?;
    Ok(folder)
}

/// Checks with pip that a package and its dependencies are installed and compatible.
///
/// # Errors
/// When a package is missing or incompatible.
pub fn verify(package: &Package) -> Result<()> {
    let fix = || format!("run `swm assets install {}`", package.name);
    if !package.is_installed() {
        let what = format!("asset {} {}", package.name, package.version);
        return Err(Error::config(what, format!("it is not installed in {}", virtual_environment().display()), fix()));
    }
    let mut pip = Command::new(python());
    run(
        &format!("checking {} ({})", package.name, fix()),
        pip.args(["-I", "-m", "pip", "check", "--disable-pip-version-check"]),
    )
}

/// Runs a command and waits until it ends.
fn run(what: &str, command: &mut Command) -> Result<()> {
    let output = command.output().map_err(|error| {
        Error::external(what, format!("{error}; Python 3 must be installed (Debian: apt install python3-venv)"))
    })?;
    if output.status.success() {
        return Ok(());
    }
    let printed = [output.stdout, output.stderr].concat();
    Err(Error::external(what, String::from_utf8_lossy(&printed).trim()))
}
