//! [`DatasetInfo`]: what a model knows of the data it was trained on.

use crate::nn::parameters::Named;
use burn::tensor::{Device, Tensor, TensorData};
use serde::{Deserialize, Serialize};
use swm_core::{Batch, ColumnSpec, DType, Error, Result};
use swm_data::{Reader, column_stats};
use swm_plan::ActionScale;

/// What a model knows of the data it was trained on; stored in its checkpoint.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DatasetInfo {
    /// Between environment actions and the model's.
    pub action: ActionScale,
    /// The other columns of numbers that it sees.
    pub columns: Named<ColumnInfo>,
    /// The environment the data came from, where the dataset says so.
    pub env: Option<String>,
}

/// What is known of a column, number by number.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ColumnInfo {
    /// The shape of a row.
    pub shape: Vec<usize>,
    /// The mean.
    pub mean: Vec<f64>,
    /// The standard deviation.
    pub std: Vec<f64>,
    /// The smallest number.
    pub min: Vec<f64>,
    /// The largest.
    pub max: Vec<f64>,
}

impl ColumnInfo {
    /// Numbers in a row.
    pub fn dim(&self) -> usize {
        self.mean.len()
    }

    /// The standard deviation, 1 where a number never changes: it carries nothing, so its scale is left alone.
    pub fn spread(&self) -> Vec<f64> {
        self.std.iter().map(|&std| if std > 1e-6 { std } else { 1.0 }).collect()
    }
}

impl DatasetInfo {
    /// The dataset info of a dataset; `columns` are those a model sees. Pictures among them are left out. Actions are scaled to
    /// mean 0 and spread 1, or, if `bounded`, to lie between -1 and 1.
    ///
    /// # Errors
    /// When there is no column of continuous actions, a column is missing, or the data are damaged.
    pub fn from_reader(reader: &dyn Reader, columns: &[String], bounded: bool) -> Result<Self> {
        let schema = reader.schema();
        let dataset_info = |spec: &ColumnSpec| {
            let stats = column_stats(reader, &spec.name, None)?;
            Ok::<_, Error>(ColumnInfo {
                shape: spec.shape.clone(),
                mean: stats.mean,
                std: stats.std,
                min: stats.min,
                max: stats.max,
            })
        };
        let action = schema.column("action")?;
        if action.dtype != DType::Float32 {
            return Err(Error::mismatch(
                "training a model",
                format!("{} actions", action.dtype.name()),
                "float32 actions of a continuous action space",
            ));
        }
        let action = dataset_info(action)?;
        #[allow(clippy::cast_possible_truncation)]
        let single = |values: &[f64]| values.iter().map(|&value| value as f32).collect();
        let mut seen = Named::new();
        for name in columns.iter().filter(|name| *name != "action") {
            let spec = schema.column(name)?;
            if spec.dtype != DType::U8 {
                seen.insert(name.clone(), dataset_info(spec)?);
            }
        }
        let env = reader.manifest().and_then(|manifest| Some(manifest.config.get("env")?.as_str()?.to_owned()));
        let action = if bounded {
            let of =
                |low: f64, high: f64| if high > low { [(high + low) / 2.0, (high - low) / 2.0] } else { [low, 1.0] };
            let both: Vec<[f64; 2]> = action.min.iter().zip(&action.max).map(|(&low, &high)| of(low, high)).collect();
            let part = |i: usize| single(&both.iter().map(|pair| pair[i]).collect::<Vec<_>>());
            ActionScale { mean: part(0), std: part(1) }
        } else {
            ActionScale { mean: single(&action.mean), std: single(&action.spread()) }
        };
        Ok(Self { action, columns: seen, env })
    }

    /// The dataset info of a column.
    ///
    /// # Errors
    /// When the model was trained without it.
    pub fn column(&self, name: &str) -> Result<&ColumnInfo> {
        self.columns.get(name).ok_or_else(|| {
            Error::unknown(
                "column of the model",
                name,
                self.columns.keys().map(String::as_str),
                "it was trained on these",
            )
        })
    }

    /// The actions of a batch of clips, in model units.
    ///
    /// # Shapes
    /// `[clips, steps, frameskip * numbers]`. Actions that are missing (the last of an episode) are 0, their mean.
    ///
    /// # Errors
    /// When there is no such column, or it is of another type.
    pub fn actions(&self, batch: &Batch, steps: usize, frameskip: usize, device: &Device) -> Result<Tensor<3>> {
        let dim = self.action.dim();
        let mut actions = batch.get::<f32>("action")?.to_vec();
        let mut scaled = vec![0.0; dim];
        for one in actions.chunks_exact_mut(dim) {
            self.action.to_model(one, &mut scaled);
            for (to, &from) in one.iter_mut().zip(&scaled) {
                *to = if from.is_nan() { 0.0 } else { from };
            }
        }
        Ok(Tensor::from_data(TensorData::new(actions, [batch.rows(), steps, frameskip * dim]), device))
    }
}
