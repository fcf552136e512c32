//! Shards: several machines write one dataset. Each machine writes its episodes to data files and logs them; when all
//! machines have finished, one commit adds all episodes as one version of the table.
//!
//! The log of shard 1 of 3 is the folder `_shards/1-of-3`. `begun.json` holds the columns; `00000000.json` and the
//! following files describe one group of episodes each; `done.json` holds the number of groups. Data files are written
//! before the log entry that names them, so a killed shard continues after its last group. Episode indices are only
//! known once all shards are complete; the commit writes them to separate data files.

use super::ENTRY;
use super::encode::EncodedEpisode;
use super::errors::damaged;
use super::reader::LanceReader;
use super::schema;
use super::store::{Store, Version};
use super::table::{MAX_ATTEMPTS, Table};
use super::writer::{PreparedWriter, Sink, match_table_columns, new_table_schema, too_many_conflicts};
use crate::dataset::episodes::check_episode;
use crate::dataset::{Constants, Location, Reader as _};
use crate::dataset::{WriteMode, WriteOptions, Writer};
use crate::formats::replacing::ReplacingWriter;
use lance_table::format::Fragment;
use lance_table::transaction::Operation;
use object_store::ObjectMeta;
use object_store::path::Path as StorePath;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::sync::Arc;
use swm_core::{Batch, Error, Manifest, Result, Schema};
use swm_image::ImageCodec;

/// The part of a dataset that one machine writes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shard {
    /// Index of the shard, from 0.
    pub index: usize,
    /// Number of shards.
    pub count: usize,
}

impl Shard {
    /// The episodes of this shard among all of a dataset. They are consecutive, so that the committed dataset has all episodes
    /// in order.
    pub fn episodes(self, all: usize) -> Range<usize> {
        let share = |index: usize| (all as u128 * index as u128 / self.count as u128) as usize;
        share(self.index)..share(self.index + 1)
    }

    /// The folder of the shard's log, below the table's folder.
    fn folder(self) -> String {
        format!("_shards/{}-of-{}", self.index, self.count)
    }

    fn parse(name: &str) -> Option<Self> {
        let (index, count) = name.split_once("-of-")?;
        let shard = Self { index: index.parse().ok()?, count: count.parse().ok()? };
        (shard.index < shard.count).then_some(shard)
    }
}

/// Content of `begun.json`. All shards of a dataset must have the same columns.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct ShardStart {
    columns: Schema,
    codec: ImageCodec,
    manifest: Option<Manifest>,
}

/// Content of a log entry: episodes that were written together.
#[derive(Debug, Serialize, Deserialize)]
struct Group {
    fragment: Fragment,
    /// Length of each episode in rows.
    rows: Vec<u64>,
}

/// Content of `done.json`.
#[derive(Debug, Serialize, Deserialize)]
struct ShardEnd {
    groups: usize,
}

/// Writes one shard of a dataset. Readers return the episodes of a shard only after [`commit_shards`]. `options.mode`
/// refers to the shard: [`WriteMode::Append`] continues a killed shard, [`WriteMode::Overwrite`] replaces the shard,
/// which stays until the first episode is ready to be written.
/// The dataset may be new or contain episodes.
///
/// # Errors
/// If the shard exists and `options.mode` forbids it, the columns differ from those of the dataset, or writing fails.
pub fn create_shard(
    location: &Location,
    schema: &Schema,
    options: WriteOptions,
    shard: Shard,
) -> Result<Box<dyn Writer>> {
    options.codec.check()?;
    if shard.index >= shard.count {
        let problem = format!("there is no shard {} of {}", shard.index, shard.count);
        return Err(Error::config("shard", problem, "choose an index from 0 up to the number of shards minus 1"));
    }
    ENTRY.check_suffix(location)?;
    let store = Store::new(location)?;
    store.check_writable()?;
    let mut columns = schema::columns_to_write(schema)?;
    let lock = store.lock(&shard.folder())?;
    let version = store.latest()?;
    let fresh = new_table_schema(&columns, schema, &options)?;
    if let Some(old) = &version {
        let known = LanceReader::of(store.clone(), Arc::clone(&old.manifest))?;
        columns = match_table_columns(&store.label, columns, old, known.schema())?;
        Logs::read(&store)?.remove_committed(&store, old);
        if let Some(manifest) = &options.manifest {
            check_adds(&store, &known, manifest)?;
        }
    }
    let begun = ShardStart { columns: schema.clone(), codec: options.codec, manifest: options.manifest.clone() };
    let mut logs = Logs::read_shard(&store, shard)?;
    let mut replaced = None;
    let (mut groups, mut episodes) = (0, 0);
    if let Some(shard_log) = logs.shards.remove(&(shard.count, shard.index)) {
        match options.mode {
            WriteMode::Create => {
                let problem = format!("shard {} of {} already exists", shard.index, shard.count);
                return Err(Error::config("shard", problem, "append to the shard, or overwrite it"));
            }
            WriteMode::Overwrite => replaced = Some(shard_log),
            WriteMode::Append => {
                shard_log.check_columns(&store, &begun)?;
                groups = shard_log.groups.len();
                episodes = shard_log.groups.iter().map(|group| group.rows.len()).sum();
            }
        }
    }
    let is_replaced = replaced.is_some();
    let (checked, schema, incoming, codec) = (columns.clone(), schema.clone(), schema.clone(), options.codec);
    let start = move || {
        if let Some(old) = replaced {
            old.remove(&store, shard);
        }
        let mut log = ShardLog { table: Table::new(store, version, fresh), folder: shard.folder(), groups };
        log.write_entry("begun.json", &begun)?;
        PreparedWriter { sink: Sink::Shard(log), columns, episodes }.start(&schema, &options, lock)
    };
    if !is_replaced {
        return start();
    }
    let check = move |episode: &Batch, constants: &Constants| {
        check_episode(episode, &incoming)?;
        EncodedEpisode::new(&checked, episode, codec, constants).map(drop)
    };
    Ok(ReplacingWriter::boxed(check, start))
}

/// The log of the shard that this process writes.
pub struct ShardLog {
    /// Writes the data files. A shard does not commit versions of the table.
    pub table: Table,
    folder: String,
    groups: usize,
}

impl ShardLog {
    /// Writes episodes to a data file and logs it.
    pub fn append(&mut self, episodes: &[EncodedEpisode]) -> Result<()> {
        let fragment = self.table.write_episodes(episodes, None)?;
        let rows = episodes.iter().map(|episode| episode.rows as u64).collect();
        let path = self.path(&format!("{:08}.json", self.groups));
        let group = Group { fragment, rows };
        if !self.table.store.write_new(&path, schema::json(&group)?.into())? {
            self.table.discard(&group.fragment);
            let problem = format!("another process writes {} of {}", self.folder, self.table.store.label.display());
            return Err(Error::config("shard", problem, "wait until that process has ended, then continue (--resume)"));
        }
        self.groups += 1;
        Ok(())
    }

    /// Logs that the shard is complete.
    pub fn finish(&mut self) -> Result<()> {
        self.write_entry("done.json", &ShardEnd { groups: self.groups })
    }

    fn write_entry(&mut self, name: &str, value: &impl Serialize) -> Result<()> {
        self.table.store.write(&self.path(name), schema::json(value)?.into())
    }

    fn path(&self, name: &str) -> StorePath {
        self.table.store.path(&format!("{}/{name}", self.folder))
    }
}

/// Logs of all shards, by `(count, index)`.
#[derive(Default)]
struct Logs {
    shards: BTreeMap<(usize, usize), ShardLogFiles>,
}

/// The log of one shard.
#[derive(Default)]
struct ShardLogFiles {
    begun: Option<ShardStart>,
    groups: Vec<Group>,
    done: Option<ShardEnd>,
}

impl Logs {
    fn read(store: &Store) -> Result<Self> {
        Self::read_in(store, "_shards")
    }

    /// Reads the log of one shard. With many shards, each reading the logs of all would be most of the requests to a store.
    fn read_shard(store: &Store, shard: Shard) -> Result<Self> {
        Self::read_in(store, &shard.folder())
    }

    fn read_in(store: &Store, folder: &str) -> Result<Self> {
        let mut listed = store.list(folder)?;
        for _ in 0..MAX_ATTEMPTS {
            let logs = Self::of(store, &listed);
            let Err(error) = logs else { return logs };
            // A commit on another machine removes the files that were listed.
            let remaining = store.list(folder)?;
            if remaining == listed {
                return Err(error);
            }
            listed = remaining;
        }
        Err(too_many_conflicts(&store.label))
    }

    /// Reads these files.
    fn of(store: &Store, listed: &[ObjectMeta]) -> Result<Self> {
        let mut logs = Self::default();
        let contents = store.read_all(listed.iter().map(|file| file.location.clone()).collect())?;
        for (file, content) in listed.iter().zip(contents) {
            let mut components =
                file.location.parts().map(|component| component.as_ref().to_owned()).collect::<Vec<_>>().into_iter();
            let (Some(name), Some(folder)) = (components.next_back(), components.next_back()) else { continue };
            let Some(shard) = Shard::parse(&folder) else { continue };
            let shard_log = logs.shards.entry((shard.count, shard.index)).or_default();
            match name.as_str() {
                "begun.json" => shard_log.begun = Some(parse(store, &file.location, &content)?),
                "done.json" => shard_log.done = Some(parse(store, &file.location, &content)?),
                // Files are listed by name, so groups are in order.
                _ => shard_log.groups.push(parse(store, &file.location, &content)?),
            }
        }
        Ok(logs)
    }

    /// Removes the logs of committed shards, in case a commit was killed before it removed them. All shards are
    /// committed together, so one committed group means that all shards are committed. Returns whether the shards are
    /// committed.
    fn remove_committed(&self, store: &Store, version: &Version) -> bool {
        let fragments = version.manifest.fragments.iter();
        let known: Vec<&str> = fragments.flat_map(|fragment| &fragment.files).map(|file| file.path.as_str()).collect();
        let mut groups = self.shards.values().flat_map(|shard_log| &shard_log.groups);
        let committed = groups.any(|group| group.fragment.files.iter().any(|file| known.contains(&file.path.as_str())));
        if committed {
            self.remove(store);
        }
        committed
    }

    /// Removes the logs but not the data files.
    fn remove(&self, store: &Store) {
        store.remove_all(store.list("_shards").unwrap_or_default().into_iter().map(|file| file.location).collect());
    }

    /// All shards in order, if they are complete and have the same columns.
    fn complete(&self, store: &Store) -> Result<Vec<&ShardLogFiles>> {
        let unfinished = |problem: String, fix: &str| Err(Error::config("shards", problem, fix));
        let Some(&(count, _)) = self.shards.keys().next() else {
            return unfinished(
                format!("{} has no shards to commit", store.label.display()),
                "collect with --shard first",
            );
        };
        if let Some((other, _)) = self.shards.keys().find(|(other, _)| *other != count) {
            let problem = format!("there are shards of {count} and shards of {other}");
            return unfinished(problem, "remove the wrong shards from the folder _shards");
        }
        let mut complete: Vec<&ShardLogFiles> = vec![];
        for index in 0..count {
            let Some(shard_log) = self.shards.get(&(count, index)) else {
                return unfinished(format!("shard {index} of {count} is missing"), "collect it, then commit again");
            };
            if shard_log.done.as_ref().is_none_or(|done| done.groups != shard_log.groups.len()) {
                let problem = format!("shard {index} of {count} is not finished");
                return unfinished(problem, "continue it (--resume), then commit again");
            }
            if let (Some(first), Some(begun)) = (complete.first(), &shard_log.begun) {
                first.check_columns(store, begun)?;
            }
            complete.push(shard_log);
        }
        Ok(complete)
    }
}

impl ShardLogFiles {
    fn check_columns(&self, store: &Store, other: &ShardStart) -> Result<()> {
        match &self.begun {
            Some(own) if own.columns != other.columns => Err(Error::mismatch(
                format!("writing a shard of {}", store.label.display()),
                crate::dataset::episodes::describe_columns(other.columns.columns()),
                crate::dataset::episodes::describe_columns(own.columns.columns()),
            )),
            Some(_) => Ok(()),
            None => Err(damaged(&store.label, "a shard has no begun.json")),
        }
    }

    fn remove(&self, store: &Store, shard: Shard) {
        for file in store.list(&shard.folder()).unwrap_or_default() {
            store.remove(&file.location);
        }
        for file in self.groups.iter().flat_map(|group| &group.fragment.files) {
            store.remove(&store.data_path(&file.path));
        }
    }
}

fn parse<T: DeserializeOwned>(store: &Store, path: &StorePath, content: &[u8]) -> Result<T> {
    serde_json::from_slice(content).map_err(|e| damaged(&store.label, format!("{path} is unreadable: {e}")))
}

/// The existing shards with their manifests, in order. Shards without a manifest are skipped.
///
/// # Errors
/// If a log is damaged or cannot be read.
pub fn shard_manifests(location: &Location) -> Result<Vec<(Shard, Manifest)>> {
    let shards = Logs::read(&Store::new(location)?)?.shards.into_iter();
    let manifests = shards.map(|((count, index), log)| Some((Shard { index, count }, log.begun?.manifest?)));
    Ok(manifests.flatten().collect())
}

/// The manifest of a shard; `None` if the shard does not exist or has none.
///
/// # Errors
/// If its log is damaged or cannot be read.
pub fn shard_manifest(location: &Location, shard: Shard) -> Result<Option<Manifest>> {
    let logs = Logs::read_shard(&Store::new(location)?, shard)?;
    Ok(logs.shards.into_values().find_map(|log| log.begun?.manifest))
}

/// Adds the NaN and infinite values of all shards to those in a manifest.
fn with_counts(mut manifest: Manifest, shards: &[&ShardLogFiles]) -> Manifest {
    let manifests = shards.iter().filter_map(|shard| shard.begun.as_ref()?.manifest.as_ref());
    for (column, count) in manifests.flat_map(|shard| &shard.not_finite) {
        *manifest.not_finite.entry(column.clone()).or_default() += count;
    }
    manifest
}

/// Checks that a dataset has no episodes of the collection that shards belong to: they would be stored twice.
fn check_adds(store: &Store, known: &LanceReader, shards: &Manifest) -> Result<()> {
    let collection = |manifest: &Manifest| {
        let mut config = manifest.config.clone();
        // The same seed gives the same first episodes, however many there are.
        config.as_object_mut().and_then(|settings| settings.remove("episodes"));
        (manifest.seed, config)
    };
    let same = known.manifest().is_some_and(|stored| collection(&stored) == collection(shards));
    if !same || known.episodes().is_empty() {
        return Ok(());
    }
    let problem = "it has episodes of the collection that the shards belong to already, which would be stored twice";
    let fix = "collect with another seed or into another dataset; removing its folder _shards discards the shards";
    Err(Error::config(format!("dataset {}", store.label.display()), problem, fix))
}

/// Commits the episodes of all shards as one version, in the order of the shards, after the existing episodes. Returns
/// the number of added episodes. If a previous commit was killed, this call completes it.
///
/// # Errors
/// If a shard is missing or incomplete, the columns of the shards differ, the dataset has episodes of their collection
/// already, another process commits them meanwhile, or writing fails.
pub fn commit_shards(location: &Location) -> Result<usize> {
    let store = Store::new(location)?;
    // The lock would create the folder.
    let has_shards = store.label.join("_shards").is_dir();
    let _lock = if has_shards { store.lock("_shards")? } else { None };
    let listed = |store: &Store| -> Result<BTreeSet<StorePath>> {
        Ok(store.list("_shards")?.into_iter().map(|file| file.location).collect())
    };
    let number = |store: &Store| Ok(store.latest()?.map(|version| version.manifest.version));
    let (logs, version) = (listed(&store)?, number(&store)?);
    commit_logged(&store).map_err(|error| {
        // Another machine that commits the same shards removes their logs, which are read here.
        let is_committed = number(&store).is_ok_and(|newer| newer > version)
            && listed(&store).is_ok_and(|remaining| !remaining.is_superset(&logs));
        if !is_committed {
            return error;
        }
        let problem = "another process committed its shards meanwhile";
        Error::config(store.label.display().to_string(), problem, "nothing remains to be done")
    })
}

/// Commits the shards whose logs are in the store.
fn commit_logged(store: &Store) -> Result<usize> {
    for _ in 0..MAX_ATTEMPTS {
        let logs = Logs::read(store)?;
        let version = store.latest()?;
        if version.as_ref().is_some_and(|version| logs.remove_committed(store, version)) {
            return Ok(0);
        }
        let shards = logs.complete(store)?;
        let Some(begun) = shards.first().and_then(|shard_log| shard_log.begun.as_ref()) else {
            return Err(damaged(&store.label, "a shard has no begun.json"));
        };
        let uncounted = begun.manifest.clone().map(|manifest| Manifest { not_finite: BTreeMap::new(), ..manifest });
        let manifest = uncounted.map(|manifest| with_counts(manifest, &shards));
        let options = WriteOptions { codec: begun.codec, manifest, ..WriteOptions::default() };
        let fresh = new_table_schema(&schema::columns_to_write(&begun.columns)?, &begun.columns, &options)?;
        let stored = version.as_ref().and_then(|old| schema::manifest(&old.manifest.schema));
        if let (Some(old), Some(manifest)) = (&version, &begun.manifest) {
            check_adds(store, &LanceReader::of(store.clone(), Arc::clone(&old.manifest))?, manifest)?;
        }
        let mut table = Table::new(store.clone(), version.clone(), fresh);
        let mut next = if version.is_some() { table.refresh()? } else { 0 };
        let first = next;
        let mut fragments = vec![];
        for group in shards.iter().flat_map(|shard_log| &shard_log.groups) {
            let mut fragment = group.fragment.clone();
            fragment.files.push(table.write_episode_indices(&group.rows, next)?);
            next += group.rows.len() as i64;
            fragments.push(fragment);
        }
        let operation = match version {
            Some(_) => Operation::Append { fragments: fragments.clone() },
            None => table.overwrite_operation(fragments.clone()),
        };
        if table.commit(operation)? {
            let counted = stored.clone().map(|stored| with_counts(stored, &shards));
            if counted != stored
                && let Some(operation) = table.manifest_operation(schema::json(&counted)?)
            {
                // If this fails, another writer has replaced the manifest.
                table.commit(operation)?;
            }
            logs.remove(store);
            return Ok((next - first) as usize);
        }
        for indices in fragments.iter().filter_map(|fragment| fragment.files.last()) {
            store.remove(&store.data_path(&indices.path));
        }
    }
    Err(too_many_conflicts(&store.label))
}
