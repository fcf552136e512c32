//! `swm assets`: the third-party libraries, models, meshes and Python packages that environments require.

use super::{as_texts, emit, emit_json, eprint, table};
use clap::{Args, Subcommand};
use serde_json::{Value, json};
use std::path::PathBuf;
use swm_core::{Error, Result};
use swm_gym::assets::{self as python, PACKAGES, Package};
use swm_mujoco::assets::{self, ASSETS, Asset, Status};

/// Arguments of `swm assets`.
#[derive(Args)]
pub struct AssetsArgs {
    #[command(subcommand)]
    command: Option<AssetsCommand>,
}

#[derive(Subcommand)]
enum AssetsCommand {
    /// List all assets (default)
    #[command(after_help = "Example: swm assets list")]
    List,
    /// Download, check and unpack assets
    ///
    /// Python packages are installed into a virtual environment in the assets folder.
    #[command(after_help = "Example: swm assets install mujoco")]
    Install(Names),
    /// Compare every installed file with its recorded hash
    #[command(after_help = "Example: swm assets verify")]
    Verify(Names),
}

#[derive(Args)]
struct Names {
    /// Names of assets, such as mujoco or ale
    ///
    /// Default of `install`: the assets of 3-D environments. Default of `verify`: all installed assets.
    names: Vec<String>,
}

/// A third-party asset.
#[derive(Clone, Copy)]
enum Installable {
    /// Files that built-in environments read.
    Files(&'static Asset),
    /// A Python package for Gymnasium environments.
    Python(&'static Package),
}

impl Installable {
    fn all() -> impl Iterator<Item = Self> {
        ASSETS.iter().map(Self::Files).chain(PACKAGES.iter().map(Self::Python))
    }

    fn get(name: &str) -> Result<Self> {
        let known = || Self::all().map(Self::name);
        Self::all()
            .find(|item| item.name() == name)
            .ok_or_else(|| Error::unknown("asset", name, known(), "`swm assets list` lists the assets"))
    }

    fn name(self) -> &'static str {
        match self {
            Self::Files(asset) => asset.name,
            Self::Python(package) => package.name,
        }
    }

    fn version(self) -> &'static str {
        match self {
            Self::Files(asset) => asset.version,
            Self::Python(package) => package.version,
        }
    }

    fn summary(self) -> &'static str {
        match self {
            Self::Files(asset) => asset.summary,
            Self::Python(package) => package.summary,
        }
    }

    fn folder(self) -> PathBuf {
        match self {
            Self::Files(asset) => asset.folder(),
            Self::Python(package) => package.folder(),
        }
    }

    fn is_installed(self) -> bool {
        match self {
            Self::Files(asset) => asset.status() == Status::Installed,
            Self::Python(package) => package.is_installed(),
        }
    }

    fn install(self) -> Result<PathBuf> {
        match self {
            Self::Files(asset) => assets::install(asset.name),
            Self::Python(package) => python::install(package),
        }
    }

    fn verify(self) -> Result<()> {
        match self {
            Self::Files(asset) => assets::verify(asset.name),
            Self::Python(package) => python::verify(package),
        }
    }
}

impl Names {
    /// Returns the named assets; without names, the assets that `default` accepts.
    fn chosen(&self, default: impl Fn(Installable) -> bool) -> Result<Vec<Installable>> {
        if self.names.is_empty() {
            return Ok(Installable::all().filter(|item| default(*item)).collect());
        }
        self.names.iter().map(|name| Installable::get(name)).collect()
    }
}

/// Lists, installs or verifies assets.
pub fn assets(args: &AssetsArgs, as_json: bool) -> anyhow::Result<()> {
    match args.command.as_ref().unwrap_or(&AssetsCommand::List) {
        AssetsCommand::List => list(as_json),
        AssetsCommand::Install(names) => {
            let mut folders = vec![];
            for item in names.chosen(|item| matches!(item, Installable::Files(_)))? {
                eprint(&format!("installing {} {}: {}\n", item.name(), item.version(), item.summary()));
                folders.push(item.install()?);
            }
            if as_json {
                return emit_json(&as_texts(&folders));
            }
            folders.iter().for_each(|folder| emit(&format!("{}\n", folder.display())));
            Ok(())
        }
        AssetsCommand::Verify(names) => {
            let chosen = names.chosen(Installable::is_installed)?;
            for item in &chosen {
                item.verify()?;
            }
            let names: Vec<&str> = chosen.iter().map(|item| item.name()).collect();
            if as_json {
                return emit_json(&json!({"sound": names}));
            }
            emit(&match &names[..] {
                [] => "nothing is installed\n".to_owned(),
                names => format!("intact: {}\n", names.join(", ")),
            });
            Ok(())
        }
    }
}

fn list(as_json: bool) -> anyhow::Result<()> {
    if as_json {
        let all = Installable::all().map(|item| {
            json!({
                "name": item.name(),
                "version": item.version(),
                "summary": item.summary(),
                "installed": item.is_installed(),
                "folder": item.folder().to_string_lossy(),
            })
        });
        return emit_json(&all.collect::<Vec<Value>>());
    }
    let status = |item: Installable| if item.is_installed() { "installed" } else { "" };
    let rows = Installable::all()
        .map(|item| [item.name(), item.version(), status(item), item.summary()].map(str::to_owned).to_vec());
    emit(&table(&["asset", "version", "status", "purpose"], rows));
    emit(&format!("folder: {}\n", assets::folder().display()));
    Ok(())
}
