//! `swm assets`: what worlds need that belongs to others: libraries, models, meshes, Python packages.

use super::{complain, emit, emit_json, table};
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
    /// List what can be installed, and what is (what `swm assets` alone does)
    List,
    /// Fetch, check and unpack; Python packages go into an environment of ours
    Install(Names),
    /// Read every installed file and compare it with what was installed
    Verify(Names),
}

#[derive(Args)]
struct Names {
    /// Which ones, such as mujoco or ale (default for `install`: what 3-D worlds need; for `verify`: what is installed)
    names: Vec<String>,
}

/// Something of others.
#[derive(Clone, Copy)]
enum Thing {
    /// Files that our own worlds read.
    Files(&'static Asset),
    /// A Python package for Gymnasium environments.
    Python(&'static Package),
}

impl Thing {
    fn all() -> impl Iterator<Item = Self> {
        ASSETS.iter().map(Self::Files).chain(PACKAGES.iter().map(Self::Python))
    }

    fn get(name: &str) -> Result<Self> {
        let known = || Self::all().map(Self::name);
        Self::all()
            .find(|thing| thing.name() == name)
            .ok_or_else(|| Error::unknown("asset", name, known(), "`swm assets list` lists them"))
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
    /// Those that were named, or the default ones.
    fn chosen(&self, default: impl Fn(Thing) -> bool) -> Result<Vec<Thing>> {
        if self.names.is_empty() {
            return Ok(Thing::all().filter(|thing| default(*thing)).collect());
        }
        self.names.iter().map(|name| Thing::get(name)).collect()
    }
}

/// Lists, installs or verifies assets.
pub fn assets(args: &AssetsArgs, as_json: bool) -> anyhow::Result<()> {
    match args.command.as_ref().unwrap_or(&AssetsCommand::List) {
        AssetsCommand::List => list(as_json),
        AssetsCommand::Install(names) => {
            let mut folders = vec![];
            for thing in names.chosen(|thing| matches!(thing, Thing::Files(_)))? {
                complain(&format!("installing {} {}: {}\n", thing.name(), thing.version(), thing.summary()));
                folders.push(thing.install()?);
            }
            if as_json {
                return emit_json(&folders);
            }
            folders.iter().for_each(|folder| emit(&format!("{}\n", folder.display())));
            Ok(())
        }
        AssetsCommand::Verify(names) => {
            let chosen = names.chosen(Thing::is_installed)?;
            for thing in &chosen {
                thing.verify()?;
            }
            let names: Vec<&str> = chosen.iter().map(|thing| thing.name()).collect();
            if as_json {
                return emit_json(&json!({"sound": names}));
            }
            emit(&match &names[..] {
                [] => "nothing is installed\n".to_owned(),
                names => format!("sound: {}\n", names.join(", ")),
            });
            Ok(())
        }
    }
}

fn list(as_json: bool) -> anyhow::Result<()> {
    if as_json {
        let all = Thing::all().map(|thing| {
            json!({
                "name": thing.name(),
                "version": thing.version(),
                "summary": thing.summary(),
                "installed": thing.is_installed(),
                "folder": thing.folder(),
            })
        });
        return emit_json(&all.collect::<Vec<Value>>());
    }
    let words = |thing: Thing| if thing.is_installed() { "installed" } else { "" };
    let rows = Thing::all()
        .map(|thing| [thing.name(), thing.version(), words(thing), thing.summary()].map(str::to_owned).to_vec());
    emit(&table(&["asset", "version", "", "what for"], rows));
    emit(&format!("they live in {}\n", assets::folder().display()));
    Ok(())
}
