//! [`DatasetInfo`]: the statistics of a dataset that a model needs to scale actions and columns.

use crate::nn::parameters::Named;
use burn::tensor::{Device, Tensor, TensorData};
use serde::{Deserialize, Serialize};
use swm_core::columns::{ACTION, PIXELS, REWARD, TERMINATED};
use swm_core::{Batch, ColumnSpec, DType, EnvSpec, Error, Result, Space, precision};
use swm_data::{Reader, column_stats};
use swm_plan::ActionScale;

/// The standard deviation, beside the magnitude of the values, up to which they are constant but for noise.
const RELATIVE_NOISE: f64 = 1e-3;

/// The statistics of the dataset a model was trained on; stored in its checkpoint.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DatasetInfo {
    /// The map between the actions of the environment and the actions of the model.
    pub action: ActionScale,
    /// The statistics of the numeric columns that the model observes, except actions.
    pub columns: Named<ColumnInfo>,
    /// The environment the data came from, if the dataset names it.
    pub env: Option<String>,
}

/// The statistics of a column, one value for each element of a row.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ColumnInfo {
    /// The shape of a row.
    pub shape: Vec<usize>,
    /// The mean.
    pub mean: Vec<f64>,
    /// The standard deviation.
    pub std: Vec<f64>,
    /// The minimum.
    pub min: Vec<f64>,
    /// The maximum.
    pub max: Vec<f64>,
}

impl ColumnInfo {
    /// The number of elements of a row.
    pub fn dim(&self) -> usize {
        self.mean.len()
    }

    /// The standard deviation, replaced by 1 for elements that are constant, so that it can be a divisor.
    pub fn spread(&self) -> Vec<f64> {
        self.std.iter().map(|&std| if std > precision::CONSTANT { std } else { 1.0 }).collect()
    }

    /// Computes the statistics of a column, which must be finite.
    fn of(reader: &dyn Reader, spec: &ColumnSpec) -> Result<Self> {
        let stats = column_stats(reader, &spec.name, None)?;
        // Models compute with single precision.
        let is_usable = |value: &f64| (*value as f32).is_finite();
        if !stats.mean.iter().chain(&stats.std).all(is_usable) {
            let given = format!("has means {:?} and standard deviations {:?}", stats.mean, stats.std);
            let fix =
                "remove or repair the episodes with infinite or huge values, which `swm inspect` shows in the ranges";
            return Err(Error::config(format!("column '{}' of the training data", spec.name), given, fix));
        }
        // The last row of an episode may have no action.
        if spec.name == ACTION && stats.incomplete > 0 {
            let given = format!("has NaN in {} rows before the last of their episode", stats.incomplete);
            let fix = "remove or repair these episodes, which `swm doctor` lists; an action stands in the row of the \
                       observation in which it was taken";
            return Err(Error::config(format!("column '{ACTION}' of the training data"), given, fix));
        }
        Ok(Self { shape: spec.shape.clone(), mean: stats.mean, std: stats.std, min: stats.min, max: stats.max })
    }

    /// Checks that a column is not treated as constant although it varies: no element has a larger standard deviation than
    /// [`precision::CONSTANT`], and one has more than rounding gives.
    fn check_scale(&self, name: &str) -> Result<()> {
        let is_noise =
            |&element: &usize| self.std[element] <= precision::NOISE.max(RELATIVE_NOISE * self.magnitude(element));
        let varies = (0..self.dim()).find(|element| !is_noise(element));
        let Some(element) = varies.filter(|_| self.std.iter().all(|&std| std <= precision::CONSTANT)) else {
            return Ok(());
        };
        let given = format!("has a standard deviation of {:.1e} in element {element}", self.std[element]);
        let fix = format!(
            "up to {:.0e} is treated as constant: multiply {} by a scale when you collect",
            precision::CONSTANT,
            if name == ACTION { "the actions" } else { "the column" }
        );
        Err(Error::config(format!("column '{name}' of the training data"), given, fix))
    }

    /// Checks that models, which compute with single precision, can tell the values of the column `spec` apart.
    fn check_precision(&self, spec: &ColumnSpec) -> Result<()> {
        (0..self.dim()).try_for_each(|element| {
            let largest = self.magnitude(element);
            let error = precision::rounding(spec.dtype, largest);
            precision::check(&spec.name, element, largest, self.std[element], error)
        })
    }

    /// The largest magnitude of an element.
    fn magnitude(&self, element: usize) -> f64 {
        self.min[element].abs().max(self.max[element].abs())
    }

    /// Returns statistics with which scaling does not change the column.
    fn identity(spec: &ColumnSpec) -> Self {
        let all = |value: f64| vec![value; spec.len()];
        Self { shape: spec.shape.clone(), mean: all(0.0), std: all(1.0), min: all(0.0), max: all(0.0) }
    }
}

impl DatasetInfo {
    /// Checks the statistics of a stored model.
    ///
    /// # Errors
    /// When the number of values differs between the statistics of a column, there are none, or an action cannot be
    /// scaled.
    pub fn check(&self) -> Result<()> {
        let ActionScale { mean, std } = &self.action;
        if mean.is_empty() || mean.len() != std.len() {
            let given = format!("{} means and {} standard deviations", mean.len(), std.len());
            return Err(Error::config("facts.action", given, "give one of each for every action element"));
        }
        if !mean.iter().all(|mean| mean.is_finite()) || !std.iter().all(|std| std.is_finite() && *std > 0.0) {
            let given = format!("means {mean:?}, standard deviations {std:?}");
            return Err(Error::config("facts.action", given, "give finite means and positive standard deviations"));
        }
        for (name, column) in &self.columns {
            let elements = column.shape.iter().try_fold(1_usize, |count, side| count.checked_mul(*side)).unwrap_or(0);
            let counts = [&column.mean, &column.std, &column.min, &column.max].map(Vec::len);
            if elements == 0 || counts != [elements; 4] {
                let given = format!("shape {:?} with {counts:?} means, deviations, minima, maxima", column.shape);
                return Err(Error::config(
                    format!("facts.columns.{name}"),
                    given,
                    "give one of each for every element",
                ));
            }
        }
        Ok(())
    }

    /// Computes the statistics of a dataset. `columns` names the columns that the model observes; images are
    /// skipped. Actions are standardised, or, if `bounded`, mapped from their range in the data to -1 ..= 1.
    ///
    /// # Errors
    /// When there is no column of continuous actions, a column is missing, or the data are damaged.
    pub fn from_reader(reader: &dyn Reader, columns: &[String], bounded: bool) -> Result<Self> {
        Self::checked(reader, columns, bounded, false)
    }

    /// As [`DatasetInfo::from_reader`], for a training on the columns.
    ///
    /// # Errors
    /// As there, and when a column would be treated as constant although it varies, or single precision cannot tell its
    /// values apart.
    pub fn for_training(reader: &dyn Reader, columns: &[String], bounded: bool) -> Result<Self> {
        Self::checked(reader, columns, bounded, true)
    }

    /// Computes the statistics, and checks the columns for a training.
    fn checked(reader: &dyn Reader, columns: &[String], bounded: bool, training: bool) -> Result<Self> {
        let schema = reader.schema();
        let action = schema.column(ACTION)?;
        if !matches!(action.dtype, DType::Float32 | DType::Float64) {
            return Err(Error::mismatch(
                "training a model",
                format!("{} actions", action.dtype.name()),
                "float32 or float64 actions of a continuous action space (choose a dataset with such actions)",
            ));
        }
        let info = |spec: &ColumnSpec| {
            let column = ColumnInfo::of(reader, spec)?;
            if training {
                column.check_precision(spec)?;
                // A range of actions is mapped to -1 ..= 1 whatever its size.
                if !(bounded && spec.name == ACTION) {
                    column.check_scale(&spec.name)?;
                }
            }
            Ok(column)
        };
        let action = info(action)?;
        let mut observed = Named::new();
        for name in columns.iter().filter(|name| *name != ACTION) {
            let spec = schema.column(name)?;
            // Rewards and flags are not observations. Only those in bytes are left out, as in the stored checkpoints.
            let is_left_out = spec.dtype == DType::U8 && [REWARD, TERMINATED].contains(&name.as_str());
            if !spec.is_image() && !is_left_out {
                observed.insert(name.clone(), info(spec)?);
            }
        }
        let env = reader.manifest().and_then(|manifest| Some(manifest.config.get("env")?.as_str()?.to_owned()));
        let action = if bounded { range_scale(&action) } else { standard_scale(&action) };
        Ok(Self { action, columns: observed, env })
    }

    /// Returns the info of an environment, without a dataset: the shapes of `columns`, whose values are not scaled, and
    /// actions whose bounds are mapped to -1 and 1.
    ///
    /// # Errors
    /// When the action space is not continuous with finite bounds, or the environment does not observe a column.
    pub fn from_env(spec: &EnvSpec, columns: &[String]) -> Result<Self> {
        let action = bounds_scale(spec)?;
        let info = |name: &String| {
            let column = spec.columns.iter().find(|column| column.name == *name).ok_or_else(|| {
                let names: Vec<&str> = spec.columns.iter().map(|column| column.name.as_str()).collect();
                Error::unknown(
                    "observation column",
                    name,
                    names.iter().copied(),
                    format!("{} observes {}", spec.id, names.join(", ")),
                )
            })?;
            Ok((name.clone(), ColumnInfo::identity(column)))
        };
        // Images are not scaled; action, reward and termination are not observations.
        let skipped = [PIXELS, ACTION, REWARD, TERMINATED];
        let columns = columns.iter().filter(|name| !skipped.contains(&name.as_str())).map(info);
        Ok(Self { action, columns: columns.collect::<Result<Named<_>>>()?, env: Some(spec.id.clone()) })
    }

    /// The statistics of a column.
    ///
    /// # Errors
    /// When the model was trained without the column.
    pub fn column(&self, name: &str) -> Result<&ColumnInfo> {
        self.columns.get(name).ok_or_else(|| {
            let names: Vec<&str> = self.columns.keys().map(String::as_str).collect();
            let hint = format!("the model was trained on {}", names.join(", "));
            Error::unknown("model column", name, names, hint)
        })
    }

    /// The actions of a batch of clips, in model units. Missing actions (NaN in the last row of an episode) become 0.
    ///
    /// # Shapes
    /// `[clips, steps, frameskip * action_dim]`.
    ///
    /// # Errors
    /// When there is no column of actions.
    pub fn actions(&self, batch: &Batch, steps: usize, frameskip: usize, device: &Device) -> Result<Tensor<3>> {
        let dim = self.action.dim();
        let mut actions = batch.to_f32(ACTION)?;
        let mut scaled = vec![0.0; dim];
        for action in actions.chunks_exact_mut(dim) {
            self.action.to_model(action, &mut scaled);
            for (to, &from) in action.iter_mut().zip(&scaled) {
                *to = if from.is_nan() { 0.0 } else { from };
            }
        }
        Ok(Tensor::from_data(TensorData::new(actions, [batch.rows(), steps, frameskip * dim]), device))
    }
}

/// Standardises actions to mean 0 and standard deviation 1.
fn standard_scale(action: &ColumnInfo) -> ActionScale {
    let single = |values: &[f64]| values.iter().map(|&value| value as f32).collect();
    ActionScale { mean: single(&action.mean), std: single(&action.spread()) }
}

/// Maps the range of the actions in the data to -1 ..= 1; a constant element is mapped to 0.
fn range_scale(action: &ColumnInfo) -> ActionScale {
    let range = |(&low, &high): (&f64, &f64)| match high > low {
        true => (((high + low) / 2.0) as f32, ((high - low) / 2.0) as f32),
        false => (low as f32, 1.0),
    };
    let (mean, std) = action.min.iter().zip(&action.max).map(range).unzip();
    ActionScale { mean, std }
}

/// Maps the bounds of the action space to -1 and 1.
fn bounds_scale(spec: &EnvSpec) -> Result<ActionScale> {
    let refused = |fix: &str| {
        let given = format!("the actions are {}", spec.action_space.describe());
        Err(Error::config(format!("training online in {}", spec.id), given, fix))
    };
    let Space::Box { low, high, .. } = &spec.action_space else {
        return refused("choose an environment with continuous actions (`swm envs` lists them)");
    };
    if low.iter().chain(high).any(|bound| !bound.is_finite()) {
        return refused("choose an environment whose actions have finite bounds");
    }
    let half = |sign: f64| low.iter().zip(high).map(|(low, high)| ((high + sign * low) / 2.0) as f32).collect();
    Ok(ActionScale { mean: half(1.0), std: half(-1.0) })
}
