//! A writer that replaces a dataset when its first episode is ready to be written.

use crate::dataset::{Constants, Writer};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use swm_core::{Batch, Error, Result, files};

type Check = Box<dyn Fn(&Batch, &Constants) -> Result<()> + Send>;
type Replace = Box<dyn FnOnce() -> Result<Box<dyn Writer>> + Send>;

/// Checks that no file of a dataset to replace, given by its path in `folder`, is a symbolic link or in a linked folder.
///
/// # Errors
/// If one is.
pub fn check_no_links(folder: &Path, names: &[PathBuf]) -> Result<()> {
    let paths: BTreeSet<&Path> = names.iter().flat_map(|name| name.ancestors()).collect();
    // A folder precedes its files, because a link among the folders would lead elsewhere.
    paths.into_iter().try_for_each(|path| files::check_no_link(&folder.join(path)))
}

/// Keeps the old dataset until an episode that the format can store is written, or the writer is finished.
///
/// So an environment that fails at its first step, and a first episode that is refused, lose no data.
pub struct ReplacingWriter {
    check: Check,
    /// Deletes the old dataset and begins the new one; `None` once it was called.
    replace: Option<Replace>,
    writer: Option<Box<dyn Writer>>,
}

impl ReplacingWriter {
    /// A writer that calls `replace` before the first episode that passes `check`.
    pub fn boxed(
        check: impl Fn(&Batch, &Constants) -> Result<()> + Send + 'static,
        replace: impl FnOnce() -> Result<Box<dyn Writer>> + Send + 'static,
    ) -> Box<dyn Writer> {
        Box::new(Self { check: Box::new(check), replace: Some(Box::new(replace)), writer: None })
    }

    fn begin(&mut self) -> Result<Box<dyn Writer>> {
        let failed = || Error::external("replacing a dataset", "an earlier attempt failed; open another writer");
        self.replace.take().ok_or_else(failed)?()
    }
}

impl Writer for ReplacingWriter {
    fn write_episode_with(&mut self, episode: &Batch, constants: &Constants) -> Result<()> {
        let writer = match self.writer.take() {
            Some(writer) => writer,
            None => {
                (self.check)(episode, constants)?;
                self.begin()?
            }
        };
        self.writer.insert(writer).write_episode_with(episode, constants)
    }

    fn sync(&mut self) -> Result<()> {
        self.writer.as_mut().map_or(Ok(()), |writer| writer.sync())
    }

    fn episodes(&self) -> usize {
        self.writer.as_ref().map_or(0, |writer| writer.episodes())
    }

    fn finish(mut self: Box<Self>) -> Result<()> {
        match self.writer.take() {
            Some(writer) => writer.finish(),
            None => self.begin()?.finish(),
        }
    }

    fn pause(mut self: Box<Self>) -> Result<()> {
        self.writer.take().map_or(Ok(()), Writer::pause)
    }
}
