//! [`View`]: what of a row `nearest` compares: the state, or the frame.

use swm_core::columns::{GOAL, GOAL_STATE, PIXELS, STATE};
use swm_core::{ColumnSpec, DType, EnvSpec, Error, Result, RowRef, Schema};

/// The largest side of the grey frames that are compared, in cells.
const SIDE: usize = 16;

/// What of a row is compared.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum View {
    /// The column `state`, whose `angles` are replaced by their sines and cosines. Each value is divided by its standard
    /// deviation in the dataset.
    State {
        len: usize,
        angles: Vec<usize>,
        /// Whether one of the compared columns has single precision.
        single: bool,
    },
    /// The frame: the mean brightness of each of `side` x `side` cells.
    Frame { side: usize },
}

impl View {
    pub(super) fn of(spec: &EnvSpec, infos: &Schema, stored: &Schema) -> Result<Self> {
        let own = |name: &str| infos.find(name).map(|index| &infos.columns()[index]);
        let recorded = |name: &str| stored.find(name).map(|index| &stored.columns()[index]);
        let is_float = |column: &ColumnSpec| matches!(column.dtype, DType::Float32 | DType::Float64);
        if let (Some(now), Some(goal), Some(state)) = (own(STATE), own(GOAL_STATE), recorded(STATE))
            && [now, goal, state].iter().all(|column| is_float(column) && column.shape == now.shape)
        {
            let of_state = spec.angles.iter().filter(|(column, _)| *column == STATE);
            let angles = of_state.map(|&(_, element)| element).collect();
            let single = [now, goal, state].iter().any(|column| column.dtype == DType::Float32);
            return Ok(Self::State { len: now.len(), angles, single });
        }
        if let (Some(now), Some(goal), Some(frame)) = (own(PIXELS), own(GOAL), recorded(PIXELS))
            && [now, goal, frame].iter().all(|column| column.is_image())
        {
            let sides = [now, goal, frame].into_iter().flat_map(|column| [column.shape[0], column.shape[1]]);
            return Ok(Self::Frame { side: sides.fold(SIDE, usize::min) });
        }
        let problem = format!("{} and the dataset share neither states, with those of goals, nor frames", spec.id);
        Err(Error::config("policy 'nearest'", problem, "collect a dataset in this environment with frames (--image)"))
    }

    /// Whether a standard deviation is more than the noise of a simulator in values around `mean`. A column of double precision may
    /// have a large offset.
    pub(super) fn changes(&self, deviation: f64, mean: f64) -> bool {
        let noise = match self {
            Self::State { single: false, .. } => (1e-6 * mean.abs().clamp(1e-6, 1.0)).max(1e-10 * mean.abs()),
            _ => 1e-6 * mean.abs().max(1e-6),
        };
        deviation > noise
    }

    /// The column that a dataset stores.
    pub(super) fn column(&self) -> &'static str {
        match self {
            Self::State { .. } => STATE,
            Self::Frame { .. } => PIXELS,
        }
    }

    /// The column of the goal in an environment.
    pub(super) fn goal(&self) -> &'static str {
        match self {
            Self::State { .. } => GOAL_STATE,
            Self::Frame { .. } => GOAL,
        }
    }

    pub(super) fn dim(&self) -> usize {
        match self {
            Self::State { len, angles, .. } => len + angles.len(),
            Self::Frame { side } => side * side,
        }
    }

    /// Writes the values of a column of a row, as they are: `[dim]`.
    pub(super) fn write(&self, row: RowRef<'_>, column: usize, values: &mut [f64]) {
        match self {
            Self::State { angles, .. } => match row.schema().columns()[column].dtype {
                DType::Float32 => write_state(row.at::<f32>(column).iter().map(|&v| f64::from(v)), angles, values),
                _ => write_state(row.at::<f64>(column).iter().copied(), angles, values),
            },
            Self::Frame { side } => {
                let shape = &row.schema().columns()[column].shape;
                write_frame(row.at::<u8>(column), [shape[0], shape[1]], *side, values);
            }
        }
    }
}

fn write_state(state: impl Iterator<Item = f64>, angles: &[usize], values: &mut [f64]) {
    let mut at = values.iter_mut();
    let mut put = |value: f64| {
        if let Some(to) = at.next() {
            *to = value;
        }
    };
    for (i, value) in state.enumerate() {
        if angles.contains(&i) {
            put(value.sin());
            put(value.cos());
        } else {
            put(value);
        }
    }
}

/// Writes the mean brightness, 0 to 1, of `side` x `side` cells of an image `[height, width, 3]`.
fn write_frame(rgb: &[u8], [height, width]: [usize; 2], side: usize, values: &mut [f64]) {
    let edge = |cell: usize, length: usize| cell * length / side;
    for (cell, value) in values.iter_mut().enumerate() {
        let (y, x) = (cell / side, cell % side);
        let (top, bottom) = (edge(y, height), edge(y + 1, height));
        let (left, right) = (edge(x, width), edge(x + 1, width));
        let sum: u64 = (top..bottom)
            .map(|line| {
                rgb[3 * (line * width + left)..3 * (line * width + right)].iter().map(|&v| u64::from(v)).sum::<u64>()
            })
            .sum();
        let count = 3 * (bottom - top) * (right - left);
        *value = sum as f64 / (255 * count.max(1)) as f64;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn states_are_compared_before_frames() {
        let spec = EnvSpec {
            id: "test/Env-v0".to_owned(),
            action_space: swm_core::Space::uniform_box([1], DType::Float32, -1.0, 1.0),
            columns: vec![],
            observation_space: vec![],
            variation_space: swm_core::VariationSpace::new(vec![], &[]),
            max_episode_steps: 9,
            cameras: vec![],
            angles: vec![(STATE, 1), (GOAL_STATE, 1), ("other", 0)],
        };
        let state = |name: &str, len: usize| ColumnSpec::new(name, DType::Float64, [len]);
        let frame = |name: &str, side| ColumnSpec::image(name, side, 40);
        let schema = |columns: Vec<ColumnSpec>| Schema::new(columns).expect("a schema");
        let own = schema(vec![state(STATE, 3), state(GOAL_STATE, 3), frame(PIXELS, 30), frame(GOAL, 30)]);
        let view = |own: &Schema, stored: Vec<ColumnSpec>| View::of(&spec, own, &schema(stored));
        let found = view(&own, vec![state(STATE, 3), frame(PIXELS, 30)]).expect("a view");
        assert_eq!((&found, found.dim()), (&View::State { len: 3, angles: vec![1], single: false }, 4));
        let found = view(&own, vec![state(STATE, 2), frame(PIXELS, 12)]).expect("a view");
        assert_eq!((&found, found.dim()), (&View::Frame { side: 12 }, 144));
        let found = view(&schema(vec![frame(PIXELS, 30), frame(GOAL, 30)]), vec![state(STATE, 3), frame(PIXELS, 90)]);
        assert_eq!(found.expect("a view"), View::Frame { side: SIDE });
        let error = view(&own, vec![state(STATE, 2)]).expect_err("nothing in common");
        assert!(error.is_usage() && error.to_string().contains("frames"), "{error}");
    }

    #[test]
    fn frames_of_any_size_become_the_mean_brightness_of_cells() {
        // The left half is white; 5 columns: cells of 2 and 3 columns.
        let image = |[height, width]: [usize; 2]| -> Vec<u8> {
            (0..height * width).flat_map(|i| [if i % width < 2 { 255 } else { 0 }; 3]).collect()
        };
        let mut values = [9.0; 4];
        write_frame(&image([3, 5]), [3, 5], 2, &mut values);
        assert_eq!(values, [1.0, 0.0, 1.0, 0.0]);
        write_frame(&image([4, 8]), [4, 8], 2, &mut values);
        assert_eq!(values, [0.5, 0.0, 0.5, 0.0]);
    }

    #[test]
    fn angles_are_compared_on_the_circle() {
        let mut values = [0.0; 4];
        write_state([7.0, std::f64::consts::PI, 2.0].into_iter(), &[1], &mut values);
        assert!(values[0] == 7.0 && values[1].abs() < 1e-6 && values[2] == -1.0 && values[3] == 2.0, "{values:?}");
    }
}
