//! `swm assets`: what worlds need that belongs to others: libraries, models, meshes.

use super::{complain, emit, emit_json, table};
use clap::{Args, Subcommand};
use serde_json::json;
use swm_mujoco::assets::{self, ASSETS, Status};

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
    /// Fetch, check and unpack
    Install(Names),
    /// Read every installed file and compare it with what was installed
    Verify(Names),
}

#[derive(Args)]
struct Names {
    /// Which ones, such as mujoco (default: all)
    names: Vec<String>,
}

impl Names {
    /// Those that were named, or all.
    fn chosen(&self, among: impl Fn(&assets::Asset) -> bool) -> swm_core::Result<Vec<&'static assets::Asset>> {
        if self.names.is_empty() {
            return Ok(ASSETS.iter().filter(|asset| among(asset)).collect());
        }
        self.names.iter().map(|name| assets::get(name)).collect()
    }
}

/// Lists, installs or verifies assets.
pub fn assets(args: &AssetsArgs, as_json: bool) -> anyhow::Result<()> {
    match args.command.as_ref().unwrap_or(&AssetsCommand::List) {
        AssetsCommand::List => list(as_json),
        AssetsCommand::Install(names) => {
            let mut folders = vec![];
            for asset in names.chosen(|_| true)? {
                complain(&format!("installing {} {}: {}\n", asset.name, asset.version, asset.summary));
                folders.push(assets::install(asset.name)?);
            }
            if as_json {
                return emit_json(&folders);
            }
            folders.iter().for_each(|folder| emit(&format!("{}\n", folder.display())));
            Ok(())
        }
        AssetsCommand::Verify(names) => {
            let chosen = names.chosen(|asset| asset.status() == Status::Installed)?;
            for asset in &chosen {
                assets::verify(asset.name)?;
            }
            let names: Vec<&str> = chosen.iter().map(|asset| asset.name).collect();
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
    let words = |status| if status == Status::Installed { "installed" } else { "" };
    if as_json {
        let all = assets::status().map(|(asset, status)| {
            json!({
                "name": asset.name,
                "version": asset.version,
                "summary": asset.summary,
                "installed": status == Status::Installed,
                "folder": asset.folder(),
            })
        });
        return emit_json(&all.collect::<Vec<_>>());
    }
    let rows = assets::status().map(|(asset, status)| {
        vec![asset.name.to_owned(), asset.version.to_owned(), words(status).to_owned(), asset.summary.to_owned()]
    });
    emit(&table(&["asset", "version", "", "what for"], rows));
    emit(&format!("they live in {}\n", assets::folder().display()));
    Ok(())
}
