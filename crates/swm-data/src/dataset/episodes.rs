//! What every format needs of episodes: where their rows are, how they are numbered, and whether they keep the time
//! convention.

use crate::dataset::clips::ACTION;
use crate::dataset::reader::{Episode, StepRange};
use std::ops::Range;
use swm_core::{Batch, ColumnSpec, DType, Error, Result, Schema};

/// The columns that number episodes and steps. Readers compute them.
pub(crate) const EPISODE: &str = "episode_idx";
/// See [`EPISODE`].
pub(crate) const STEP: &str = "step_idx";

/// A row and where it is wanted.
pub(crate) type Wanted<'a> = ((usize, usize), &'a mut [u8]);

/// Episodes one after another in a table of rows.
#[derive(Clone, Debug, Default)]
pub(crate) struct Rows {
    episodes: Vec<Episode>,
    /// The first row of each episode.
    first: Vec<u64>,
    total: u64,
}

impl Rows {
    /// Episodes of these lengths that begin in these rows.
    ///
    /// # Errors
    /// When there are fewer beginnings than lengths, or a number is too large.
    pub fn at(lengths: &[i64], first: &[i64]) -> Result<Self, String> {
        let Some(first) = first.get(..lengths.len()) else {
            return Err(format!("{} episodes have a length, and {} a beginning", lengths.len(), first.len()));
        };
        let mut rows = Self::default();
        let mut total = 0;
        for (episode, (&length, &first)) in lengths.iter().zip(first).enumerate() {
            let (Ok(length), Ok(first)) = (usize::try_from(length), u64::try_from(first)) else {
                return Err(format!("episode {episode} has {length} rows from row {first}"));
            };
            rows.push(length);
            rows.first[episode] = first;
            let end = first.checked_add(length as u64).ok_or_else(|| format!("episode {episode} ends nowhere"))?;
            total = total.max(end);
        }
        rows.total = total;
        Ok(rows)
    }

    /// Whether every episode begins where the one before ends, so that more can follow.
    pub fn is_contiguous(&self) -> bool {
        let mut next = 0;
        self.episodes.iter().zip(&self.first).all(|(episode, &first)| {
            let fits = first == next;
            next = first + episode.length as u64;
            fits
        })
    }

    /// One more episode.
    pub fn push(&mut self, length: usize) {
        #[allow(clippy::cast_possible_wrap)]
        self.episodes.push(Episode { index: self.episodes.len() as i64, length });
        self.first.push(self.total);
        self.total = self.total.saturating_add(length as u64);
    }

    /// The episodes, in stored order.
    pub fn episodes(&self) -> &[Episode] {
        &self.episodes
    }

    /// Rows of all episodes.
    pub const fn total(&self) -> u64 {
        self.total
    }

    /// The first row of each episode.
    pub fn first(&self) -> &[u64] {
        &self.first
    }

    /// The rows of a range in the whole table.
    ///
    /// # Errors
    /// When they do not exist.
    pub fn range(&self, range: &StepRange) -> Result<Range<u64>> {
        let end = range.start.checked_add(range.length);
        match self.episodes.get(range.episode) {
            Some(episode) if end.is_some_and(|end| end <= episode.length) => {
                let first = self.first[range.episode] + range.start as u64;
                Ok(first..first + range.length as u64)
            }
            Some(episode) => Err(Error::mismatch(
                "reading rows",
                format!("{} rows from row {} of episode {}", range.length, range.start, range.episode),
                format!("rows below {}", episode.length),
            )),
            None => Err(Error::mismatch(
                "reading rows",
                format!("the episode in position {}", range.episode),
                format!("positions below {}", self.episodes.len()),
            )),
        }
    }

    /// Checks that `out` has room for the rows of a column, and gives their number.
    ///
    /// # Errors
    /// When it has more or less.
    pub fn check_room(column: &ColumnSpec, ranges: &[StepRange], out: &[u8]) -> Result<usize> {
        let rows: usize = ranges.iter().map(|range| range.length).sum();
        let expected = rows * column.row_bytes();
        if out.len() == expected {
            return Ok(rows);
        }
        Err(Error::mismatch(
            format!("reading column '{}'", column.name),
            format!("room for {} bytes", out.len()),
            format!("{expected} for {rows} rows"),
        ))
    }

    /// Every wanted row, as `(position of its episode, step)`, with its place in `out`, in stored order.
    ///
    /// # Errors
    /// When a row does not exist, or `out` has another length.
    pub fn wanted<'a>(&self, column: &ColumnSpec, ranges: &[StepRange], out: &'a mut [u8]) -> Result<Vec<Wanted<'a>>> {
        let rows = Self::check_room(column, ranges, out)?;
        let mut wanted = Vec::with_capacity(rows);
        let mut places = out.chunks_exact_mut(column.row_bytes());
        for range in ranges {
            self.range(range)?;
            let steps = range.start..range.start + range.length;
            wanted.extend(steps.map(|step| (range.episode, step)).zip(places.by_ref()));
        }
        wanted.sort_by_key(|(row, _)| *row);
        Ok(wanted)
    }

    /// Fills `out` with a column of [`numbering`].
    ///
    /// # Errors
    /// When a row does not exist, or `out` has another length.
    pub fn number(&self, column: &ColumnSpec, ranges: &[StepRange], out: &mut [u8]) -> Result<()> {
        Self::check_room(column, ranges, out)?;
        let mut places = out.chunks_exact_mut(column.dtype.size().max(1));
        for range in ranges {
            self.range(range)?;
            let index = self.episodes[range.episode].index;
            for (step, place) in (range.start..range.start + range.length).zip(places.by_ref()) {
                #[allow(clippy::cast_possible_wrap)]
                let value = if column.name == EPISODE { index } else { step as i64 };
                #[allow(clippy::cast_possible_truncation, clippy::cast_precision_loss, clippy::cast_sign_loss)]
                match column.dtype {
                    DType::Bool | DType::U8 => place[0] = value as u8,
                    DType::Int32 => place.copy_from_slice(&(value as i32).to_ne_bytes()),
                    DType::Int64 => place.copy_from_slice(&value.to_ne_bytes()),
                    DType::Float32 => place.copy_from_slice(&(value as f32).to_ne_bytes()),
                    DType::Float64 => place.copy_from_slice(&(value as f64).to_ne_bytes()),
                }
            }
        }
        Ok(())
    }
}

/// The columns [`EPISODE`] and [`STEP`], with the type they have in `columns` where they are there as scalars.
pub(crate) fn numbering(columns: &[ColumnSpec]) -> [ColumnSpec; 2] {
    [EPISODE, STEP].map(|name| {
        let declared = columns.iter().find(|column| column.name == name && column.len() == 1);
        declared.cloned().unwrap_or_else(|| ColumnSpec::new(name, DType::Int32, []))
    })
}

/// A schema in words, for messages.
pub(crate) fn words(columns: &[ColumnSpec]) -> String {
    let words: Vec<String> = columns.iter().map(|c| format!("{} {}{:?}", c.name, c.dtype.name(), c.shape)).collect();
    words.join(", ")
}

/// Checks that columns to append are those of the dataset, in whatever order; numbering aside.
///
/// # Errors
/// When they are not.
pub(crate) fn check_continued(dataset: &impl std::fmt::Display, incoming: &Schema, known: &Schema) -> Result<()> {
    let sorted = |schema: &Schema| {
        let mut columns: Vec<ColumnSpec> =
            schema.columns().iter().filter(|c| c.name != EPISODE && c.name != STEP).cloned().collect();
        columns.sort_by(|a, b| a.name.cmp(&b.name));
        columns
    };
    let (incoming, known) = (sorted(incoming), sorted(known));
    if incoming == known {
        return Ok(());
    }
    let expected = format!("the columns it has: {}", words(&known));
    Err(Error::mismatch(format!("appending to {dataset}"), words(&incoming), expected))
}

/// Checks that an episode has the columns a writer was made for and keeps the time convention: the last row's action
/// is missing, all others are there.
///
/// # Errors
/// When it does not.
pub(crate) fn check(episode: &Batch, schema: &Schema) -> Result<()> {
    if episode.schema() != schema {
        return Err(Error::mismatch("writing an episode", words(episode.schema().columns()), words(schema.columns())));
    }
    let rows = episode.rows();
    if rows == 0 {
        return Err(Error::mismatch("writing an episode", "no rows", "at least the final observation"));
    }
    let Some(index) = schema.find(ACTION) else { return Ok(()) };
    let (float, missing) = match schema.columns()[index].dtype {
        DType::Float32 | DType::Float64 => (true, "NaN"),
        DType::Int32 | DType::Int64 => (false, "-1"),
        DType::Bool | DType::U8 => return Ok(()),
    };
    for row in 0..rows {
        let action = episode.row(row).to_f64(ACTION)?;
        let is_missing = action.iter().all(|&v| if float { v.is_nan() } else { v == -1.0 });
        let last = row + 1 == rows;
        let fine = if last { is_missing } else { !is_missing && action.iter().all(|v| v.is_finite()) };
        if !fine {
            return Err(Error::mismatch(
                "writing an episode",
                format!("action {action:?} in row {row} of {rows}"),
                if last {
                    format!("{missing}: the last row is the final observation, from which no action is taken")
                } else {
                    "the action taken from this row's observation".to_owned()
                },
            ));
        }
    }
    Ok(())
}

/// The BLAKE3 hash of a dataset's content: of its episodes' lengths, then of every column and each of its rows.
///
/// `each_row` calls the function it is given with the stored bytes of every row of a column, in order.
///
/// # Errors
/// Those of `each_row`.
pub(crate) fn content_hash(
    rows: &Rows,
    columns: &[ColumnSpec],
    mut each_row: impl FnMut(&ColumnSpec, &mut dyn FnMut(&[u8])) -> Result<()>,
) -> Result<String> {
    let mut hasher = blake3::Hasher::new();
    let mut add = |bytes: &[u8]| {
        hasher.update(&(bytes.len() as u64).to_le_bytes());
        hasher.update(bytes);
    };
    for episode in rows.episodes() {
        add(&episode.index.to_le_bytes());
        add(&(episode.length as u64).to_le_bytes());
    }
    for column in columns {
        let described = serde_json::to_vec(column).map_err(|e| Error::external("describing a column", e))?;
        add(&described);
        each_row(column, &mut add)?;
    }
    Ok(hasher.finalize().to_hex().to_string())
}
