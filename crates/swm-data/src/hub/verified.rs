//! [`Verified`]: the files of a commit that were compared with the hashes of the hub's list, so that only those are
//! compared again that have changed since.

use super::cache::{self, MAX_LIST};
use super::download::read_blocks;
use super::{HubFile, download};
use serde::{Deserialize, Serialize};
use sha1::{Digest as _, Sha1};
use std::collections::BTreeMap;
use std::fs::Metadata;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::time::SystemTime;
use swm_core::run::{Control, Event, Progress, Stage};
use swm_core::{Error, Result, files};

/// The name of the stage.
const STAGE: &str = "verify";

/// More bytes than this are stated before they are hashed.
const LARGE: u64 = 1_000_000_000;

/// What changes when a file is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Stamp {
    /// The time of the last change, in nanoseconds since 1970.
    modified: u64,
    /// The size, in bytes.
    size: u64,
}

impl Stamp {
    /// The stamp of a file; `None` if the file system states no time.
    fn of(found: &Metadata) -> Option<Self> {
        let modified = found.modified().ok()?.duration_since(SystemTime::UNIX_EPOCH).ok()?;
        Some(Self { modified: modified.as_nanos() as u64, size: found.len() })
    }

    /// The stamp of the file at a path; `None` also if there is none.
    pub fn at(path: &Path) -> Option<Self> {
        Self::of(&std::fs::metadata(path).ok()?)
    }
}

/// Finds a file of the listed size: its path and its stamp.
pub(super) fn find(file: &HubFile, snapshot: &Path) -> Option<(PathBuf, Option<Stamp>)> {
    let path = snapshot.join(&file.path);
    let found = std::fs::metadata(&path).ok().filter(|found| found.is_file() && found.len() == file.size)?;
    Some((path, Stamp::of(&found)))
}

/// The stamps of files by path in the repository.
type Stamps = BTreeMap<String, Stamp>;

/// The stamps of files when they were compared with their hashes.
pub(super) struct Verified {
    path: PathBuf,
    stamps: Stamps,
    /// What this process has found and not yet written; `None` removes a file.
    changes: BTreeMap<String, Option<Stamp>>,
}

impl Verified {
    /// Reads the record, which a cache of an earlier build lacks: its files are compared once.
    pub fn read(path: PathBuf) -> Self {
        let mut record = Self { path, stamps: Stamps::new(), changes: BTreeMap::new() };
        record.reload();
        record
    }

    /// Reads what other processes have written meanwhile, and keeps what this one has found.
    pub fn reload(&mut self) {
        let stored = files::read(&self.path, MAX_LIST).ok();
        self.stamps = stored.and_then(|bytes| serde_json::from_slice(&bytes).ok()).unwrap_or_default();
        for (path, stamp) in &self.changes {
            match stamp {
                Some(stamp) => self.stamps.insert(path.clone(), *stamp),
                None => self.stamps.remove(path),
            };
        }
    }

    /// Adds a file that had the listed hash when it had this stamp.
    pub fn add(&mut self, file: &HubFile, stamp: Option<Stamp>) {
        let known = match stamp {
            Some(stamp) => self.stamps.insert(file.path.clone(), stamp),
            None => self.stamps.remove(&file.path),
        };
        if known != stamp {
            self.changes.insert(file.path.clone(), stamp);
        }
    }

    /// Writes the record if this process has something to add.
    pub fn save(&mut self) {
        if let Some(error) = (!self.changes.is_empty()).then(|| self.write()).and_then(Result::err) {
            tracing::debug!("{error}");
        }
    }

    /// Writes the record with what other processes have added.
    fn write(&mut self) -> Result<()> {
        self.reload();
        cache::write(&self.path, &serde_json::to_vec(&self.stamps).unwrap_or_default())?;
        self.changes.clear();
        Ok(())
    }

    /// Whether a folder has a file as it was compared, or one of the listed size if the hub lists no hash.
    pub fn has(&self, file: &HubFile, snapshot: &Path) -> bool {
        find(file, snapshot).is_some_and(|(_, stamp)| !file.is_hashed() || self.is_known(file, stamp))
    }

    fn is_known(&self, file: &HubFile, stamp: Option<Stamp>) -> bool {
        stamp.is_some() && self.stamps.get(&file.path).copied() == stamp
    }

    /// Returns the files that the folder of a commit lacks: those that are missing, have another size than the hub
    /// lists, or have changed since they were compared and have another hash. If the record cannot be written, only
    /// sizes are compared: otherwise every opening would hash all files.
    ///
    /// # Errors
    /// If a file cannot be read, or the user stops the program.
    pub fn missing<'a>(
        &mut self,
        listed: &[&'a HubFile],
        snapshot: &Path,
        control: &mut Control<'_>,
    ) -> Result<Vec<&'a HubFile>> {
        let (mut missing, mut changed) = (vec![], vec![]);
        for &file in listed {
            match find(file, snapshot) {
                Some((_, stamp)) if !file.is_hashed() || self.is_known(file, stamp) => {}
                Some((path, stamp)) => changed.push((file, path, stamp)),
                None => missing.push(file),
            }
        }
        if changed.is_empty() {
            return Ok(missing);
        }
        let total = changed.len();
        if let Err(error) = self.write() {
            let what = "of the hub's cache are compared by their size only, because the record of compared files";
            control.emit(Event::Log(&format!("{total} files {what} cannot be written: {error}")));
            return Ok(missing);
        }
        if let Some(message) = first_message(changed.iter().map(|(file, ..)| file.size).sum(), snapshot) {
            control.emit(Event::Log(&message));
        }
        control.emit(Event::Started(Stage { name: STAGE, subject: &[], total, unit: "files" }));
        for (done, (file, path, stamp)) in changed.into_iter().enumerate() {
            match OtherHash::find(&path, file, control) {
                Ok(None) => self.add(file, stamp),
                Ok(Some(other)) => {
                    let problem = format!("has the {} {}, and the hub says {}", other.kind, other.found, other.listed);
                    control.emit(Event::Log(&format!("{} {problem}; downloading it again", path.display())));
                    missing.push(file);
                }
                // The error belongs to who reads the file.
                Err(Error::Io { source, .. }) if source.kind() == ErrorKind::PermissionDenied => {}
                Err(error) => return Err(error),
            }
            control.progress(Progress { stage: STAGE, done: done + 1, total, unit: "files", metrics: &[] });
        }
        control.emit(Event::Finished { stage: STAGE, metrics: &[] });
        Ok(missing)
    }
}

/// The message before many bytes are hashed, which takes minutes.
fn first_message(bytes: u64, snapshot: &Path) -> Option<String> {
    let what = "that were not compared with the hub's hashes since they were written; comparing them once";
    (bytes > LARGE).then(|| format!("{} has {bytes} bytes {what}", snapshot.display()))
}

/// The hash of a file that the hub lists, and another one that the file has.
pub(super) struct OtherHash<'a> {
    pub kind: &'static str,
    pub listed: &'a str,
    pub found: String,
}

impl<'a> OtherHash<'a> {
    /// Compares a file with the hash that the hub lists; `None` if they agree, or the hub lists none.
    ///
    /// # Errors
    /// If the file cannot be read, or the user stops the program.
    pub fn find(path: &Path, file: &'a HubFile, control: &mut Control<'_>) -> Result<Option<Self>> {
        let (kind, listed, found) = match (&file.sha256, &file.git_id) {
            (Some(listed), _) => ("SHA-256 hash", listed, download::sha256(path, control)?.0),
            (None, Some(listed)) => ("Git id", listed, git_id(path, file.size, control)?),
            (None, None) => return Ok(None),
        };
        Ok((!found.eq_ignore_ascii_case(listed)).then_some(Self { kind, listed, found }))
    }
}

/// The id that Git gives to a file of this size.
fn git_id(path: &Path, size: u64, control: &mut Control<'_>) -> Result<String> {
    let mut hash = Sha1::new();
    hash.update(format!("blob {size}\0"));
    read_blocks(path, control, |block| hash.update(block))?;
    Ok(download::hexadecimal(&hash.finalize()))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A file of five bytes whose SHA-256 hash is that of `hello`.
    fn hello(path: &str) -> HubFile {
        let sha256 = "2cf24dba5fb0a30e26e83b2ac5b9e29e1b161e5c1fa7425e73043362938b9824".to_owned();
        HubFile { path: path.to_owned(), size: 5, sha256: Some(sha256), git_id: None }
    }

    #[test]
    fn without_a_record_only_sizes_are_compared() -> Result<()> {
        let folder = tempfile::tempdir().expect("a folder");
        let (large, shorter) = (hello("large"), hello("shorter"));
        std::fs::write(folder.path().join("large"), "hullo").expect("a file");
        std::fs::write(folder.path().join("shorter"), "hell").expect("a file");
        std::fs::write(folder.path().join("verified"), "not a folder").expect("a file");
        let mut verified = Verified::read(folder.path().join("verified/c.json"));
        let mut said = vec![];
        let mut control = Control::new().with_events(|event| said.push(format!("{event:?}")));
        assert_eq!(verified.missing(&[&large, &shorter], folder.path(), &mut control)?, [&shorter]);
        drop(control);
        assert!(
            said.len() == 1 && said[0].contains("1 files of the hub's cache are compared by their size"),
            "{said:?}"
        );
        assert!(!verified.has(&large, folder.path()));
        Ok(())
    }

    #[test]
    fn records_of_several_processes_are_merged() -> Result<()> {
        let folder = tempfile::tempdir().expect("a folder");
        let files = [hello("a"), hello("b"), hello("c")];
        for file in &files {
            std::fs::write(folder.path().join(&file.path), "hello").expect("a file");
        }
        let record = folder.path().join("verified/c.json");
        let mut processes = [Verified::read(record.clone()), Verified::read(record.clone())];
        for (process, file) in processes.iter_mut().zip(&files) {
            let missing = process.missing(&[file], folder.path(), &mut Control::new())?;
            assert_eq!(missing, Vec::<&HubFile>::new());
            process.save();
        }
        let [mut first, _] = processes;
        let known = |record: &Verified| files.each_ref().map(|file| record.has(file, folder.path()));
        assert_eq!(known(&first), [true, false, false]);
        first.add(&files[2], Stamp::at(&folder.path().join("c")));
        // What a process finds after it has the lock.
        first.reload();
        assert_eq!(known(&first), [true, true, true]);
        assert_eq!(known(&Verified::read(record)), [true, true, false]);
        Ok(())
    }

    #[test]
    fn many_bytes_are_stated_first() {
        assert_eq!(first_message(LARGE, Path::new("snapshots/c")), None);
        let message = first_message(2 * LARGE, Path::new("snapshots/c")).expect("a message");
        assert!(message.contains("snapshots/c has 2000000000 bytes"), "{message}");
    }

    #[test]
    fn files_that_changed_since_they_were_compared_are_missing() -> Result<()> {
        let folder = tempfile::tempdir().expect("a folder");
        let file = |path: &str, git_id: Option<&str>| HubFile {
            sha256: None,
            git_id: git_id.map(str::to_owned),
            ..hello(path)
        };
        let large = hello("large");
        let (small, none) = (file("small", Some("b6fc4c620b67d95f953a5c1c1230aaab5db5a1b0")), file("none", None));
        let listed = [&large, &small, &none];
        let record = folder.path().join("verified/c.json");
        let missing = || -> Result<Vec<&str>> {
            let mut verified = Verified::read(record.clone());
            let found = verified.missing(&listed, folder.path(), &mut Control::new())?;
            verified.save();
            Ok(found.into_iter().map(|file| file.path.as_str()).collect())
        };
        assert_eq!(missing()?, ["large", "small", "none"]);
        let write = |content: &str, seconds: u64| {
            for file in listed {
                let path = folder.path().join(&file.path);
                std::fs::write(&path, content).expect("a file");
                let time = SystemTime::UNIX_EPOCH + std::time::Duration::from_secs(seconds);
                std::fs::File::options()
                    .append(true)
                    .open(&path)
                    .and_then(|file| file.set_modified(time))
                    .expect("a time");
            }
        };
        write("hello", 1000);
        assert_eq!(missing()?, Vec::<&str>::new());
        let known = std::fs::read_to_string(&record).expect("a record");
        assert!(known.contains("large") && known.contains("small") && !known.contains("none"), "{known}");
        // With the known time and size, no file is read.
        write("hullo", 1000);
        assert_eq!(missing()?, Vec::<&str>::new());
        write("hullo", 2000);
        assert_eq!(missing()?, ["large", "small"]);
        write("hello", 3000);
        assert_eq!(missing()?, Vec::<&str>::new());
        Ok(())
    }
}
