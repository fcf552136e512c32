//! [`Trainable`] for TD-MPC2, which connects [`super::step`] to the training loop.

use super::config::{LossConfig, Tdmpc2Config};
use super::model::{Observation, Tdmpc2};
use super::planner::Tdmpc2Policy;
use super::step::{Draws, TrainBatch, step};
use crate::nn::parameters::{self, IntoF32 as _};
use crate::nn::{Init, Named, normal};
use crate::online::{Agent, AgentPolicy, SharedModel, StochasticActor, StochasticPolicy};
use crate::pixels::{self, ImageNormalization};
use crate::train::{
    DatasetInfo, ParameterGroup, Preset, StepContext, StepOutput, TrainConfig, Trainable, check_sizes, limits,
};
use burn::module::Param;
use burn::tensor::{Device, Tensor, TensorData};
use swm_core::columns::{ACTION, PIXELS, REWARD, TERMINATED};
use swm_core::{Batch, EnvSpec, Error, Key, Result, RowRef, Schema};
use swm_data::{ClipSpec, LoaderConfig};

impl Trainable for Tdmpc2 {
    const FAMILY: &'static str = "tdmpc2";
    const SUMMARY: &'static str =
        "TD-MPC2: latents that predict rewards and values, with a policy that initialises plans";
    const PRESETS: &'static [Preset] = &[
        Preset {
            id: "tiny",
            summary: "small networks on the column `state`: learns to swing a pendulum up in minutes on two CPU cores",
            toml: include_str!("../../presets/tdmpc2/tiny.toml"),
        },
        Preset {
            id: "paper",
            summary: "5 million parameters, the published size and settings for tasks with states",
            toml: include_str!("../../presets/tdmpc2/paper.toml"),
        },
    ];
    const BOUNDED_ACTIONS: bool = true;
    type Config = Tdmpc2Config;
    type Loss = LossConfig;

    fn check(config: &TrainConfig<Self>) -> Result<()> {
        config.model.check()?;
        config.loss.check()?;
        check_sizes(&[("data.num_steps", config.data.num_steps, 2, limits::FRAMES)])?;
        if config.data.frameskip != 1 {
            let fix = "choose 1: rewards between two frames would be lost";
            return Err(Error::config("data.frameskip", config.data.frameskip.to_string(), fix));
        }
        Ok(())
    }

    fn image_size(config: &Tdmpc2Config) -> Option<usize> {
        config.image_encoding().map(|_| config.image)
    }

    fn loader_config(config: &TrainConfig<Self>, schema: &Schema) -> Result<LoaderConfig> {
        if config.model.image_encoding().is_some() {
            pixels::check(config.model.image, schema, PIXELS)?;
        }
        crate::online::check_rewards(schema)?;
        let columns = config.model.columns().into_iter().chain([ACTION, REWARD, TERMINATED].map(str::to_owned));
        let clip = ClipSpec { num_steps: config.data.num_steps, frameskip: 1, columns: columns.collect() };
        clip.schema(schema)?;
        Ok(LoaderConfig { clip, ..LoaderConfig::default() })
    }

    fn new(config: &TrainConfig<Self>, dataset_info: &DatasetInfo, init: &Init) -> Result<Self> {
        let widths = config.model.column_encodings().map(|encoding| Ok(dataset_info.column(&encoding.column)?.dim()));
        Ok(Self::init(&config.model, &widths.collect::<Result<Vec<_>>>()?, dataset_info.action.dim(), init))
    }

    fn step(&self, context: &StepContext<'_, Self>, batch: &Batch) -> Result<StepOutput> {
        let StepContext { config, dataset_info, key, device, training } = context;
        let steps = config.data.num_steps;
        let (clips, horizon, width) = (batch.rows(), steps - 1, dataset_info.action.dim());
        let by_step = |name: &str| {
            let column = Tensor::<2>::from_data(TensorData::new(batch.to_f32(name)?, [clips, steps]), context.device);
            Ok::<_, Error>(column.swap_dims(0, 1).narrow(0, 0, horizon))
        };
        let actions = dataset_info.actions(batch, steps, 1, device)?.swap_dims(0, 1).narrow(0, 0, horizon);
        let batch = TrainBatch {
            observations: observe_clips(&config.model, batch, steps, device)?,
            actions,
            rewards: by_step(REWARD)?,
            terminated: by_step(TERMINATED)?,
        };
        let draws = Draws::new(*key, self, [horizon, clips, width], *training);
        let losses = step(self, &batch, &config.loss, &draws, config.shards);
        let mut metrics = vec![
            ("loss", losses.total),
            ("consistency", losses.consistency),
            ("reward", losses.reward),
            ("value", losses.value),
            ("policy", losses.policy),
            ("q", losses.q),
            ("entropy", losses.entropy),
            ("scale", f64::from(losses.scale)),
        ];
        if self.termination.is_some() {
            metrics.push(("termination", losses.termination));
        }
        let scale = Tensor::from_data(TensorData::new(vec![losses.scale], [1]), context.device);
        Ok(StepOutput { metrics, gradients: losses.gradients, buffers: Named::from([(SCALE.to_owned(), scale)]) })
    }

    /// Replaces the running spread and updates the target networks.
    fn after_step(mut self, context: &StepContext<'_, Self>, mut buffers: Named<Tensor<1>>) -> Self {
        self.target_qs = parameters::blend(self.target_qs, &self.qs, 1.0 - context.config.loss.tau);
        if let Some(scale) = buffers.remove(SCALE) {
            self.scale.value = Param::from_tensor(scale).set_require_grad(false);
        }
        self
    }

    /// Returns the parameter group of a weight: the gradients of world model and policy are clipped separately, and
    /// encoders have a lower learning rate, as published.
    fn parameter_group(name: &str) -> ParameterGroup {
        let encoder = ["cnn.", "pixel_encoder.", "extra_encoders."].iter().any(|part| name.starts_with(part));
        ParameterGroup { clip: usize::from(name.starts_with("pi.")), lr: if encoder { ENCODER_LR } else { 1.0 } }
    }
}

/// The learning rate of encoders relative to other parameters.
const ENCODER_LR: f64 = 0.3;
const SCALE: &str = "scale.value";

/// Reads the observations of a batch of clips.
///
/// # Shapes
/// Returns `steps * clips` rows, ordered by step, then by clip.
fn observe_clips(config: &Tdmpc2Config, batch: &Batch, steps: usize, device: &Device) -> Result<Observation> {
    let clips = batch.rows();
    let columns = config.column_encodings().map(|encoding| {
        let values = batch.to_f32(&encoding.column)?;
        let width = values.len() / (clips * steps).max(1);
        let values = Tensor::<3>::from_data(TensorData::new(values, [clips, steps, width]), device);
        Ok(values.swap_dims(0, 1).reshape([steps * clips, width]))
    });
    let columns = columns.collect::<Result<_>>()?;
    let images = config.image_encoding().map(|_| {
        let planes = pixels::planes(&normalization(config), batch.get::<u8>(PIXELS)?, device)?;
        let [frames, colours, side, _] = planes.dims();
        let planes: Tensor<5> = planes.reshape([clips, steps, colours, side, side]);
        Ok::<_, Error>(planes.swap_dims(0, 1).reshape([frames, colours, side, side]))
    });
    Ok(Observation { pixels: images.transpose()?, columns })
}

/// Returns the normalisation of pixels to -0.5 ..= 0.5, as published.
fn normalization(config: &Tdmpc2Config) -> ImageNormalization {
    ImageNormalization { side: config.image, mean: [0.5; 3], std: [1.0; 3] }
}

/// Reads the observation of one row.
///
/// # Errors
/// When a column that the model observes is missing or has another shape.
pub(super) fn observe_row(config: &Tdmpc2Config, model: &Tdmpc2, row: RowRef<'_>) -> Result<Observation> {
    let device = model.device();
    let columns = config.column_encodings().zip(model.extra_encoders.iter()).map(|(encoding, (_, encoder))| {
        let width = encoder._0.weight.dims()[1];
        let values = row.to_f32(&encoding.column)?;
        if values.len() != width {
            let given = format!("{} elements in '{}'", values.len(), encoding.column);
            return Err(Error::mismatch("acting", given, format!("{width}, as the model was trained")));
        }
        Ok(Tensor::from_data(TensorData::new(values, [1, width]), &device))
    });
    let columns = columns.collect::<Result<_>>()?;
    let images = config.image_encoding().map(|_| {
        pixels::check(config.image, row.schema(), PIXELS)?;
        pixels::planes(&normalization(config), row.get::<u8>(PIXELS)?, &device)
    });
    Ok(Observation { pixels: images.transpose()?, columns })
}

impl StochasticActor for Tdmpc2 {
    fn act(&self, config: &TrainConfig<Self>, row: RowRef<'_>, key: Option<Key>) -> Result<Vec<f32>> {
        let gaussian = self.policy(self.encode(observe_row(&config.model, self, row)?));
        let action = match key {
            None => gaussian.mean.tanh(),
            Some(key) => {
                let width = self.action_dim();
                let noise = TensorData::new(normal(&[key], width), [1, width]);
                gaussian.sample(Tensor::from_data(noise, &self.device()))
            }
        };
        Ok(action.into_data().into_f32_vec())
    }
}

impl Agent for Tdmpc2 {
    fn policy(
        config: &TrainConfig<Self>,
        dataset_info: &DatasetInfo,
        model: SharedModel<Self>,
        spec: &EnvSpec,
        slots: usize,
        explore: bool,
    ) -> Result<Box<dyn AgentPolicy>> {
        Ok(match config.online.as_ref().and_then(|online| online.planner.as_ref()) {
            Some(planner) => Box::new(Tdmpc2Policy::new(planner, config, dataset_info, model, spec, slots, explore)?),
            None => Box::new(StochasticPolicy::new(config, dataset_info, model, spec, slots, explore)?),
        })
    }
}
