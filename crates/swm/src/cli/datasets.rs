//! `swm datasets`, `swm formats` and `swm preview`: list datasets and formats, commit shards, write previews.

use super::progress::{StageDisplay, print_summary};
use super::{as_texts, emit, emit_json, table};
use crate::home::{names_in, open_dataset as open};
use crate::{collect_target, data, home};
use clap::{Args, Subcommand};
use serde_json::{Value, json};
use std::path::PathBuf;
use swm_core::Result;
use swm_data::Reader;
use swm_data::lance::commit_shards;

/// Arguments of `swm preview`.
#[derive(Args)]
pub struct PreviewArgs {
    /// The dataset: a path or a name
    dataset: String,
    /// Folder of the videos and the contact sheet
    #[arg(short, long, default_value = "preview", value_name = "DIR")]
    output: PathBuf,
    /// Number of episodes, spread over the dataset
    #[arg(long, default_value_t = 4)]
    episodes: usize,
    /// A column of images, depth or segmentation; may be repeated (default: all)
    #[arg(long)]
    column: Vec<String>,
    /// Frames per second of the videos
    #[arg(long, default_value_t = 15)]
    fps: u32,
}

/// Arguments of `swm datasets`.
#[derive(Args)]
pub struct DatasetsArgs {
    #[command(subcommand)]
    command: Option<DatasetsCommand>,
}

#[derive(Subcommand)]
enum DatasetsCommand {
    /// Commit the shards that `swm collect --shard` wrote
    #[command(after_help = "Example: swm datasets commit rooms")]
    Commit {
        /// The dataset: a path, a URI or a name
        dataset: String,
        /// Permit shards with frames of different renderers
        #[arg(long)]
        mix_renderers: bool,
    },
}

/// Lists the datasets in the home folder, or commits shards.
pub fn datasets(args: &DatasetsArgs, as_json: bool) -> anyhow::Result<()> {
    match &args.command {
        Some(DatasetsCommand::Commit { dataset, mix_renderers }) => commit(dataset, *mix_renderers, as_json),
        None => list(as_json),
    }
}

/// Commits the shards of a dataset.
fn commit(dataset: &str, mix_renderers: bool, as_json: bool) -> anyhow::Result<()> {
    let location = home::location(dataset)?;
    collect_target::check_shards(&location, mix_renderers)?;
    let added = commit_shards(&location)?;
    if as_json {
        return emit_json(&json!({"dataset": location.to_string(), "added": added}));
    }
    emit(&format!("{added} episodes added to {location}\n"));
    Ok(())
}

/// Lists the datasets in the home folder.
fn list(as_json: bool) -> anyhow::Result<()> {
    let folder = home::datasets()?;
    let summaries: Vec<Value> = names_in(&folder)
        .into_iter()
        .map(|name| match open(&name).and_then(|reader| summary(&*reader)) {
            Ok(mut found) => {
                found["name"] = json!(name);
                found
            }
            Err(error) => json!({"name": name, "error": error.to_string()}),
        })
        .collect();
    if as_json {
        return emit_json(&summaries);
    }
    if summaries.is_empty() {
        emit(&format!("no datasets in {}; `swm collect ENV -o NAME` collects one\n", folder.display()));
        return Ok(());
    }
    let text = |value: &Value| value.as_str().map_or_else(|| value.to_string(), str::to_owned);
    let rows = summaries.iter().map(|found| match found.get("error") {
        Some(error) => vec![text(&found["name"]), text(error)],
        None => vec![
            text(&found["name"]),
            text(&found["env"]),
            text(&found["episodes"]),
            text(&found["steps"]),
            bytes(found["bytes"].as_u64().unwrap_or_default()),
        ],
    });
    emit(&table(&["dataset", "environment", "episodes", "steps", "on disk"], rows));
    Ok(())
}

/// Lists the dataset formats.
pub fn formats(as_json: bool) -> anyhow::Result<()> {
    let rows = data::FORMATS.rows.iter();
    if as_json {
        return emit_json(
            &rows
                .map(|format| json!({"id": format.id, "summary": format.summary, "suffixes": format.suffixes}))
                .collect::<Vec<_>>(),
        );
    }
    emit(&table(&["format", "description"], rows.map(|format| vec![format.id.to_owned(), format.summary.to_owned()])));
    Ok(())
}

/// Returns the environment and the counts of episodes, steps and bytes, without reading rows.
pub fn summary(reader: &dyn Reader) -> Result<Value> {
    let manifest = reader.manifest();
    Ok(json!({
        "env": manifest.as_ref().map_or("?", |m| m.config["env"].as_str().unwrap_or("?")),
        "episodes": reader.episodes().len(),
        "steps": reader.episodes().iter().map(|episode| episode.length).sum::<usize>(),
        "bytes": reader.footprint()?.iter().map(|(_, bytes)| bytes).sum::<u64>(),
    }))
}

/// Writes a video of each previewed episode, and a contact sheet of these episodes.
pub fn preview(args: &PreviewArgs, as_json: bool) -> anyhow::Result<()> {
    let reader = open(&args.dataset)?;
    let episodes = args.episodes.min(reader.episodes().len());
    let mut display = StageDisplay::new("preview", String::new(), episodes);
    let options = data::PreviewOptions { episodes, columns: args.column.clone(), fps: args.fps };
    let written = data::preview(&*reader, &args.output, &options, |done| {
        display.update(done, String::new());
    })?;
    drop(display);
    print_summary("preview", &format!("{episodes} episodes in {}", args.output.display()));
    if as_json {
        return emit_json(&json!({"files": as_texts(&written)}));
    }
    emit(&written.iter().map(|path| format!("{}\n", path.display())).collect::<String>());
    Ok(())
}

/// Formats a size in bytes with a binary unit.
pub fn bytes(n: u64) -> String {
    match n {
        0..1024 => format!("{n} B"),
        1024..1_048_576 => format!("{:.1} KiB", n as f64 / 1024.0),
        1_048_576..1_073_741_824 => format!("{:.1} MiB", n as f64 / 1_048_576.0),
        _ => format!("{:.2} GiB", n as f64 / 1_073_741_824.0),
    }
}
