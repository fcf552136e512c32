//! Positions of episodes in a table of rows, index columns, and the checks of new episodes that all writers share.

use crate::dataset::reader::{Episode, StepRange};
use std::ops::Range;
use swm_core::columns::{ACTION, EPISODE_IDX, STEP_IDX};
use swm_core::{Batch, ColumnSpec, DType, EnvSpec, Error, Result, Schema};

/// A row to read, as `(position of its episode, step)`, and the bytes of the output that receive the row.
pub(crate) type RowSlot<'a> = ((usize, usize), &'a mut [u8]);

/// Lengths and first rows of the episodes of a dataset whose rows form one table.
#[derive(Clone, Debug, Default)]
pub(crate) struct EpisodeRows {
    episodes: Vec<Episode>,
    /// The first row of each episode.
    first_rows: Vec<u64>,
    total: u64,
}

impl EpisodeRows {
    /// Creates episodes with `lengths` that start at the rows `first`.
    ///
    /// # Errors
    /// If there are fewer first rows than lengths, or a value is negative or too large.
    pub fn from_lengths(lengths: &[i64], first: &[i64]) -> Result<Self, String> {
        let Some(first) = first.get(..lengths.len()) else {
            return Err(format!("there are {} episode lengths, but only {} first rows", lengths.len(), first.len()));
        };
        let mut rows = Self::default();
        let mut total = 0;
        for (episode, (&length, &first)) in lengths.iter().zip(first).enumerate() {
            let (Ok(length), Ok(first)) = (usize::try_from(length), u64::try_from(first)) else {
                return Err(format!("episode {episode} has {length} rows starting at row {first}"));
            };
            rows.push(length);
            rows.first_rows[episode] = first;
            let end = first.checked_add(length as u64).ok_or_else(|| format!("episode {episode} has too many rows"))?;
            total = total.max(end);
        }
        rows.total = total;
        Ok(rows)
    }

    /// Whether every episode starts where the previous one ends, so that episodes can be appended.
    pub fn is_contiguous(&self) -> bool {
        let mut next = 0;
        self.episodes.iter().zip(&self.first_rows).all(|(episode, &first)| {
            let fits = first == next;
            next = first + episode.length as u64;
            fits
        })
    }

    /// Appends an episode after the last row.
    pub fn push(&mut self, length: usize) {
        self.episodes.push(Episode { index: self.episodes.len() as i64, length });
        self.first_rows.push(self.total);
        self.total = self.total.saturating_add(length as u64);
    }

    /// Removes the episodes after the first `episodes`, which must be contiguous.
    pub fn truncate(&mut self, episodes: usize) {
        if let Some(&end) = self.first_rows.get(episodes) {
            self.total = end;
        }
        self.episodes.truncate(episodes);
        self.first_rows.truncate(episodes);
    }

    /// The episodes, in stored order.
    pub fn episodes(&self) -> &[Episode] {
        &self.episodes
    }

    /// Number of rows of all episodes.
    pub const fn total(&self) -> u64 {
        self.total
    }

    /// The first row of each episode.
    pub fn first_rows(&self) -> &[u64] {
        &self.first_rows
    }

    /// The rows of a range, counted from the first row of the table.
    ///
    /// # Errors
    /// If the rows do not exist.
    pub fn range(&self, range: &StepRange) -> Result<Range<u64>> {
        let end = range.start.checked_add(range.length);
        match self.episodes.get(range.episode) {
            Some(episode) if end.is_some_and(|end| end <= episode.length) => {
                let first = self.first_rows[range.episode] + range.start as u64;
                Ok(first..first + range.length as u64)
            }
            Some(episode) => Err(Error::mismatch(
                "reading rows",
                format!("{} rows from row {} of episode {}", range.length, range.start, range.episode),
                format!("rows below {}", episode.length),
            )),
            None => Err(Error::mismatch(
                "reading rows",
                format!("episode position {}", range.episode),
                format!("positions below {}", self.episodes.len()),
            )),
        }
    }

    /// Checks that `out` is as long as the requested rows of a column, and returns the number of rows.
    ///
    /// # Errors
    /// If `out` is longer or shorter.
    pub fn check_output(column: &ColumnSpec, ranges: &[StepRange], out: &[u8]) -> Result<usize> {
        let rows: usize = ranges.iter().map(|range| range.length).sum();
        let expected = rows * column.row_bytes();
        if out.len() == expected {
            return Ok(rows);
        }
        Err(Error::mismatch(
            format!("reading column '{}'", column.name),
            format!("an output of {} bytes", out.len()),
            format!("{expected} for {rows} rows"),
        ))
    }

    /// Pairs every requested row with its bytes in `out`; the pairs are sorted in stored order.
    ///
    /// # Errors
    /// If a row does not exist, or `out` has the wrong length.
    pub fn row_slots<'a>(
        &self,
        column: &ColumnSpec,
        ranges: &[StepRange],
        out: &'a mut [u8],
    ) -> Result<Vec<RowSlot<'a>>> {
        let rows = Self::check_output(column, ranges, out)?;
        let mut requested = Vec::with_capacity(rows);
        let mut slots = out.chunks_exact_mut(column.row_bytes());
        for range in ranges {
            self.range(range)?;
            let steps = range.start..range.start + range.length;
            requested.extend(steps.map(|step| (range.episode, step)).zip(slots.by_ref()));
        }
        requested.sort_by_key(|(row, _)| *row);
        Ok(requested)
    }

    /// Computes an index column (see [`index_columns`]) for `ranges`.
    ///
    /// # Errors
    /// If a row does not exist, or `out` has the wrong length.
    pub fn fill_index_column(&self, column: &ColumnSpec, ranges: &[StepRange], out: &mut [u8]) -> Result<()> {
        Self::check_output(column, ranges, out)?;
        let mut slots = out.chunks_exact_mut(column.dtype.size().max(1));
        for range in ranges {
            self.range(range)?;
            let index = self.episodes[range.episode].index;
            for (step, slot) in (range.start..range.start + range.length).zip(slots.by_ref()) {
                let value = if column.name == EPISODE_IDX { index } else { step as i64 };
                match column.dtype {
                    DType::Bool | DType::U8 => slot[0] = value as u8,
                    DType::Int32 => slot.copy_from_slice(&(value as i32).to_ne_bytes()),
                    DType::Int64 => slot.copy_from_slice(&value.to_ne_bytes()),
                    DType::Float32 => slot.copy_from_slice(&(value as f32).to_ne_bytes()),
                    DType::Float64 => slot.copy_from_slice(&(value as f64).to_ne_bytes()),
                }
            }
        }
        Ok(())
    }
}

/// Specs of the index columns [`EPISODE_IDX`] and [`STEP_IDX`]. Each is taken from `columns` if `columns` contains it
/// as a scalar; otherwise it is an `int32` scalar.
pub(crate) fn index_columns(columns: &[ColumnSpec]) -> [ColumnSpec; 2] {
    [EPISODE_IDX, STEP_IDX].map(|name| {
        let declared = columns.iter().find(|column| column.name == name && column.len() == 1);
        declared.cloned().unwrap_or_else(|| ColumnSpec::new(name, DType::Int32, []))
    })
}

/// Names, types and shapes of columns, for error messages.
pub(crate) fn describe_columns(columns: &[ColumnSpec]) -> String {
    let columns: Vec<String> = columns.iter().map(|c| format!("{} {}{:?}", c.name, c.dtype.name(), c.shape)).collect();
    columns.join(", ")
}

/// Checks that the columns of new episodes equal those of the dataset, in any order and ignoring index columns.
///
/// # Errors
/// If the columns differ.
pub(crate) fn check_appendable(dataset: &impl std::fmt::Display, incoming: &Schema, known: &Schema) -> Result<()> {
    let sorted = |schema: &Schema| {
        let mut columns: Vec<ColumnSpec> =
            schema.columns().iter().filter(|c| c.name != EPISODE_IDX && c.name != STEP_IDX).cloned().collect();
        columns.sort_by(|a, b| a.name.cmp(&b.name));
        columns
    };
    let (incoming, known) = (sorted(incoming), sorted(known));
    if incoming == known {
        return Ok(());
    }
    let expected = format!("the columns it has: {}", describe_columns(&known));
    Err(Error::mismatch(format!("appending to {dataset}"), describe_columns(&incoming), expected))
}

/// Checks that datasets can hold every action of an environment: none is the value that marks a missing action.
///
/// # Errors
/// If the actions are integers, and -1 in every element is one of them.
pub fn check_storable(spec: &EnvSpec) -> Result<()> {
    let space = &spec.action_space;
    let is_integer = matches!(space.dtype(), DType::Int32 | DType::Int64);
    let holds = |i| {
        let (low, high) = space.bounds(i);
        (low..=high).contains(&-1.0)
    };
    if !is_integer || space.is_empty() || !(0..space.len()).all(holds) {
        return Ok(());
    }
    let given =
        format!("the action space ({}) contains -1, which marks a missing action in datasets", space.describe());
    Err(Error::config(
        format!("collecting in {}", spec.id),
        given,
        "wrap the environment so that its actions start at 0",
    ))
}

/// Checks that an episode has the columns of the writer's schema and follows the time convention: the action of the
/// last row is missing, all other actions are present and finite.
///
/// # Errors
/// If the columns differ, there is no row, or an action breaks the time convention.
pub(crate) fn check_episode(episode: &Batch, schema: &Schema) -> Result<()> {
    check_rows(episode, schema, false)
}

/// Checks an episode as [`check_episode`], except that the last row may have an action as well.
///
/// # Errors
/// If the columns differ, there is no row, or an action is missing before the last row or not finite.
pub(crate) fn check_played_episode(episode: &Batch, schema: &Schema) -> Result<()> {
    check_rows(episode, schema, true)
}

fn check_rows(episode: &Batch, schema: &Schema, last_may_act: bool) -> Result<()> {
    if episode.schema() != schema {
        return Err(Error::mismatch(
            "writing an episode",
            describe_columns(episode.schema().columns()),
            describe_columns(schema.columns()),
        ));
    }
    let rows = episode.rows();
    if rows == 0 {
        return Err(Error::mismatch(
            "writing an episode",
            "an episode without rows",
            "at least the row of the final observation",
        ));
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
        let acts = !is_missing && action.iter().all(|v| v.is_finite());
        let valid = if last { is_missing || (last_may_act && acts) } else { acts };
        if !valid {
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

/// The BLAKE3 hash of a dataset's content: the lengths of its episodes, then every column with the stored bytes of its
/// rows.
///
/// `each_row` must call the function it receives with the stored bytes of every row of a column, in order.
///
/// # Errors
/// If `each_row` fails.
pub(crate) fn content_hash(
    rows: &EpisodeRows,
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

#[cfg(test)]
mod tests {
    use super::*;
    use swm_core::{Space, VariationSpace};

    #[test]
    fn actions_of_which_one_is_minus_one_in_every_element_are_refused() {
        let check = |action_space: Space| {
            check_storable(&EnvSpec {
                id: "test/Signed-v0".to_owned(),
                action_space,
                columns: vec![],
                observation_space: vec![],
                variation_space: VariationSpace::new(vec![], &[]),
                max_episode_steps: 1,
                cameras: vec![],
                angles: vec![],
            })
        };
        for space in [
            Space::Discrete { n: 3, start: -1 },
            Space::MultiDiscrete { nvec: vec![3, 4], start: vec![-1, -2] },
            Space::uniform_box([2], DType::Int32, -2.0, 2.0),
        ] {
            let message = check(space).expect_err("-1 is an action").to_string();
            assert!(message.contains("contains -1, which marks a missing action"), "{message}");
            assert!(message.contains("test/Signed-v0") && message.contains("start at 0"), "{message}");
        }
        for space in [
            Space::Discrete { n: 3, start: 0 },
            Space::Discrete { n: 3, start: -4 },
            Space::MultiDiscrete { nvec: vec![3, 4], start: vec![-1, 0] },
            Space::uniform_box([2], DType::Float32, -1.0, 1.0),
            Space::uniform_box([2], DType::U8, 0.0, 255.0),
        ] {
            check(space).expect("no action is -1 in every element");
        }
    }
}
