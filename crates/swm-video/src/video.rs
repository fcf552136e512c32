//! Videos that were opened: where their bytes are, and where the encoded frames are among them.

use crate::mp4::{self, Index};
use std::fs::File;
use std::io::{Read as _, Seek as _, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use swm_core::{Error, Result, files};

/// The source of a video's bytes.
#[derive(Clone, Debug)]
pub enum Source {
    /// A file.
    File(PathBuf),
    /// Bytes in memory, with the path that error messages contain.
    Memory(PathBuf, Arc<[u8]>),
}

/// An opened source.
pub(crate) enum Open<'a> {
    File(File),
    Memory(&'a [u8]),
}

impl Source {
    pub(crate) fn label(&self) -> &Path {
        let (Self::File(path) | Self::Memory(path, _)) = self;
        path
    }

    pub(crate) fn open(&self) -> Result<(Open<'_>, u64)> {
        Ok(match self {
            Self::File(path) => {
                let io = |e| Error::io(path, "opening a video", e);
                let file = files::open(path)?;
                let length = file.metadata().map_err(io)?.len();
                (Open::File(file), length)
            }
            Self::Memory(_, bytes) => (Open::Memory(bytes), bytes.len() as u64),
        })
    }
}

impl Open<'_> {
    /// Fills `bytes` from `offset` on.
    pub(crate) fn read(&mut self, offset: u64, bytes: &mut [u8]) -> std::result::Result<(), String> {
        match self {
            Self::File(file) => {
                let read = file.seek(SeekFrom::Start(offset)).and_then(|_| file.read_exact(bytes));
                read.map_err(|e| format!("cannot be read: {e}"))
            }
            Self::Memory(all) => {
                let from = usize::try_from(offset).ok().and_then(|at| all.get(at..)?.get(..bytes.len()));
                bytes.copy_from_slice(from.ok_or("ends too early")?);
                Ok(())
            }
        }
    }
}

/// An MP4 file whose tables were read. The file is not kept open.
#[derive(Debug)]
pub struct Video {
    pub(crate) source: Source,
    pub(crate) index: Index,
}

impl Video {
    /// Reads the tables of a video.
    ///
    /// # Errors
    /// When the file cannot be read, is not a plain MP4 file, or has an unsupported codec.
    pub fn open(source: Source) -> Result<Self> {
        let (mut open, length) = source.open()?;
        let index = Index::read(length, |offset, bytes| open.read(offset, bytes));
        let index = index.map_err(|problem| damaged(source.label(), &problem))?;
        Ok(Self { source, index })
    }

    /// Returns the number of frames.
    pub fn frames(&self) -> usize {
        self.index.frames.len()
    }

    /// Returns the height and width.
    pub fn size(&self) -> (usize, usize) {
        (self.index.height, self.index.width)
    }

    /// Returns the bytes of memory that the opened video takes.
    pub fn memory(&self) -> usize {
        let index = &self.index;
        let tables = index.samples.len() * size_of::<mp4::Sample>() + index.frames.len() * 12;
        let sums = index.sums.as_ref().map_or(0, |sums| 4 * sums.values.len());
        let bytes = if let Source::Memory(_, bytes) = &self.source { bytes.len() } else { 0 };
        size_of::<Self>() + tables + sums + bytes
    }

    /// Calls `each` with the encoded bytes of every frame of `frames`.
    ///
    /// # Errors
    /// When the file is damaged.
    pub fn coded(&self, frames: impl IntoIterator<Item = usize>, mut each: impl FnMut(&[u8])) -> Result<()> {
        let (mut open, _) = self.source.open()?;
        let mut bytes = vec![];
        for frame in frames {
            let sample = self.index.frames.get(frame).map(|&i| i as usize);
            let sample = sample.ok_or_else(|| self.lacks(frame))?;
            let entry = self.index.samples[sample];
            bytes.resize(entry.size as usize, 0);
            let read = open.read(entry.offset, &mut bytes).and_then(|()| self.index.check(sample, &bytes));
            read.map_err(|problem| damaged(self.source.label(), &problem))?;
            each(&bytes);
        }
        Ok(())
    }

    /// Returns the error for a defect of this video.
    pub fn damaged(&self, problem: &str) -> Error {
        damaged(self.source.label(), problem)
    }

    pub(crate) fn lacks(&self, frame: usize) -> Error {
        self.damaged(&format!("has {} frames, but frame {frame} was requested", self.frames()))
    }

    /// Returns the index of the frame closest to a time in seconds, and the frame's distance from the time in seconds.
    /// Returns `None` if the video has no frames.
    pub fn frame_at(&self, seconds: f64) -> Option<(usize, f64)> {
        let frame = self.index.frame_at(seconds)?;
        Some((frame, (self.index.seconds(frame) - seconds).abs()))
    }
}

/// Returns the error for a damaged video.
pub(crate) fn damaged(path: &Path, problem: &str) -> Error {
    let fix = "restore it from a copy, or encode it again with `ffmpeg -i IN -c:v libx264 OUT.mp4`";
    Error::corrupt(path, format!("the video {problem}"), fix)
}
