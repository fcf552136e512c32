//! Assembles batches from clips and goals: selects the rows, then reads each column with one call.

use crate::dataset::clips::ClipSpec;
use crate::dataset::goals::{GoalSpec, Goals};
use crate::dataset::reader::{Reader, StepRange};
use swm_core::columns::ACTION;
use swm_core::{Batch, ColumnSpec, DType, Key, Result, Schema};

/// Rows of a batch; the lists are reused between batches.
#[derive(Default)]
pub(crate) struct BatchRows {
    /// One range per clip: all rows of the clip.
    clips: Vec<StepRange>,
    /// One range per step of every clip: the row of the step's observation.
    step_rows: Vec<StepRange>,
    /// One range per clip: the row of the goal.
    goals: Vec<StepRange>,
}

impl BatchRows {
    pub fn clear(&mut self) {
        self.clips.clear();
    }

    pub fn extend(&mut self, clips: impl Iterator<Item = StepRange>) {
        self.clips.extend(clips);
    }
}

/// Fills batches with clips and their goals.
pub(crate) struct BatchFiller {
    clip: ClipSpec,
    goals: Vec<GoalSpec>,
    schema: Schema,
}

impl BatchFiller {
    pub fn new(dataset: &Schema, clip: ClipSpec, goals: Vec<GoalSpec>) -> Result<Self> {
        let mut columns = clip.schema(dataset)?.columns().to_vec();
        for goal in &goals {
            goal.check(&clip)?;
            for name in &goal.columns {
                let column = dataset.column(name)?;
                let shape: Vec<usize> = std::iter::once(1).chain(column.shape.iter().copied()).collect();
                columns.push(ColumnSpec::new(format!("{}_{name}", goal.name), column.dtype, shape));
            }
            columns.push(ColumnSpec::new(format!("{}_offset", goal.name), DType::Int64, []));
        }
        Ok(Self { clip, goals, schema: Schema::new(columns)? })
    }

    pub fn clip(&self) -> &ClipSpec {
        &self.clip
    }

    /// The columns of a batch.
    pub fn schema(&self) -> &Schema {
        &self.schema
    }

    /// The columns of the dataset to read.
    pub fn columns(&self) -> Vec<&str> {
        let mut names: Vec<&str> = vec![];
        for name in self.clip.columns.iter().chain(self.goals.iter().flat_map(|goal| &goal.columns)) {
            if !names.contains(&name.as_str()) {
                names.push(name);
            }
        }
        names
    }

    /// Number of rows, counted from a clip's first row, that an episode must have for the clip and its goals.
    pub fn reach(&self) -> usize {
        self.goals.iter().map(|goal| goal.reach(&self.clip)).fold(self.clip.span(), usize::max)
    }

    /// Reads a batch of clips. The goals of sample `i` are drawn with `key(i)`.
    pub fn fill(
        &self,
        reader: &dyn Reader,
        rows: &mut BatchRows,
        episodes: &Goals,
        key: impl Fn(usize) -> Key,
        out: &mut Batch,
    ) -> Result<()> {
        let BatchRows { clips, step_rows, goals } = rows;
        let (steps, skip) = (self.clip.num_steps, self.clip.frameskip);
        step_rows.clear();
        step_rows.extend(
            clips.iter().flat_map(|clip| (0..steps).map(|k| StepRange::new(clip.episode, clip.start + k * skip, 1))),
        );
        if out.rows() != clips.len() {
            out.resize(clips.len());
        }
        let mut column = 0;
        for name in &self.clip.columns {
            let ranges = if name == ACTION || skip == 1 { &*clips } else { &*step_rows };
            reader.read_column(name, ranges, out.bytes_mut(column))?;
            column += 1;
        }
        for goal in &self.goals {
            goals.clear();
            let offsets = column + goal.columns.len();
            for (i, clip) in clips.iter().enumerate() {
                let drawn = goal.draw(&self.clip, clip, episodes, key(i).with(&goal.name));
                goals.push(StepRange::new(drawn.episode, drawn.row, 1));
                out.row_mut(i).set(offsets, &[drawn.offset]);
            }
            for name in &goal.columns {
                reader.read_column(name, goals, out.bytes_mut(column))?;
                column += 1;
            }
            column += 1;
        }
        Ok(())
    }
}
