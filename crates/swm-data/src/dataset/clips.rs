//! Clips: short windows of an episode, the unit that world models train on.
//!
//! A clip of `num_steps` steps with frameskip `f` that begins at row `s` covers the `num_steps * f` rows from
//! `s`, all of one episode. Step `k` shows row `s + k * f` and carries the `f` actions of rows
//! `s + k * f .. s + (k + 1) * f`, one after another. The last row of an episode has no action (NaN or -1), so
//! only the very last action of a clip can be missing: models must ignore or replace it. This is the rule of
//! the reference's `Dataset`, so both see the same clips.

use crate::dataset::reader::{Episode, StepRange};
use swm_core::{ColumnSpec, Error, Result, Schema};

/// The column whose skipped rows are kept, grouped with their step.
pub const ACTION: &str = "action";

/// What a clip holds.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ClipSpec {
    /// Frames in a clip.
    pub num_steps: usize,
    /// Rows from one frame to the next.
    pub frameskip: usize,
    /// The columns to load.
    pub columns: Vec<String>,
}

impl ClipSpec {
    /// Rows that a clip covers.
    pub fn span(&self) -> usize {
        self.num_steps * self.frameskip
    }

    /// Checks that it describes clips of this dataset, and gives the columns of a batch of clips: `[num_steps,
    /// shape…]`, for actions `[num_steps, frameskip * numbers]`.
    ///
    /// # Errors
    /// When a count is zero or a column does not exist.
    pub fn schema(&self, dataset: &Schema) -> Result<Schema> {
        for (name, value) in [("num_steps", self.num_steps), ("frameskip", self.frameskip)] {
            if value == 0 {
                return Err(Error::config(name, "it is 0", "clips need at least one"));
            }
        }
        let columns: Result<Vec<ColumnSpec>> = self
            .columns
            .iter()
            .map(|name| {
                let column = dataset.column(name)?;
                let shape = if name == ACTION {
                    vec![self.num_steps, self.frameskip * column.len()]
                } else {
                    std::iter::once(self.num_steps).chain(column.shape.iter().copied()).collect()
                };
                Ok(ColumnSpec::new(name, column.dtype, shape))
            })
            .collect();
        Schema::new(columns?)
    }
}

/// All clips of some episodes, in order. Holds one number an episode, however many clips there are.
#[derive(Clone, Debug)]
pub struct Clips {
    span: usize,
    /// `(position of the episode, clips before it)`, episodes long enough for a clip only.
    episodes: Vec<(usize, usize)>,
    total: usize,
}

impl Clips {
    /// The clips of the episodes at these positions.
    ///
    /// # Errors
    /// When a position does not exist, or none of the episodes is long enough.
    pub fn new(spec: &ClipSpec, episodes: &[Episode], positions: &[usize]) -> Result<Self> {
        Self::reaching(spec, spec.span(), episodes, positions)
    }

    /// The clips whose episode goes on until `reach` rows from their first one at least, such as for a goal that comes
    /// after them.
    ///
    /// # Errors
    /// As [`Clips::new`].
    pub fn reaching(spec: &ClipSpec, reach: usize, episodes: &[Episode], positions: &[usize]) -> Result<Self> {
        let (span, reach) = (spec.span(), reach.max(spec.span()));
        let mut clips = Self { span, episodes: vec![], total: 0 };
        for &position in positions {
            let Some(episode) = episodes.get(position) else {
                return Err(Error::mismatch(
                    "choosing episodes",
                    format!("position {position}"),
                    format!("positions below {}", episodes.len()),
                ));
            };
            if episode.length >= reach {
                clips.episodes.push((position, clips.total));
                clips.total += episode.length - reach + 1;
            }
        }
        if clips.total == 0 {
            let longest = positions.iter().map(|&p| episodes[p].length).max().unwrap_or(0);
            return Err(Error::config(
                "clips",
                format!(
                    "none of the {} episodes is long enough for {} steps with frameskip {} ({reach} rows); the longest has {longest}",
                    positions.len(),
                    spec.num_steps,
                    spec.frameskip
                ),
                "ask for fewer steps or a smaller frameskip, or collect longer episodes",
            ));
        }
        Ok(clips)
    }

    /// How many clips there are.
    pub fn len(&self) -> usize {
        self.total
    }

    /// Whether there is none; never true of one that was made.
    pub fn is_empty(&self) -> bool {
        self.total == 0
    }

    /// The rows of a clip.
    ///
    /// # Panics
    /// When there are not that many clips.
    pub fn get(&self, clip: usize) -> StepRange {
        assert!(clip < self.total, "clip {clip} of {}", self.total);
        let at = self.episodes.partition_point(|&(_, before)| before <= clip) - 1;
        let (episode, before) = self.episodes[at];
        StepRange::new(episode, clip - before, self.span)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use swm_core::DType;

    proptest! {
        #[test]
        fn clips_are_all_windows_and_never_cross_episodes(
            lengths in prop::collection::vec(1usize..40, 1..12),
            num_steps in 1usize..5,
            frameskip in 1usize..6,
            skip in 0usize..3,
        ) {
            let spec = ClipSpec { num_steps, frameskip, columns: vec![] };
            let episodes: Vec<Episode> =
                lengths.iter().enumerate().map(|(i, &length)| Episode { index: i as i64, length }).collect();
            let positions: Vec<usize> = (0..episodes.len()).step_by(skip + 1).collect();
            let mut expected = vec![];
            for &p in &positions {
                for start in 0..lengths[p] {
                    if start + spec.span() <= lengths[p] {
                        expected.push(StepRange::new(p, start, spec.span()));
                    }
                }
            }
            match Clips::new(&spec, &episodes, &positions) {
                Ok(clips) => {
                    let all: Vec<StepRange> = (0..clips.len()).map(|i| clips.get(i)).collect();
                    prop_assert_eq!(all, expected);
                }
                Err(error) => {
                    prop_assert!(expected.is_empty());
                    prop_assert!(error.to_string().contains("long enough"));
                }
            }
        }
    }

    #[test]
    fn actions_are_grouped_with_their_step() {
        let dataset = Schema::new([
            ColumnSpec::image("pixels", 4, 5),
            ColumnSpec::new("action", DType::Float32, [2]),
            ColumnSpec::new("reward", DType::Float64, []),
        ])
        .expect("schema");
        let mut spec = ClipSpec {
            num_steps: 3,
            frameskip: 4,
            columns: ["action", "pixels", "reward"].map(str::to_owned).to_vec(),
        };
        let shapes: Vec<Vec<usize>> =
            spec.schema(&dataset).expect("clips").columns().iter().map(|c| c.shape.clone()).collect();
        assert_eq!(shapes, [vec![3, 8], vec![3, 4, 5, 3], vec![3]]);
        spec.columns.push("stat".to_owned());
        assert!(spec.schema(&dataset).expect_err("no such column").to_string().contains("unknown column 'stat'"));
        spec.frameskip = 0;
        assert!(spec.schema(&dataset).expect_err("no step").to_string().contains("frameskip"));
    }
}
