//! Clips: short windows of episodes, the samples that world models train on.
//!
//! A clip with `num_steps` steps and frameskip `f` that starts at row `s` covers `num_steps * f` rows of one episode.
//! Step `k` holds the observation of row `s + k * f` and the concatenated actions of the `f` rows from row `s + k * f`
//! on. The last row of an episode has no action (NaN or -1), so only the very last action of a clip can be missing;
//! models must ignore or replace it. The reference implementation's `Dataset` defines clips in the same way.

use crate::dataset::reader::{Episode, StepRange};
use swm_core::columns::ACTION;
use swm_core::{ColumnSpec, Error, Result, Schema};

/// Shape and columns of clips.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ClipSpec {
    /// Steps per clip.
    pub num_steps: usize,
    /// Rows from one step to the next.
    pub frameskip: usize,
    /// The columns to load.
    pub columns: Vec<String>,
}

impl ClipSpec {
    /// Number of rows that a clip covers.
    pub fn span(&self) -> usize {
        self.num_steps * self.frameskip
    }

    /// Checks the spec against a dataset and returns the columns of a batch of clips.
    ///
    /// # Shapes
    /// `[num_steps, shape…]` per clip; actions are `[num_steps, frameskip * action_dim]`.
    ///
    /// # Errors
    /// If `num_steps` or `frameskip` is 0, or a column does not exist.
    pub fn schema(&self, dataset: &Schema) -> Result<Schema> {
        for (name, value) in [("num_steps", self.num_steps), ("frameskip", self.frameskip)] {
            if value == 0 {
                return Err(Error::config(name, "0", "choose at least 1"));
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

/// All clips of some episodes, in order. Memory use is proportional to the number of episodes, not to the number of
/// clips.
#[derive(Clone, Debug)]
pub struct Clips {
    span: usize,
    /// `(position of the episode, number of preceding clips)` of each episode that is long enough.
    episodes: Vec<(usize, usize)>,
    total: usize,
}

impl Clips {
    /// Lists the clips of the episodes at `positions`.
    ///
    /// # Errors
    /// If a position does not exist, or no episode is long enough.
    pub fn new(spec: &ClipSpec, episodes: &[Episode], positions: &[usize]) -> Result<Self> {
        Self::reaching(spec, spec.span(), episodes, positions)
    }

    /// Lists the clips whose episode continues for at least `reach` rows from the clip's first row, so that a goal
    /// after the clip exists.
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
                    "none of the {} episodes is long enough for {} steps with frameskip {} ({reach} rows); the longest has {longest} rows",
                    positions.len(),
                    spec.num_steps,
                    spec.frameskip
                ),
                "use fewer steps or a smaller frameskip, or collect longer episodes",
            ));
        }
        Ok(clips)
    }

    /// Number of clips.
    pub fn len(&self) -> usize {
        self.total
    }

    /// Whether there are no clips. Constructors never return an empty set.
    pub fn is_empty(&self) -> bool {
        self.total == 0
    }

    /// The rows of a clip.
    ///
    /// # Panics
    /// If `clip` is not below [`Clips::len`].
    pub fn get(&self, clip: usize) -> StepRange {
        assert!(clip < self.total, "clip {clip} is outside a list of {} clips", self.total);
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
        fn clips_are_all_windows_within_the_selected_episodes(
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
    fn clip_schema_joins_the_actions_of_frameskip_rows() {
        let dataset = Schema::new([
            ColumnSpec::image("pixels", 4, 5),
            ColumnSpec::new("action", DType::Float32, [2]),
            ColumnSpec::new("reward", DType::Float64, []),
        ])
        .expect("creating the schema");
        let mut spec = ClipSpec {
            num_steps: 3,
            frameskip: 4,
            columns: ["action", "pixels", "reward"].map(str::to_owned).to_vec(),
        };
        let shapes: Vec<Vec<usize>> = spec
            .schema(&dataset)
            .expect("creating the schema of clips")
            .columns()
            .iter()
            .map(|c| c.shape.clone())
            .collect();
        assert_eq!(shapes, [vec![3, 8], vec![3, 4, 5, 3], vec![3]]);
        spec.columns.push("stat".to_owned());
        assert!(spec.schema(&dataset).expect_err("no such column").to_string().contains("unknown column 'stat'"));
        spec.frameskip = 0;
        assert!(spec.schema(&dataset).expect_err("a frameskip of 0").to_string().contains("frameskip"));
    }
}
