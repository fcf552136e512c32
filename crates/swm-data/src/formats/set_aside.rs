//! Keeps the files of a dataset that is being replaced, in a folder inside its own, until the new one has a committed episode.
//!
//! The files are moved, the metadata last, and moved back if the new dataset gets no episode. After a kill the folders tell
//! which of the two is whole, and the next writer completes or undoes the replacement.

use crate::dataset::{Constants, Location, Writer};
use std::path::{Path, PathBuf};
use swm_core::files::{self, Lock};
use swm_core::{Batch, Error, Result};

/// What replacing needs to know of a format whose datasets are folders of files.
pub trait DatasetFiles: Copy + Send + 'static {
    /// Where the metadata and the files set aside are.
    const PLACES: Places;

    /// The files of the dataset in a folder, its metadata last.
    ///
    /// # Errors
    /// If they are unknown, because the metadata cannot be read or another program wrote it.
    fn names(self, folder: &Path) -> Result<Vec<PathBuf>>;

    /// Number of committed episodes of the dataset in a folder.
    ///
    /// # Errors
    /// If the metadata cannot be read.
    fn committed(self, folder: &Path) -> Result<usize>;

    /// The files that a writer leaves that was killed before it wrote the metadata.
    fn unfinished(self) -> Vec<PathBuf>;

    /// Removes the empty folders of the dataset in a folder.
    ///
    /// # Errors
    /// If the metadata cannot be read, or an empty folder cannot be removed.
    fn remove_empty_folders(self, folder: &Path) -> Result<()>;
}

/// Paths in the folder of a dataset.
pub struct Places {
    /// The file that makes a folder a dataset.
    pub metadata: &'static str,
    /// The folder for the files of the dataset that is replaced. Readers of the format ignore it.
    pub set_aside: &'static str,
}

/// The places of `folder` and `video`.
pub const COLUMN_FILES: Places = Places { metadata: "ep_len.npz", set_aside: "ep_len.replaced" };
/// The places of `lerobot`.
pub const LEROBOT: Places = Places { metadata: "meta/info.json", set_aside: "meta/replaced" };

/// The folder in a dataset's folder in which files are set aside, if there is one, and whether they are a whole dataset: the
/// metadata moves last and returns first.
fn found(path: &Path) -> Option<(PathBuf, bool)> {
    [COLUMN_FILES, LEROBOT].into_iter().find_map(|places| {
        let folder = path.join(places.set_aside);
        let is_whole = folder.join(places.metadata).is_file();
        folder.is_dir().then_some((folder, is_whole))
    })
}

/// The folder in a dataset's folder in which files are set aside, if there is one.
pub fn folder(path: &Path) -> Option<PathBuf> {
    found(path).map(|(folder, _)| folder)
}

/// The error of a dataset's folder with files set aside, if the new dataset has no episode or the files were being moved.
pub fn interrupted(location: &Location, has_episodes: bool) -> Option<Error> {
    let (folder, is_whole) = found(location.path()?)?;
    if has_episodes && is_whole {
        return None;
    }
    let problem = format!("it is being replaced, or that was interrupted; its old files are in {}", folder.display());
    let fix = "append to it, or repeat the command that replaces it: the old files return first";
    Some(Error::corrupt(location.label(), problem, fix))
}

/// The set-aside files of a dataset, in a folder that the caller has locked.
struct SetAside<F> {
    root: PathBuf,
    files: F,
}

impl<F: DatasetFiles> SetAside<F> {
    /// Sets the files of a dataset aside.
    fn begin(root: &Path, files: F) -> Result<Self> {
        let (aside, names) = (root.join(F::PLACES.set_aside), files.names(root)?);
        files::check_free(&aside)?;
        std::fs::create_dir_all(&aside).map_err(|e| Error::io(&aside, "creating the folder", e))?;
        let this = Self { root: root.to_owned(), files };
        this.files.remove_empty_folders(root)?;
        if let Err(error) = files::move_named(root, &names, &aside) {
            this.put_back()?;
            return Err(error);
        }
        Ok(this)
    }

    fn folder(&self) -> PathBuf {
        self.root.join(F::PLACES.set_aside)
    }

    /// Moves the files back, the metadata first.
    fn put_back(&self) -> Result<()> {
        let folder = self.folder();
        let mut names = files::list(&folder)?;
        names.sort_by_key(|name| name != Path::new(F::PLACES.metadata));
        // All of them or none.
        names.iter().try_for_each(|name| files::check_free(&self.root.join(name)))?;
        files::move_named(&folder, &names, &self.root)?;
        files::remove_empty_folders(&folder)
    }

    /// Deletes the files.
    fn delete(&self) -> Result<()> {
        let folder = self.folder();
        files::delete_named(&folder, &self.files.names(&folder)?)?;
        files::remove_empty_folders(&folder)
    }

    /// Deletes what is set aside if the new dataset has an episode. Otherwise deletes the new dataset and moves the files
    /// of the old one back.
    fn settle(&self) -> Result<()> {
        let is_dataset = |folder: &Path| folder.join(F::PLACES.metadata).is_file();
        let has_new = is_dataset(&self.root);
        // The metadata moves last and returns first: without it, the move was interrupted.
        if is_dataset(&self.folder()) {
            if has_new && self.files.committed(&self.root)? > 0 {
                return self.delete();
            }
            if has_new {
                self.files.remove_empty_folders(&self.root)?;
                files::delete_named(&self.root, &self.files.names(&self.root)?)?;
            }
            files::delete_named(&self.root, &self.files.unfinished())?;
        }
        self.put_back()
    }
}

/// Completes or undoes a replacement that was interrupted, in a folder that the caller has locked.
///
/// # Errors
/// If the files that were set aside are damaged, or moving or deleting fails.
pub fn recover<F: DatasetFiles>(root: &Path, files: F) -> Result<()> {
    let this = SetAside { root: root.to_owned(), files };
    let folder = this.folder();
    // A stranger may have made the folder: nothing is moved through links.
    Path::new(F::PLACES.set_aside).ancestors().try_for_each(|path| match path.as_os_str().is_empty() {
        true => Ok(()),
        false => files::check_no_link(&root.join(path)),
    })?;
    if folder.is_dir() { this.settle() } else { Ok(()) }
}

/// As [`recover`], for a folder that is not locked.
///
/// # Errors
/// As [`recover`], and if another process writes to the dataset.
pub fn recover_unlocked<F: DatasetFiles>(root: &Path, files: F) -> Result<()> {
    if !root.join(F::PLACES.set_aside).is_dir() {
        return Ok(());
    }
    let _lock = Lock::folder(root)?;
    recover(root, files)
}

/// Sets the files of the dataset in `root` aside, and writes the new one with the writer that `begin` makes. `committed`
/// returns the writer's number of committed episodes.
///
/// # Errors
/// If a file cannot be moved, or the new dataset cannot be begun; the old one is whole then.
pub fn replace<F: DatasetFiles, W: Writer + 'static>(
    root: &Path,
    files: F,
    committed: fn(&W) -> usize,
    begin: impl FnOnce() -> Result<W>,
) -> Result<Box<dyn Writer>> {
    let aside = SetAside::begin(root, files)?;
    match begin() {
        Ok(writer) => Ok(Box::new(SettingWriter { writer: Some(Box::new(writer)), aside: Some(aside), committed })),
        Err(error) => {
            aside.settle()?;
            Err(error)
        }
    }
}

/// Writes the new dataset, and settles what is set aside at its first commit or at its end.
struct SettingWriter<F: DatasetFiles, W: Writer> {
    /// `None` once it has ended.
    writer: Option<Box<W>>,
    /// `None` once the old dataset is deleted or whole again.
    aside: Option<SetAside<F>>,
    committed: fn(&W) -> usize,
}

impl<F: DatasetFiles, W: Writer> SettingWriter<F, W> {
    fn ended() -> Error {
        Error::external("writing an episode", "the writer has ended; open another one")
    }

    /// Settles after the writer has ended with `result`.
    fn end(&mut self, result: Result<()>, is_complete: bool) -> Result<()> {
        let Some(aside) = self.aside.take() else { return result };
        let lock = Lock::folder(&aside.root);
        let settled =
            lock.and_then(|_lock| if result.is_ok() && is_complete { aside.delete() } else { aside.settle() });
        result.and(settled)
    }
}

impl<F: DatasetFiles, W: Writer> Writer for SettingWriter<F, W> {
    fn write_episode_with(&mut self, episode: &Batch, constants: &Constants) -> Result<()> {
        let writer = self.writer.as_mut().ok_or_else(Self::ended)?;
        let written = writer.write_episode_with(episode, constants);
        if (self.committed)(writer) > 0 {
            let deleted = self.aside.take().map_or(Ok(()), |aside| aside.delete());
            return written.and(deleted);
        }
        written
    }

    fn episodes(&self) -> usize {
        self.writer.as_ref().map_or(0, |writer| writer.episodes())
    }

    fn finish(mut self: Box<Self>) -> Result<()> {
        let result = self.writer.take().ok_or_else(Self::ended)?.finish();
        self.end(result, true)
    }

    fn pause(mut self: Box<Self>) -> Result<()> {
        let result = self.writer.take().map_or(Ok(()), |writer| writer.pause());
        self.end(result, false)
    }
}

impl<F: DatasetFiles, W: Writer> Drop for SettingWriter<F, W> {
    fn drop(&mut self) {
        // Commits what it can.
        drop(self.writer.take());
        let Some(aside) = self.aside.take() else { return };
        if let Err(error) = recover_unlocked(&aside.root, aside.files) {
            tracing::error!(dataset = %aside.root.display(), "the replaced dataset could not be restored: {error}");
        }
    }
}
