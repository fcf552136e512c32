//! One dataset, written by several machines: each writes its share of the episodes to data files and keeps a log of
//! them, and when all have finished, one commit makes of them one version.
//!
//! The log of shard 1 of 3 is the folder `_shards/1-of-3`: `begun.json` says which columns it has, `00000000.json` and
//! so on name a group of episodes each, `done.json` says how many groups there are. Data files are written before the
//! log that names them, so a shard that was killed continues after its last group. Numbers of episodes are not known
//! before all shards are; the commit writes them to data files of their own.

use super::encode::Encoded;
use super::reader::LanceReader;
use super::schema;
use super::store::{Store, Version, damaged};
use super::table::{TRIES, Table};
use super::writer::{Begun, Sink, busy, continued, fresh};
use crate::dataset::{Location, Reader as _};
use crate::dataset::{WriteMode, WriteOptions, Writer};
use lance_table::format::Fragment;
use lance_table::transaction::Operation;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::sync::Arc;
use swm_core::{Error, Manifest, Result, Schema};
use swm_image::ImageCodec;

/// Which part of a dataset a machine writes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shard {
    /// 0 up to `count`.
    pub index: usize,
    /// How many there are.
    pub count: usize,
}

impl Shard {
    /// Its log, below the table's folder.
    fn folder(self) -> String {
        format!("_shards/{}-of-{}", self.index, self.count)
    }

    fn parse(name: &str) -> Option<Self> {
        let (index, count) = name.split_once("-of-")?;
        let shard = Self { index: index.parse().ok()?, count: count.parse().ok()? };
        (shard.index < shard.count).then_some(shard)
    }
}

/// What a shard began with. All shards of a dataset must agree.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct BegunShard {
    columns: Schema,
    codec: ImageCodec,
    manifest: Option<Manifest>,
}

/// Episodes that were written together.
#[derive(Debug, Serialize, Deserialize)]
struct Group {
    fragment: Fragment,
    /// Rows of each episode.
    rows: Vec<u64>,
}

#[derive(Debug, Serialize, Deserialize)]
struct Done {
    groups: usize,
}

/// Writes a part of a dataset that several machines write together. Nothing of it is seen by readers before
/// [`commit_shards`]. `options.mode` is about this part: [`WriteMode::Append`] continues what a killed process began,
/// [`WriteMode::Overwrite`] begins it again. The dataset itself may be new or have episodes.
///
/// # Errors
/// When the part is there and must not be, it has other columns than the dataset, or the system refuses.
pub fn create_shard(
    location: &Location,
    schema: &Schema,
    options: WriteOptions,
    shard: Shard,
) -> Result<Box<dyn Writer>> {
    options.codec.check()?;
    if shard.index >= shard.count {
        let problem = format!("there is no part {} of {}", shard.index, shard.count);
        return Err(Error::config("shard", problem, "parts are counted from 0"));
    }
    let store = Store::new(location)?;
    store.check_writable()?;
    let version = store.latest()?;
    let mut columns = schema::columns_to_write(schema)?;
    let fresh = fresh(&columns, schema, &options)?;
    if let Some(old) = &version {
        let known = LanceReader::of(store.clone(), Arc::clone(&old.manifest))?;
        columns = continued(&store.label, columns, old, known.schema())?;
        Log::of(&store)?.remove_committed(&store, old);
    }
    let begun = BegunShard { columns: schema.clone(), codec: options.codec, manifest: options.manifest.clone() };
    let log = Log::of(&store)?;
    let (mut groups, mut episodes) = (0, 0);
    if let Some(part) = log.parts.get(&(shard.count, shard.index)) {
        match options.mode {
            WriteMode::Create => {
                let problem = format!("part {} of {} was begun already", shard.index, shard.count);
                return Err(Error::config("shard", problem, "say whether to continue it or to overwrite it"));
            }
            WriteMode::Overwrite => part.remove(&store, shard),
            WriteMode::Append => {
                part.check_columns(&store, &begun)?;
                groups = part.groups.len();
                episodes = part.groups.iter().map(|group| group.rows.len()).sum();
            }
        }
    }
    let mut log = ShardLog { table: Table::new(store, version, fresh), folder: shard.folder(), groups };
    log.put("begun.json", &begun)?;
    Begun { sink: Sink::Shard(log), columns, episodes }.start(schema, &options)
}

/// The log of the part that this process writes.
pub struct ShardLog {
    /// What the data files are for; it is not committed to here.
    pub table: Table,
    folder: String,
    groups: usize,
}

impl ShardLog {
    /// Writes some episodes to a data file, and notes it.
    pub fn append(&mut self, episodes: &[Encoded]) -> Result<()> {
        let fragment = self.table.write_episodes(episodes, None)?;
        let rows = episodes.iter().map(|episode| episode.rows as u64).collect();
        self.put(&format!("{:08}.json", self.groups), &Group { fragment, rows })?;
        self.groups += 1;
        Ok(())
    }

    /// Notes that all episodes are there.
    pub fn finish(&mut self) -> Result<()> {
        self.put("done.json", &Done { groups: self.groups })
    }

    fn put(&mut self, name: &str, value: &impl Serialize) -> Result<()> {
        let path = self.table.store.path(&format!("{}/{name}", self.folder));
        self.table.store.write(&path, schema::json(value)?.into())
    }
}

/// What all parts noted, by their number and place.
#[derive(Default)]
struct Log {
    parts: BTreeMap<(usize, usize), Part>,
}

/// What one part noted.
#[derive(Default)]
struct Part {
    begun: Option<BegunShard>,
    groups: Vec<Group>,
    done: Option<Done>,
}

impl Log {
    fn of(store: &Store) -> Result<Self> {
        let mut log = Self::default();
        for file in store.list("_shards")? {
            let mut parts = file.location.parts().map(|part| part.as_ref().to_owned()).collect::<Vec<_>>().into_iter();
            let (Some(name), Some(folder)) = (parts.next_back(), parts.next_back()) else { continue };
            let Some(shard) = Shard::parse(&folder) else { continue };
            let part = log.parts.entry((shard.count, shard.index)).or_default();
            match name.as_str() {
                "begun.json" => part.begun = Some(parse(store, &file.location)?),
                "done.json" => part.done = Some(parse(store, &file.location)?),
                // Files are listed by name, so groups come in order.
                _ => part.groups.push(parse(store, &file.location)?),
            }
        }
        Ok(log)
    }

    /// Removes parts that a commit made part of the table, should it have been killed before it did. Parts are
    /// committed together, so one that is in the table stands for all. Gives whether there were any.
    fn remove_committed(&self, store: &Store, version: &Version) -> bool {
        let fragments = version.manifest.fragments.iter();
        let known: Vec<&str> = fragments.flat_map(|fragment| &fragment.files).map(|file| file.path.as_str()).collect();
        let mut groups = self.parts.values().flat_map(|part| &part.groups);
        let committed = groups.any(|group| group.fragment.files.iter().any(|file| known.contains(&file.path.as_str())));
        if committed {
            self.forget(store);
        }
        committed
    }

    /// Removes the log; the data files stay.
    fn forget(&self, store: &Store) {
        for file in store.list("_shards").unwrap_or_default() {
            store.remove(&file.location);
        }
    }

    /// The parts in order, when all are there, finished, and of the same columns.
    fn complete(&self, store: &Store) -> Result<Vec<&Part>> {
        let unfinished = |problem: String, fix: &str| Err(Error::config("shards", problem, fix));
        let Some(&(count, _)) = self.parts.keys().next() else {
            return unfinished(format!("{} has none to commit", store.label.display()), "collect with --shard first");
        };
        if let Some((other, _)) = self.parts.keys().find(|(other, _)| *other != count) {
            let problem = format!("some are parts of {count}, some of {other}");
            return unfinished(problem, "remove those that are wrong from the folder _shards");
        }
        let mut complete: Vec<&Part> = vec![];
        for index in 0..count {
            let Some(part) = self.parts.get(&(count, index)) else {
                return unfinished(format!("part {index} of {count} is missing"), "collect it, then commit again");
            };
            if part.done.as_ref().is_none_or(|done| done.groups != part.groups.len()) {
                let problem = format!("part {index} of {count} is not finished");
                return unfinished(problem, "continue it (--resume), then commit again");
            }
            if let (Some(first), Some(begun)) = (complete.first(), &part.begun) {
                first.check_columns(store, begun)?;
            }
            complete.push(part);
        }
        Ok(complete)
    }
}

impl Part {
    fn check_columns(&self, store: &Store, other: &BegunShard) -> Result<()> {
        match &self.begun {
            Some(own) if own.columns != other.columns => Err(Error::mismatch(
                format!("writing a part of {}", store.label.display()),
                crate::dataset::episodes::words(other.columns.columns()),
                crate::dataset::episodes::words(own.columns.columns()),
            )),
            Some(_) => Ok(()),
            None => Err(damaged(&store.label, "a part has no begun.json")),
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

fn parse<T: DeserializeOwned>(store: &Store, path: &object_store::path::Path) -> Result<T> {
    serde_json::from_slice(&store.read(path)?).map_err(|e| damaged(&store.label, format!("{path} is unreadable: {e}")))
}

/// The manifests of the parts that are there, in order, for those that have one.
///
/// # Errors
/// When the log of a part is damaged, or the system refuses.
pub fn shard_manifests(location: &Location) -> Result<Vec<Manifest>> {
    let log = Log::of(&Store::new(location)?)?;
    Ok(log.parts.into_values().filter_map(|part| part.begun?.manifest).collect())
}

/// Makes one version of what all parts wrote, in the order of the parts, after the episodes that are there. Gives the
/// number of episodes that were added. What a killed commit left is taken up where it stopped.
///
/// # Errors
/// When a part is missing, not finished, or has other columns, or the system refuses.
pub fn commit_shards(location: &Location) -> Result<usize> {
    let store = Store::new(location)?;
    for _ in 0..TRIES {
        let log = Log::of(&store)?;
        let version = store.latest()?;
        if version.as_ref().is_some_and(|version| log.remove_committed(&store, version)) {
            return Ok(0);
        }
        let parts = log.complete(&store)?;
        let Some(begun) = parts.first().and_then(|part| part.begun.as_ref()) else {
            return Err(damaged(&store.label, "a part has no begun.json"));
        };
        let options = WriteOptions { codec: begun.codec, manifest: begun.manifest.clone(), ..WriteOptions::default() };
        let fresh = fresh(&schema::columns_to_write(&begun.columns)?, &begun.columns, &options)?;
        let mut table = Table::new(store.clone(), version.clone(), fresh);
        let mut next = if version.is_some() { table.refresh()? } else { 0 };
        let first = next;
        let mut fragments = vec![];
        for group in parts.iter().flat_map(|part| &part.groups) {
            let mut fragment = group.fragment.clone();
            fragment.files.push(table.write_numbers(&group.rows, next)?);
            next += group.rows.len() as i64;
            fragments.push(fragment);
        }
        let operation = match version {
            Some(_) => Operation::Append { fragments: fragments.clone() },
            None => table.made_anew(fragments.clone()),
        };
        if table.commit(operation)? {
            log.forget(&store);
            return Ok((next - first) as usize);
        }
        for numbers in fragments.iter().filter_map(|fragment| fragment.files.last()) {
            store.remove(&store.data_path(&numbers.path));
        }
    }
    Err(busy(&store.label))
}
