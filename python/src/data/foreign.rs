//! Readers and writers implemented in Python, as readers and writers of the engine.

use super::{Column, described, schema};
use crate::arrays;
use crate::errors::attached;
use crate::exit;
use crate::held::Held;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use swm::core::columns::{EPISODE_IDX, STEP_IDX};
use swm::core::{Batch, Error, Manifest, Result, Schema};
use swm::data::{Constants, Episode, Reader, StepRange, Writer, checksum};

/// The columns with the indices of episodes and steps. The engine computes their values.
const INDEX_COLUMNS: [&str; 2] = [EPISODE_IDX, STEP_IDX];

/// A reader implemented by a Python object with three methods: `schema()` returns a list of `(name, type, shape)`;
/// `lengths()` returns the number of rows of every episode; `rows(column, episode, start, length)` returns an array
/// `[length, ..]` of the column's type.
pub struct ForeignReader {
    object: Held<Py<PyAny>>,
    schema: Schema,
    episodes: Vec<Episode>,
}

impl ForeignReader {
    /// Wraps a Python object.
    ///
    /// # Errors
    /// If the object raises, or a column has a type that cannot be stored.
    pub fn new(py: Python<'_>, object: Py<PyAny>) -> PyResult<Self> {
        let given: Vec<Column> = exit::call_method(object.bind(py), "schema", ())?.extract()?;
        let indices = INDEX_COLUMNS.map(|name| (name.to_owned(), "int64".to_owned(), vec![]));
        let data = given.into_iter().filter(|(name, ..)| !INDEX_COLUMNS.contains(&name.as_str()));
        let schema = schema(indices.into_iter().chain(data).collect())?;
        let lengths: Vec<usize> = exit::call_method(object.bind(py), "lengths", ())?.extract()?;
        let episodes = lengths.into_iter().enumerate().map(|(i, length)| Episode { index: i as i64, length }).collect();
        Ok(Self { object: Held::new(object), schema, episodes })
    }

    fn rows(&self, column: &str, range: &StepRange) -> Result<Batch> {
        let rows: Batch = attached(|py| {
            let arguments = (column, range.episode, range.start, range.length);
            let rows = exit::call_method(self.object.bind(py), "rows", arguments)?;
            let dict = PyDict::new(py);
            dict.set_item(column, rows)?;
            arrays::batch(&dict)
        })?;
        let (given, expected) = (&rows.schema().columns()[0], self.schema.column(column)?);
        if given == expected && rows.rows() == range.length {
            return Ok(rows);
        }
        let describe = |schema: &Schema| format!("{:?}", described(schema));
        Err(Error::mismatch(
            format!("reading {} rows of '{column}' from Python", range.length),
            format!("{} rows of {}", rows.rows(), describe(rows.schema())),
            describe(&Schema::new([expected.clone()])?),
        ))
    }
}

impl Reader for ForeignReader {
    fn schema(&self) -> &Schema {
        &self.schema
    }

    fn episodes(&self) -> &[Episode] {
        &self.episodes
    }

    fn read_column(&self, column: &str, ranges: &[StepRange], out: &mut [u8]) -> Result<()> {
        let n = self.schema.column(column)?.row_bytes();
        let mut rest = out;
        for range in ranges {
            let end = range.start.checked_add(range.length);
            let known = |episode: &Episode| end.is_some_and(|end| end <= episode.length);
            if !self.episodes.get(range.episode).is_some_and(known) {
                let given = format!("{} rows from row {} of episode {}", range.length, range.start, range.episode);
                return Err(Error::mismatch("reading rows", given, "rows inside the episode"));
            }
            let Some((target, remaining)) = rest.split_at_mut_checked(range.length * n) else {
                return Err(Error::mismatch("reading rows", "a buffer that is too small", "room for every row"));
            };
            rest = remaining;
            if let Some(which) = INDEX_COLUMNS.iter().position(|&name| name == column) {
                for (row, target) in target.chunks_exact_mut(n).enumerate() {
                    let index = if which == 0 { range.episode } else { range.start + row } as i64;
                    target.copy_from_slice(&index.to_ne_bytes());
                }
            } else {
                target.copy_from_slice(self.rows(column, range)?.bytes(0));
            }
        }
        Ok(())
    }

    fn manifest(&self) -> Option<Manifest> {
        None
    }

    /// Returns no sizes, because the engine does not know the files of a Python reader.
    fn footprint(&self) -> Result<Vec<(String, u64)>> {
        Ok(vec![])
    }

    fn content_hash(&self) -> Result<String> {
        checksum(self)
    }
}

/// A writer that passes episodes to a Python object: `write_episode({column: array [rows, ..]})`. The object does not
/// get the constants of an episode.
pub struct ForeignWriter {
    object: Held<Py<PyAny>>,
    episodes: usize,
}

impl ForeignWriter {
    /// Writes to `object`, whose dataset already has `episodes` episodes.
    pub fn new(object: Py<PyAny>, episodes: usize) -> Self {
        Self { object: Held::new(object), episodes }
    }
}

impl Writer for ForeignWriter {
    fn write_episode_with(&mut self, episode: &Batch, _: &Constants) -> Result<()> {
        let write = |py: Python<'_>| {
            let dict = PyDict::new(py);
            for (i, column) in episode.schema().columns().iter().enumerate() {
                if !INDEX_COLUMNS.contains(&column.name.as_str()) {
                    let shape: Vec<usize> =
                        std::iter::once(episode.rows()).chain(column.shape.iter().copied()).collect();
                    dict.set_item(&column.name, arrays::array(py, column.dtype, &shape, episode.bytes(i))?)?;
                }
            }
            exit::call_method(self.object.bind(py), "write_episode", (dict,)).map(drop)
        };
        attached(write)?;
        self.episodes += 1;
        Ok(())
    }

    fn episodes(&self) -> usize {
        self.episodes
    }

    /// Does nothing: the Python code that opened the object closes it.
    fn finish(self: Box<Self>) -> Result<()> {
        Ok(())
    }
}
