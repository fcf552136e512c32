//! [`NearestPolicy`]: repeats recorded actions from where the recordings are most like the present and the goal.
//!
//! It memorises a dataset and predicts nothing, so a model that solves no more starts has shown nothing but memory.

mod view;

use self::view::View;
use crate::baselines::check_actions;
use crate::starts::Starts;
use std::collections::HashMap;
use std::sync::Arc;
use swm_core::columns::ACTION;
use swm_core::policy::write_action;
use swm_core::{Batch, EnvSpec, Error, Key, Policy, Result, RowMut, RowRef, Schema};
use swm_data::{Reader, StepRange};

/// The number of actions between two searches.
const CHUNK: usize = 5;
/// The number of rows that are read at once, as far as episodes are shorter.
const ROWS: usize = 256;
/// The largest number of compared values of a dataset: 2 GiB.
const MAX_VALUES: usize = 1 << 29;

/// The rows of a dataset in the form in which they are searched.
pub(crate) struct Recordings {
    view: View,
    /// The number of values of a row.
    dim: usize,
    /// `[rows, dim]`, differences from `origin`, scaled.
    values: Vec<f32>,
    /// The state in the first row, `[dim]`, so that an offset of all states does not matter; zeros for frames.
    origin: Vec<f64>,
    /// The factor of each value, `[dim]`.
    scale: Vec<f32>,
    /// The actions, `[rows, action dim]`.
    actions: Vec<f32>,
    episodes: Vec<Episode>,
}

/// The rows of an episode in [`Recordings`].
struct Episode {
    /// The position of the episode in the dataset.
    position: usize,
    /// Its first row.
    first: usize,
    /// The number of its rows, with the last one, which has no action.
    rows: usize,
}

impl Recordings {
    /// Reads the episodes at these positions. `infos` are the columns of the environments that are played.
    ///
    /// States are compared if the environment has the columns `state` and `goal_state` and the dataset a `state` of the
    /// same shape, and frames otherwise.
    ///
    /// # Errors
    /// When the dataset has other actions than the environment, there is neither a state nor a frame to compare, the values
    /// do not fit into memory, or the stored data is damaged.
    pub(crate) fn read(spec: &EnvSpec, infos: &Schema, reader: &dyn Reader, positions: &[usize]) -> Result<Self> {
        check_actions(spec, reader.schema().column(ACTION)?)?;
        let view = View::of(spec, infos, reader.schema())?;
        let dim = view.dim();
        let lengths = positions.iter().map(|&position| (position, reader.episodes()[position].length));
        let found: Vec<(usize, usize)> = lengths.filter(|&(_, rows)| rows > 1).collect();
        let rows = found.iter().fold(0_usize, |sum, (_, rows)| sum.saturating_add(*rows));
        let too_many = || {
            let fix = "take starts from a dataset with fewer episodes";
            Error::config("policy 'nearest'", format!("{rows} rows of {dim} values are too many to compare"), fix)
        };
        let mut recordings = Self {
            origin: vec![],
            scale: vec![1.0; dim],
            values: vec![],
            actions: vec![],
            episodes: vec![],
            view,
            dim,
        };
        let count = rows.checked_mul(dim).filter(|&count| count <= MAX_VALUES).ok_or_else(too_many)?;
        recordings.values.try_reserve_exact(count).map_err(|_| too_many())?;
        recordings.actions.try_reserve_exact(rows.saturating_mul(spec.action_dim())).map_err(|_| too_many())?;
        let mut pending: Vec<StepRange> = vec![];
        for (i, &(position, rows)) in found.iter().enumerate() {
            pending.push(StepRange::new(position, 0, rows));
            if pending.iter().map(|range| range.length).sum::<usize>() >= ROWS || i + 1 == found.len() {
                recordings.append(reader, &pending)?;
                pending.clear();
            }
        }
        recordings.standardise();
        Ok(recordings)
    }

    fn append(&mut self, reader: &dyn Reader, ranges: &[StepRange]) -> Result<()> {
        let column = self.view.column();
        let read = reader.read(&[column, ACTION], ranges)?;
        let mut values = vec![0.0; self.dim];
        for row in 0..read.rows() {
            self.view.write(read.row(row), 0, &mut values);
            if self.origin.is_empty() {
                let is_state = matches!(self.view, View::State { .. });
                let of_value = |value: &f64| if is_state && value.is_finite() { *value } else { 0.0 };
                self.origin = values.iter().map(of_value).collect();
            }
            self.values.extend(values.iter().zip(&self.origin).map(|(value, origin)| (value - origin) as f32));
        }
        self.actions.extend(read.to_f32(ACTION)?);
        for range in ranges {
            let first = self.episodes.last().map_or(0, |last| last.first + last.rows);
            self.episodes.push(Episode { position: range.episode, first, rows: range.length });
        }
        Ok(())
    }

    /// Divides each value of a state by its standard deviation; a value that never changes is not compared.
    fn standardise(&mut self) {
        if matches!(self.view, View::Frame { .. }) {
            return;
        }
        let n = (self.values.len() / self.dim.max(1)).max(1) as f64;
        for (i, scale) in self.scale.iter_mut().enumerate() {
            let of_rows = || self.values.iter().skip(i).step_by(self.dim).map(|&value| f64::from(value));
            let mean = of_rows().sum::<f64>() / n;
            let deviation = (of_rows().map(|value| (value - mean).powi(2)).sum::<f64>() / n).sqrt();
            let mean = mean + self.origin.get(i).copied().unwrap_or_default();
            let changes = self.view.changes(deviation, mean);
            *scale = if changes { (1.0 / deviation) as f32 } else { 0.0 };
        }
        for row in self.values.chunks_exact_mut(self.dim.max(1)) {
            scaled(row, &self.scale);
        }
    }

    /// Converts values as they are to those that are compared.
    fn compare(&self, values: &[f64], to: &mut [f32]) {
        let of_values = values.iter().zip(&self.origin).zip(&self.scale);
        to.iter_mut().zip(of_values).for_each(|(to, ((value, origin), scale))| *to = (value - origin) as f32 * scale);
    }

    /// The row, outside of the episode at the position `except`, for which this row and the one `offset` rows later are
    /// nearest to `now` and `goal`, and the sum of the squared distances. The first of equally near rows; `None` if no other
    /// episode has such rows.
    ///
    /// # Shapes
    /// `now` and `goal` are `[dim]`.
    fn nearest(&self, now: &[f32], goal: &[f32], offset: usize, except: usize) -> Option<(usize, f32)> {
        let row = |index: usize| &self.values[index * self.dim..][..self.dim];
        let mut best: Option<(usize, f32)> = None;
        for episode in self.episodes.iter().filter(|episode| episode.position != except) {
            for index in episode.first..episode.first + episode.rows.saturating_sub(offset) {
                let least = best.map_or(f32::INFINITY, |(_, least)| least);
                let of_now = squared_distance(now, row(index));
                if of_now < least {
                    let distance = of_now + squared_distance(goal, row(index + offset));
                    if distance < least {
                        best = Some((index, distance));
                    }
                }
            }
        }
        best
    }

    /// Whether there is a row with another one `offset` rows later outside of the episode at a position.
    fn has_others(&self, offset: usize, except: usize) -> bool {
        self.episodes.iter().any(|episode| episode.position != except && episode.rows > offset)
    }
}

fn scaled(values: &mut [f32], scale: &[f32]) {
    for (value, scale) in values.iter_mut().zip(scale) {
        *value *= scale;
    }
}

/// The squared distance of two rows, summed in an order that does not depend on the processor.
fn squared_distance(a: &[f32], b: &[f32]) -> f32 {
    const LANES: usize = 8;
    let mut lanes = [0.0_f32; LANES];
    let (whole_a, whole_b) = (a.chunks_exact(LANES), b.chunks_exact(LANES));
    let rest = whole_a.remainder().iter().zip(whole_b.remainder());
    for (a, b) in whole_a.zip(whole_b) {
        for (lane, (a, b)) in lanes.iter_mut().zip(a.iter().zip(b)) {
            *lane += (a - b) * (a - b);
        }
    }
    rest.map(|(a, b)| (a - b) * (a - b)).sum::<f32>() + lanes.iter().sum::<f32>()
}

/// Searches the dataset that the starts come from for the rows nearest to the present and the goal, and repeats the actions
/// that followed them.
///
/// A goal is recorded `goal_offset` rows after its start. After `k` steps, the policy searches for a row whose state is
/// nearest to the present one while the state `goal_offset - k` rows later is nearest to the goal, and plays its next
/// `CHUNK` actions. After `goal_offset` steps it begins again with the whole offset. The episode that a start comes from is
/// never searched: it holds the solution.
pub struct NearestPolicy {
    recordings: Arc<Recordings>,
    goal_offset: usize,
    /// The position of the episode that each start comes from, by the key of its start.
    sources: HashMap<Key, usize>,
    slots: Vec<Slot>,
}

/// The episode of a slot.
#[derive(Default)]
struct Slot {
    /// The position of the episode that the start comes from; `None` for a start of another evaluation.
    source: Option<usize>,
    /// The number of actions so far.
    step: usize,
    /// The recorded row whose action is next, and the number of actions before the next search.
    next: (usize, usize),
    /// The values of the present and of the goal, `[2, dim]`.
    query: Vec<f32>,
    /// The values of one of them as they are, `[dim]`.
    values: Vec<f64>,
    action: Vec<f64>,
    failed: Option<Error>,
}

impl NearestPolicy {
    /// A policy for these starts in `slots` environments.
    ///
    /// # Errors
    /// When the starts do not come from a dataset, or no other episode than that of a start is long enough.
    pub(crate) fn new(spec: &EnvSpec, slots: usize, starts: &Starts, recordings: Arc<Recordings>) -> Result<Self> {
        let goal_offset = starts.goal_offset().unwrap_or_default().max(1);
        let mut sources = HashMap::new();
        for start in 0..starts.len() {
            let Some([episode, _]) = starts.pick(start) else { continue };
            if !recordings.has_others(goal_offset, episode) {
                let problem = format!(
                    "no episode but number {episode}, from which a start comes, has rows that are {goal_offset} steps apart"
                );
                let fix = "collect more episodes, or lower the goal offset";
                return Err(Error::config("policy 'nearest'", problem, fix));
            }
            sources.insert(starts.key(start), episode);
        }
        let slot = || Slot {
            query: vec![0.0; 2 * recordings.dim],
            values: vec![0.0; recordings.dim],
            action: vec![0.0; spec.action_dim()],
            ..Slot::default()
        };
        Ok(Self { slots: (0..slots).map(|_| slot()).collect(), recordings, goal_offset, sources })
    }
}

impl Policy for NearestPolicy {
    fn begin(&mut self, slot: usize, key: Key) {
        let slot = &mut self.slots[slot];
        (slot.source, slot.step, slot.next) = (self.sources.get(&key).copied(), 0, (0, 0));
    }

    fn act(&mut self, infos: &Batch, active: &[bool], actions: &mut Batch) -> Result<()> {
        let (recordings, goal_offset) = (&*self.recordings, self.goal_offset);
        let columns = [recordings.view.column(), recordings.view.goal()].map(|name| infos.schema().index(name));
        let [now, goal] = columns;
        let (columns, action) = ([now?, goal?], actions.schema().index(ACTION)?);
        let work = |index: usize, mut row: RowMut<'_>, slot: &mut Slot| {
            if active[index] {
                slot.failed = slot.act(recordings, goal_offset, infos.row(index), columns).err();
                write_action(&mut row, action, &slot.action);
            }
        };
        actions.par_zip_mut(&mut self.slots, work);
        self.slots.iter_mut().find_map(|slot| slot.failed.take()).map_or(Ok(()), Err)
    }
}

impl Slot {
    /// Sets the next action, after a search if the last one is used up. `columns` are those of the present and the goal.
    fn act(&mut self, of: &Recordings, goal_offset: usize, row: RowRef<'_>, columns: [usize; 2]) -> Result<()> {
        if self.next.1 == 0 {
            let (now, goal) = self.query.split_at_mut(of.dim);
            for (column, query) in columns.into_iter().zip([&mut *now, &mut *goal]) {
                of.view.write(row, column, &mut self.values);
                of.compare(&self.values, query);
            }
            let remaining = goal_offset - self.step % goal_offset;
            let found = self.source.and_then(|source| of.nearest(now, goal, remaining, source));
            let (found, _) = found.ok_or_else(|| {
                let problem = "its start comes from no episode of the dataset, or its state or frame is not finite";
                Error::config("policy 'nearest'", problem, "check the dataset (`swm doctor`)")
            })?;
            self.next = (found, CHUNK.min(remaining));
        }
        let recorded = &of.actions[self.next.0 * self.action.len()..][..self.action.len()];
        for (to, &from) in self.action.iter_mut().zip(recorded) {
            *to = from.into();
        }
        self.next = (self.next.0 + 1, self.next.1 - 1);
        self.step += 1;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use swm_core::columns::STATE;
    use swm_core::{ColumnSpec, DType};
    use swm_data::{Constants, ReplayBuffer};

    /// Recordings of states of one dimension, which are scaled by 1.
    fn recordings(episodes: &[&[f32]]) -> Recordings {
        let mut first = 0;
        let of = episodes.iter().enumerate().map(|(position, values)| {
            first += values.len();
            Episode { position, first: first - values.len(), rows: values.len() }
        });
        Recordings {
            view: View::State { len: 1, angles: vec![], single: false },
            dim: 1,
            origin: vec![0.0],
            scale: vec![1.0],
            episodes: of.collect(),
            actions: vec![],
            values: episodes.concat(),
        }
    }

    #[test]
    fn the_first_of_equally_near_rows_outside_of_the_own_episode_is_found() {
        let data = recordings(&[&[0.0, 1.0, 2.0, 3.0], &[5.0, 1.0, 3.0], &[1.0, 0.0, 3.0, 9.0], &[1.0]]);
        // From 1 to 3 in two rows: exactly in episodes 0 (row 1) and 2 (row 7).
        assert_eq!(data.nearest(&[1.0], &[3.0], 2, 9), Some((1, 0.0)));
        assert_eq!(data.nearest(&[1.0], &[3.0], 2, 0), Some((7, 0.0)));
        assert_eq!(data.nearest(&[1.0], &[3.0], 1, 0), Some((5, 0.0)), "the next row");
        // (2 - 1)² + (3 - 8)² = 26 beats (1 - 1)² + ...; checked by hand: row 8 has (0 - 1)² + (9 - 8)² = 2.
        assert_eq!(data.nearest(&[1.0], &[8.0], 2, 0), Some((8, 2.0)));
        assert_eq!(data.nearest(&[1.0], &[3.0], 4, 9), None, "no episode has five rows");
        assert_eq!(data.nearest(&[f32::NAN], &[3.0], 2, 9), None);
        assert!(data.has_others(3, 0) && !data.has_others(4, 0));
    }

    #[test]
    fn distances_of_any_length_are_those_of_the_definition() {
        for len in [0, 1, 7, 8, 9, 256] {
            let [a, b]: [Vec<f32>; 2] = [3, 5].map(|k| (0..len).map(|i| ((i * k) % 11) as f32).collect());
            // Sums of small integers have no rounding.
            let expected: f32 = a.iter().zip(&b).map(|(a, b)| (a - b).powi(2)).sum();
            assert_eq!(squared_distance(&a, &b), expected, "{len} values");
        }
    }

    #[test]
    fn an_offset_of_all_states_does_not_matter() {
        let column = |name: &str, dtype| ColumnSpec::new(name, dtype, [1]);
        let schema = Schema::new([column(STATE, DType::Float64), column(ACTION, DType::Float32)]).expect("a schema");
        let values = |offset: f64| {
            let mut rows = Batch::zeros(&schema, 3);
            for (row, state) in [0.0, 0.25, 0.5].into_iter().enumerate() {
                rows.row_mut(row).set(0, &[state + offset]);
            }
            rows.row_mut(2).set(1, &[f32::NAN]);
            let replay = ReplayBuffer::new(&schema, 10).expect("a buffer");
            replay.add(&rows, &Constants::default()).expect("an episode");
            let mut data = recordings(&[]);
            data.origin.clear();
            data.append(&*replay.snapshot(), &[StepRange::new(0, 0, 3)]).expect("its rows");
            data.standardise();
            let mut query = [0.0];
            data.compare(&[0.25 + offset], &mut query);
            assert_eq!(query[0], data.values[1]);
            data.values
        };
        assert_eq!(values(f64::from(1 << 30)), values(0.0));
        let data = recordings(&[]);
        let single = View::State { len: 1, angles: vec![], single: true };
        assert!(data.view.changes(0.2, 1e9) && !data.view.changes(0.01, 1e9) && !data.view.changes(1e-7, 1.0));
        assert!(data.view.changes(1e-5, 300.0) && !single.changes(1e-5, 300.0), "the noise of single precision");
    }

    #[test]
    fn values_that_never_change_are_not_compared() {
        let mut data = recordings(&[&[4.0, 1.0, 4.0, 3.0, 4.0, 5.0]]);
        (data.dim, data.scale, data.origin) = (2, vec![1.0; 2], vec![0.0; 2]);
        data.standardise();
        // The variance of 1, 3, 5 is 8 / 3.
        assert_eq!(data.scale[0], 0.0);
        assert!((data.scale[1] - (3.0_f32 / 8.0).sqrt()).abs() < 1e-6);
        assert!((data.values[5] - 5.0 * (3.0_f32 / 8.0).sqrt()).abs() < 1e-5 && data.values[4] == 0.0);
    }
}
