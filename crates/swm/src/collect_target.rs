//! Checks that a collection may write to an existing dataset, and that all frames of a dataset come from one renderer.

use std::collections::BTreeMap;
use swm_core::{Error, Manifest, Result};
use swm_data::lance::{Shard, shard_manifest, shard_manifests};
use swm_data::{Continued, Location, WriteMode};
use swm_eval::continuation::check_continues;

/// Checks, before any episode is played, that a collection with this manifest may be written to a location.
/// `mix_renderers` permits frames of another renderer than the renderer of the stored frames. `advice` says, in the caller's words, what to
/// do about a dataset that exists.
///
/// # Errors
/// When a dataset exists and `mode` is [`WriteMode::Create`], or the dataset cannot be continued with this manifest.
pub fn check(
    location: &Location,
    mode: WriteMode,
    new: &Manifest,
    mix_renderers: bool,
    advice: &str,
) -> Result<Existing> {
    if !exists(location) {
        return Ok(Existing::default());
    }
    match mode {
        WriteMode::Overwrite => Ok(Existing::default()),
        WriteMode::Append => {
            let reader = swm_data::open(location.clone())?;
            let continues = Some(Continued::of(&*reader)?);
            let Some(mut stored) = reader.manifest() else { return Ok(Existing { continues, ..Existing::default() }) };
            let not_finite = std::mem::take(&mut stored.not_finite);
            check_continues(&stored, new)?;
            if !mix_renderers {
                check_renderer("continuing a collection", &stored, new)?;
            }
            Ok(Existing { continues, not_finite })
        }
        WriteMode::Create => check_new(location, advice).map(|()| Existing::default()),
    }
}

/// What remains of an existing dataset, to which a collection adds episodes.
#[derive(Default)]
pub struct Existing {
    /// Its episodes, for [`swm_data::WriteOptions::continues`].
    pub continues: Option<Continued>,
    /// The numbers of its NaN and infinite values, by column.
    pub not_finite: BTreeMap<String, u64>,
}

/// Checks that a location has no dataset. `advice` says what to do about one.
///
/// # Errors
/// When it has one.
pub fn check_new(location: &Location, advice: &str) -> Result<()> {
    if exists(location) {
        return Err(Error::config(format!("dataset {location}"), "it exists already", advice));
    }
    Ok(())
}

/// Whether a location has a dataset.
fn exists(location: &Location) -> bool {
    match location.path() {
        Some(path) => path.exists() && !swm_data::has_no_dataset(path),
        None => swm_data::open(location.clone()).is_ok(),
    }
}

/// Returns the numbers of NaN and infinite values of the stored episodes of a shard, by column.
///
/// # Errors
/// When the log of a shard is damaged.
pub fn not_finite_of_shard(location: &Location, shard: Shard) -> Result<BTreeMap<String, u64>> {
    Ok(shard_manifest(location, shard)?.map(|manifest| manifest.not_finite).unwrap_or_default())
}

/// Adds the NaN and infinite values of a collection to those in its manifest.
pub fn add_not_finite(manifest: &mut Manifest, counts: &BTreeMap<String, u64>) {
    for (column, count) in counts {
        *manifest.not_finite.entry(column.clone()).or_default() += count;
    }
}

/// Returns a warning of the NaN and infinite values of a collection; `None` if all values were finite.
pub fn describe_not_finite(counts: &BTreeMap<String, u64>) -> Option<String> {
    let columns: Vec<String> = counts.iter().map(|(column, count)| format!("{count} in '{column}'")).collect();
    let hint = "the dataset's manifest counts them; --strict-finite (strict_finite=True) refuses them";
    (!columns.is_empty()).then(|| format!("NaN or infinite values were stored: {}; {hint}", columns.join(", ")))
}

/// Checks that all uncommitted shards of a dataset belong to the same collection, and, unless `mix_renderers`, that the
/// shards and the committed episodes have frames of the same renderer.
///
/// # Errors
/// When shards were collected with different settings, or two renderers were used.
pub fn check_shards(location: &Location, mix_renderers: bool) -> Result<()> {
    let stored = swm_data::open(location.clone()).ok().and_then(|reader| reader.manifest());
    let shards = shard_manifests(location)?;
    if let Some(((_, first), others)) = shards.split_first() {
        others.iter().try_for_each(|(_, other)| check_continues(first, other))?;
    }
    let mut manifests = stored.iter().chain(shards.iter().map(|(_, manifest)| manifest));
    let Some(first) = manifests.next().filter(|_| !mix_renderers) else { return Ok(()) };
    manifests.try_for_each(|other| check_renderer("committing a shard", first, other))
}

/// Checks that two manifests name the same renderer; the device may differ.
fn check_renderer(operation: &str, stored: &Manifest, new: &Manifest) -> Result<()> {
    fn renderer(manifest: &Manifest) -> Option<&str> {
        manifest.libraries.get("renderer")?.split(' ').next()
    }
    match (renderer(stored), renderer(new)) {
        (Some(stored), Some(new)) if stored != new => Err(Error::config(
            format!("{operation} with the renderer {new}"),
            format!("the dataset's other frames were rendered by {stored}"),
            format!("use --renderer {stored}, or accept slightly different frames with --mix-renderers"),
        )),
        _ => Ok(()),
    }
}
