//! `swm inspect`: what is in a dataset.

use super::datasets::{bytes, summary};
use super::{emit, emit_json, table};
use clap::Args;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use swm::home::open_dataset;
use swm_core::columns::is_stored_as;
use swm_core::results::Summary;
use swm_core::{Manifest, Result};
use swm_data::{Reader, checksum};

/// Arguments of `swm inspect`.
#[derive(Args)]
pub struct InspectArgs {
    /// The dataset: a path, a URI or a name
    dataset: String,
    /// Read everything and add the checksum of what readers get, which does not depend on format and codec
    #[arg(long)]
    checksum: bool,
}

/// Bars of the distribution of lengths, at most.
const BARS: usize = 10;

/// The length of the longest bar.
const BAR: usize = 40;

/// Says what is in a dataset.
pub fn inspect(args: &InspectArgs, as_json: bool) -> anyhow::Result<()> {
    let reader = open_dataset(&args.dataset)?;
    let found = gather(&*reader, args.checksum)?;
    if as_json {
        return emit_json(&found);
    }
    let lengths: Vec<usize> = reader.episodes().iter().map(|episode| episode.length).collect();
    emit(&format!(
        "{} episodes, {} rows, {} on disk\n\n",
        found["episodes"],
        found["steps"],
        bytes(found["bytes"].as_u64().unwrap_or_default())
    ));
    emit(&histogram(&lengths));
    let footprint = reader.footprint()?;
    let stored = |part: &str, name: &str| is_stored_as(name, part);
    let on_disk = |name: &str| footprint.iter().find(|(part, _)| stored(part, name)).map(|(_, size)| *size);
    let columns = reader.schema().columns().iter().map(|column| {
        let size = on_disk(&column.name);
        vec![
            column.name.clone(),
            column.dtype.name().to_owned(),
            format!("{:?}", column.shape),
            size.map_or("–".to_owned(), bytes),
        ]
    });
    emit(&table(&["column", "type", "shape of a row", "on disk"], columns));
    let columns = reader.schema().columns();
    let others = footprint.iter().filter(|(part, _)| !columns.iter().any(|column| stored(part, &column.name)));
    for (part, size) in others {
        emit(&format!("{part}: {}\n", bytes(*size)));
    }
    for (name, size) in constants(&*reader)? {
        emit(&format!("constant of every episode: {name}, {} in the first\n", bytes(size)));
    }
    emit(&provenance(reader.manifest().as_ref()));
    emit(&format!("content hash: {}\n", found["content_hash"].as_str().unwrap_or_default()));
    if let Some(checksum) = found["checksum"].as_str() {
        emit(&format!("checksum of what readers get: {checksum}\n"));
    }
    Ok(())
}

/// Everything that is told.
fn gather(reader: &dyn Reader, summed: bool) -> Result<Value> {
    let mut found = summary(reader)?;
    #[allow(clippy::cast_precision_loss)]
    let lengths: Vec<f64> = reader.episodes().iter().map(|episode| episode.length as f64).collect();
    found["lengths"] = json!(Summary::of(&lengths));
    found["columns"] = json!(reader.schema());
    found["footprint"] = json!(reader.footprint()?.into_iter().collect::<BTreeMap<_, _>>());
    found["constants"] = json!(constants(reader)?);
    found["content_hash"] = json!(reader.content_hash()?);
    found["manifest"] = json!(reader.manifest());
    if summed {
        found["checksum"] = json!(checksum(reader)?);
    }
    Ok(found)
}

/// Names and sizes of the first episode's constants.
fn constants(reader: &dyn Reader) -> Result<BTreeMap<String, u64>> {
    if reader.episodes().is_empty() {
        return Ok(BTreeMap::new());
    }
    Ok(reader.constants(0)?.into_iter().map(|(name, bytes)| (name, bytes.len() as u64)).collect())
}

/// How many episodes have how many rows, as bars.
#[allow(clippy::cast_precision_loss)]
fn histogram(lengths: &[usize]) -> String {
    let values: Vec<f64> = lengths.iter().map(|&length| length as f64).collect();
    let (Some(least), Some(most), Some(all)) = (lengths.iter().min(), lengths.iter().max(), Summary::of(&values))
    else {
        return String::new();
    };
    let mut text =
        format!("rows of an episode: mean {:.1}, median {}, 95th percentile {}\n", all.mean, all.median, all.p95);
    let width = (most - least + 1).div_ceil(BARS);
    let mut counts = vec![0; (most - least) / width + 1];
    lengths.iter().for_each(|length| counts[(length - least) / width] += 1);
    let tallest = counts.iter().max().copied().unwrap_or(1);
    for (i, &count) in counts.iter().enumerate() {
        let (from, to) = (least + i * width, (least + (i + 1) * width - 1).min(*most));
        let bar = "█".repeat((count * BAR).div_ceil(tallest));
        let range = if from == to { from.to_string() } else { format!("{from} – {to}") };
        text += &format!("{range:>15}  {bar} {count}\n");
    }
    text + "\n"
}

/// Where it comes from, in a line or two.
fn provenance(manifest: Option<&Manifest>) -> String {
    let Some(manifest) = manifest else {
        return "no manifest: it does not say where it comes from\n".to_owned();
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

/// What fits a line; `--json` has all of it.
fn shortened(value: &str) -> String {
    const MOST: usize = 90;
    if value.chars().count() <= MOST {
        return value.to_owned();
    }
    value.chars().take(MOST).chain("…".chars()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lengths_are_drawn_as_bars() {
        let text = histogram(&[5, 5, 6, 30, 30, 30, 30, 41]);
        let lines: Vec<&str> = text.lines().map(str::trim).collect();
        assert_eq!(lines[0], "rows of an episode: mean 22.1, median 30, 95th percentile 41");
        assert_eq!(lines[1], format!("5 – 8  {} 3", "█".repeat(30)));
        assert_eq!(lines[7], format!("29 – 32  {} 4", "█".repeat(40)));
        assert!(lines[10].starts_with("41  ") && lines[10].ends_with(" 1"), "{text}");
        assert!(histogram(&[7]).contains("7  █"));
        assert_eq!(histogram(&[]), "");
    }
}
