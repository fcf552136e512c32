//! `swm inspect`: shows the contents of a dataset.

use super::capsules::CapsuleInfo;
use super::datasets::{bytes, summary};
use super::{emit, emit_json, eprint, table};
use crate::home::{find_checkpoint, open_dataset};
use crate::metadata::{self, Described, Stated};
use clap::Args;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use swm_core::columns::{REWARD, SUCCESS, is_stored_as};
use swm_core::results::Summary;
use swm_core::text::one_line;
use swm_core::{Error, Manifest, Result};
use swm_data::{Reader, StepRange, checksum, column_stats, frequent_colours};
use swm_models::capsule::Capsule;

/// Arguments of `swm inspect`.
#[derive(Args)]
pub struct InspectArgs {
    /// The dataset: a path, a URI or a name
    dataset: String,
    /// Read all rows and show the checksum of the decoded content
    ///
    /// The checksum does not depend on format and codec.
    #[arg(long)]
    checksum: bool,
    /// Find this number of colours in the frames, the most frequent first
    ///
    /// They are a setting of `swm train --preset colours`, whose images are not normalised. At most 256 frames are read.
    #[arg(long, value_name = "COUNT", value_parser = clap::value_parser!(u16).range(2..=256), conflicts_with_all = ["checksum", "croissant", "datasheet"])]
    colours: Option<u16>,
    /// Print Croissant metadata (JSON-LD), also of a capsule
    ///
    /// Lists all files with their SHA-256 hashes, so all of them are read.
    #[arg(long, conflicts_with_all = ["checksum", "datasheet"])]
    croissant: bool,
    /// Print a datasheet (Markdown), also of a capsule
    ///
    /// What the files do not say is marked as not stated.
    #[arg(long, conflicts_with = "checksum")]
    datasheet: bool,
    /// Licence of the dataset, for its description
    #[arg(long, value_name = "TEXT")]
    licence: Option<String>,
    /// Who made the dataset, for its description
    #[arg(long, value_name = "TEXT")]
    author: Option<String>,
    /// Where it is published, for its description
    #[arg(long, value_name = "URL")]
    url: Option<String>,
}

/// Maximum number of bars of the histogram of lengths.
const MAX_BARS: usize = 10;

/// Length of the longest bar, in characters.
const BAR_LENGTH: usize = 40;

/// Runs `swm inspect`.
pub fn inspect(args: &InspectArgs, as_json: bool) -> anyhow::Result<()> {
    if args.croissant || args.datasheet {
        return args.describe(as_json);
    }
    if let Some(option) = args.stated_only() {
        let fix = "add --croissant or --datasheet, or remove it";
        return Err(Error::config(option, "it belongs to a description", fix).into());
    }
    let reader = open_dataset(&args.dataset)?;
    if let Some(count) = args.colours {
        return colours(&*reader, count.into(), as_json);
    }
    let contents = contents(&*reader, args.checksum)?;
    if as_json {
        return emit_json(&contents);
    }
    let lengths: Vec<usize> = reader.episodes().iter().map(|episode| episode.length).collect();
    emit(&format!(
        "{} episodes, {} rows, {} on disk\n\n",
        contents["episodes"],
        contents["steps"],
        bytes(contents["bytes"].as_u64().unwrap_or_default())
    ));
    emit(&histogram(&lengths));
    let footprint = reader.footprint()?;
    let stored = |part: &str, name: &str| is_stored_as(name, part);
    let on_disk = |name: &str| footprint.iter().find(|(part, _)| stored(part, name)).map(|(_, size)| *size);
    let columns = reader.schema().columns().iter().map(|column| {
        let size = on_disk(&column.name);
        let range = contents["ranges"].get(&column.name);
        let value = |key: &str| range.map_or_else(String::new, |range| short(&range[key]));
        vec![
            one_line(&column.name),
            format!("{}{}", column.dtype.name(), shape(&column.shape)),
            value("min"),
            value("mean"),
            value("max"),
            size.map_or("–".to_owned(), bytes),
        ]
    });
    emit(&table(&["column", "type", "min", "mean", "max", "on disk"], columns));
    emit(&outcomes(&contents));
    let columns = reader.schema().columns();
    let others = footprint.iter().filter(|(part, _)| !columns.iter().any(|column| stored(part, &column.name)));
    for (part, size) in others {
        emit(&format!("{}: {}\n", one_line(part), bytes(*size)));
    }
    for name in reader.unread() {
        emit(&format!("not read, because it is neither numbers nor images: {}\n", one_line(&name)));
    }
    for (name, size) in constants(&*reader)? {
        emit(&format!("constant of every episode: {}, {} in the first episode\n", one_line(&name), bytes(size)));
    }
    emit(&provenance(reader.manifest().as_ref()));
    emit(&format!("content hash: {}\n", contents["content_hash"].as_str().unwrap_or_default()));
    if let Some(checksum) = contents["checksum"].as_str() {
        emit(&format!("checksum of the decoded content: {checksum}\n"));
    }
    Ok(())
}

/// Prints colours of the frames, as the setting of an encoder, in quotes for a shell.
fn colours(reader: &dyn Reader, count: usize, as_json: bool) -> anyhow::Result<()> {
    // Three digits are finer than a byte of a frame.
    let rounded = |value: f32| (f64::from(value) * 1000.0).round() / 1000.0;
    let colours: Vec<_> = frequent_colours(reader, count, None)?.iter().map(|colour| colour.map(rounded)).collect();
    if colours.len() < count {
        let fix = if colours.len() < 2 { "; an encoder needs at least two" } else { "" };
        eprint(&format!("the frames have {} of {count} colours{fix}\n", colours.len()));
    }
    if as_json {
        return emit_json(&json!({"colours": colours}));
    }
    emit(&format!("'model.encoder.keypoints.colours={colours:?}'\n").replace(", ", ","));
    Ok(())
}

impl InspectArgs {
    /// Prints the metadata or the datasheet.
    fn describe(&self, as_json: bool) -> anyhow::Result<()> {
        let described = self.described()?;
        if self.croissant {
            return emit_json(&metadata::croissant(&described));
        }
        let sheet = metadata::datasheet(&described);
        if as_json {
            return emit_json(&json!({"datasheet": sheet}));
        }
        emit(&sheet);
        Ok(())
    }

    /// Describes the dataset, or the capsule if the name is that of one.
    fn described(&self) -> Result<Described> {
        let is_capsule = self.dataset.starts_with("zoo:") || self.dataset.ends_with(".safetensors");
        if !is_capsule {
            let stated = Stated { licence: self.licence.clone(), author: self.author.clone(), url: self.url.clone() };
            return Described::dataset(&self.dataset, &*open_dataset(&self.dataset)?, stated);
        }
        if let Some(option) = self.stated_only().filter(|option| *option != "--url") {
            let fix = "pack the capsule again (`swm checkpoints pack`), or remove the option";
            return Err(Error::config(option, "the capsule states it itself", fix));
        }
        let path = find_checkpoint(&self.dataset)?;
        let info = CapsuleInfo::read(&path)?;
        let mut measured = vec![("family".to_owned(), info.family.clone()), ("packed on".to_owned(), info.packed_on)];
        measured.push(("weights (BLAKE3)".to_owned(), info.weights));
        if let Some(evaluation) = &info.evaluation {
            let what = if evaluation.returns.is_empty() { "success rate [95 %]" } else { "return" };
            measured.push((what.to_owned(), evaluation.measured()));
            measured.push(("starts".to_owned(), evaluation.starts()));
        }
        Described::capsule(&path, &Capsule::read(&path)?, measured, self.url.clone())
    }

    /// The first given option that only a description uses.
    fn stated_only(&self) -> Option<&'static str> {
        let given = [("--licence", &self.licence), ("--author", &self.author), ("--url", &self.url)];
        given.into_iter().find_map(|(name, value)| value.as_ref().map(|_| name))
    }
}

/// Returns the contents of a dataset; with `with_checksum`, all rows are read.
fn contents(reader: &dyn Reader, with_checksum: bool) -> Result<Value> {
    let mut contents = summary(reader)?;
    let lengths: Vec<f64> = reader.episodes().iter().map(|episode| episode.length as f64).collect();
    contents["lengths"] = json!(Summary::of(&lengths));
    contents["columns"] = json!(reader.schema());
    contents["footprint"] = json!(reader.footprint()?.into_iter().collect::<BTreeMap<_, _>>());
    contents["unread"] = json!(reader.unread());
    contents["constants"] = json!(constants(reader)?);
    add_values(reader, &mut contents)?;
    contents["content_hash"] = json!(reader.content_hash()?);
    contents["manifest"] = json!(reader.manifest());
    if with_checksum {
        contents["checksum"] = json!(checksum(reader)?);
    }
    Ok(contents)
}

/// The most rows whose values are read without being asked: a second of reading.
const MAX_ROWS: usize = 2_000_000;

/// Adds the range of every numeric column of at most [`MAX_ELEMENTS`] elements, and the success rate and the return of the
/// episodes where the dataset has these columns. Large datasets have none of them.
fn add_values(reader: &dyn Reader, contents: &mut Value) -> Result<()> {
    let rows: usize = reader.episodes().iter().map(|episode| episode.length).sum();
    if rows == 0 || rows > MAX_ROWS {
        return Ok(());
    }
    let mut ranges = serde_json::Map::new();
    for column in reader.schema().columns().iter().filter(|column| !column.is_image() && column.len() <= MAX_ELEMENTS) {
        // A column without any value, such as the actions of episodes with one row, has no range.
        let Ok(stats) = column_stats(reader, &column.name, None) else { continue };
        let least = stats.min.iter().copied().fold(f64::INFINITY, f64::min);
        let most = stats.max.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let mean = stats.mean.iter().sum::<f64>() / stats.mean.len().max(1) as f64;
        ranges.insert(column.name.clone(), json!({"min": least, "mean": mean, "max": most}));
    }
    contents["ranges"] = Value::Object(ranges);
    let returns = per_episode(reader, REWARD, |rewards| rewards.iter().filter(|reward| !reward.is_nan()).sum())?;
    if let Some(returns) = returns {
        contents["return"] = json!(Summary::of(&returns));
    }
    let solved = per_episode(reader, SUCCESS, |success| f64::from(u8::from(success.iter().any(|&one| one > 0.0))))?;
    if let Some(solved) = solved {
        contents["successful_episodes"] = json!(solved.iter().sum::<f64>() as usize);
    }
    Ok(())
}

/// The most elements of a column whose range is shown: depth images and the like have more.
const MAX_ELEMENTS: usize = 1024;

/// Returns a value of each episode, computed from a scalar column; `None` without such a column.
fn per_episode(reader: &dyn Reader, column: &str, value: impl Fn(&[f64]) -> f64) -> Result<Option<Vec<f64>>> {
    let Some(spec) = reader.schema().columns().iter().find(|spec| spec.name == column && spec.len() == 1) else {
        return Ok(None);
    };
    let episodes = reader.episodes();
    let ranges: Vec<StepRange> =
        episodes.iter().enumerate().map(|(position, episode)| StepRange::new(position, 0, episode.length)).collect();
    let batch = reader.read(&[&spec.name], &ranges)?;
    let mut row = 0;
    let values = episodes.iter().map(|episode| {
        let rows =
            (row..row + episode.length).map(|row| batch.row(row).to_f64(&spec.name)).collect::<Result<Vec<_>>>()?;
        row += episode.length;
        Ok(value(&rows.concat()))
    });
    values.collect::<Result<Vec<f64>>>().map(Some)
}

/// Describes how many episodes succeed, and their return.
fn outcomes(contents: &Value) -> String {
    let mut text = String::new();
    if let (Some(solved), Some(all)) = (contents["successful_episodes"].as_u64(), contents["episodes"].as_u64()) {
        text +=
            &format!("successful episodes: {solved} of {all} ({:.0} %)\n", 100.0 * solved as f64 / all.max(1) as f64);
    }
    let found = &contents["return"];
    if !found.is_null() {
        text += &format!("return of an episode: mean {}, median {}\n", short(&found["mean"]), short(&found["median"]));
    }
    text
}

/// Formats a value with four significant digits.
fn short(value: &Value) -> String {
    super::plot::short(value.as_f64().unwrap_or(f64::NAN))
}

/// Formats the shape of a row: nothing for a scalar.
fn shape(shape: &[usize]) -> String {
    if shape.is_empty() { String::new() } else { format!(" {shape:?}") }
}

/// Names and sizes of the first episode's constants.
fn constants(reader: &dyn Reader) -> Result<BTreeMap<String, u64>> {
    if reader.episodes().is_empty() {
        return Ok(BTreeMap::new());
    }
    Ok(reader.constants(0)?.into_iter().map(|(name, bytes)| (name, bytes.len() as u64)).collect())
}

/// Draws a histogram of episode lengths.
fn histogram(lengths: &[usize]) -> String {
    let values: Vec<f64> = lengths.iter().map(|&length| length as f64).collect();
    let (Some(min), Some(max), Some(all)) = (lengths.iter().min(), lengths.iter().max(), Summary::of(&values)) else {
        return String::new();
    };
    let mut text =
        format!("rows per episode: mean {:.1}, median {}, 95th percentile {}\n", all.mean, all.median, all.p95);
    let width = (max - min + 1).div_ceil(MAX_BARS);
    let mut counts = vec![0; (max - min) / width + 1];
    lengths.iter().for_each(|length| counts[(length - min) / width] += 1);
    let tallest = counts.iter().max().copied().unwrap_or(1);
    for (i, &count) in counts.iter().enumerate() {
        let (from, to) = (min + i * width, (min + (i + 1) * width - 1).min(*max));
        let bar = "█".repeat((count * BAR_LENGTH).div_ceil(tallest));
        let range = if from == to { from.to_string() } else { format!("{from} – {to}") };
        text += &format!("{range:>15}  {bar} {count}\n");
    }
    text + "\n"
}

/// Returns the provenance of a dataset.
fn provenance(manifest: Option<&Manifest>) -> String {
    let Some(manifest) = manifest else {
        return "no manifest: the provenance is unknown\n".to_owned();
    };
    let mut text =
        format!("made by {} of stable-worldmodel {}, seed {}", manifest.kind, manifest.swm_version, manifest.seed);
    for (name, value) in manifest.config.as_object().into_iter().flatten().filter(|(_, value)| !value.is_null()) {
        let value = value.as_str().map_or_else(|| value.to_string(), str::to_owned);
        text += &format!("\n{name:>20}: {}", shortened(&value));
    }
    for (name, version) in manifest.libraries.iter().chain(&manifest.hashes) {
        text += &format!("\n{name:>20}: {version}");
    }
    text + "\n"
}

/// Shortens a text to one line; `--json` prints the full text.
fn shortened(value: &str) -> String {
    const MAX_CHARS: usize = 90;
    if value.chars().count() <= MAX_CHARS {
        return value.to_owned();
    }
    value.chars().take(MAX_CHARS).chain("…".chars()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn draws_histogram_of_lengths() {
        let text = histogram(&[5, 5, 6, 30, 30, 30, 30, 41]);
        let lines: Vec<&str> = text.lines().map(str::trim).collect();
        assert_eq!(lines[0], "rows per episode: mean 22.1, median 30, 95th percentile 41");
        assert_eq!(lines[1], format!("5 – 8  {} 3", "█".repeat(30)));
        assert_eq!(lines[7], format!("29 – 32  {} 4", "█".repeat(40)));
        assert!(lines[10].starts_with("41  ") && lines[10].ends_with(" 1"), "{text}");
        assert!(histogram(&[7]).contains("7  █"));
        assert_eq!(histogram(&[]), "");
    }
}
