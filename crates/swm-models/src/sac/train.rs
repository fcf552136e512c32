//! [`Trainable`] for SAC, which connects [`super::step`] to the training loop.

use super::config::{SacConfig, SacLoss};
use super::model::Sac;
use super::step::{Transitions, step};
use crate::nn::parameters::{self, IntoF32 as _};
use crate::nn::{Init, Named, normal};
use crate::online::{Agent, AgentPolicy, SharedModel, StochasticActor, StochasticPolicy};
use crate::train::{DatasetInfo, ParameterGroup, Preset, StepContext, StepOutput, TrainConfig, Trainable};
use burn::tensor::{Tensor, TensorData};
use swm_core::columns::{ACTION, REWARD, TERMINATED};
use swm_core::{Batch, EnvSpec, Error, Key, Result, RowRef, Schema};
use swm_data::{ClipSpec, LoaderConfig};

impl Trainable for Sac {
    const FAMILY: &'static str = "sac";
    const SUMMARY: &'static str =
        "soft actor-critic: a policy for continuous control, trained online, for demonstrations";
    const PRESETS: &'static [Preset] = &[
        Preset {
            id: "tiny",
            summary: "128 hidden features: learns to swing a pendulum up in minutes on two CPU cores",
            toml: include_str!("../../presets/sac/tiny.toml"),
        },
        Preset {
            id: "paper",
            summary: "256 hidden features, the published settings",
            toml: include_str!("../../presets/sac/paper.toml"),
        },
    ];
    const BOUNDED_ACTIONS: bool = true;
    type Config = SacConfig;
    type Loss = SacLoss;

    fn check(config: &TrainConfig<Self>) -> Result<()> {
        config.model.check()?;
        config.loss.check()?;
        if (config.data.num_steps, config.data.frameskip) != (2, 1) {
            let given = format!("{} frames, {} steps apart", config.data.num_steps, config.data.frameskip);
            return Err(Error::config(
                "data.num_steps",
                given,
                "choose 2 frames and a frameskip of 1, which make one transition",
            ));
        }
        if config.shards != 1 {
            let given = format!("{}, but every network computes the whole batch", config.shards);
            return Err(Error::config("shards", given, "leave it at 1; --threads is the number of threads"));
        }
        if config.online.as_ref().is_some_and(|online| online.planner.is_some()) {
            let problem = "SAC has no model to plan with";
            return Err(Error::config("online.planner", problem, "leave the table out"));
        }
        Ok(())
    }

    fn image_size(_: &SacConfig) -> Option<usize> {
        None
    }

    fn loader_config(config: &TrainConfig<Self>, schema: &Schema) -> Result<LoaderConfig> {
        crate::online::check_rewards(schema)?;
        let columns = config.model.columns.iter().map(String::as_str).chain([ACTION, REWARD, TERMINATED]);
        let clip = ClipSpec { num_steps: 2, frameskip: 1, columns: columns.map(str::to_owned).collect() };
        clip.schema(schema)?;
        Ok(LoaderConfig { clip, ..LoaderConfig::default() })
    }

    fn new(config: &TrainConfig<Self>, dataset_info: &DatasetInfo, init: &Init) -> Result<Self> {
        let widths: Result<Vec<usize>> =
            config.model.columns.iter().map(|column| Ok(dataset_info.column(column)?.dim())).collect();
        Ok(Self::init(&config.model, &config.loss, widths?.iter().sum(), dataset_info.action.dim(), init))
    }

    fn step(&self, context: &StepContext<'_, Self>, batch: &Batch) -> Result<StepOutput> {
        let (config, device) = (context.config, context.device);
        let (rows, width, inputs) = (batch.rows(), context.dataset_info.action.dim(), self.inputs());
        let columns = config.model.columns.iter().map(|column| {
            let values = batch.to_f32(column)?;
            let width = values.len() / (2 * rows).max(1);
            Ok(Tensor::<3>::from_data(TensorData::new(values, [rows, 2, width]), device))
        });
        let observations = Tensor::cat(columns.collect::<Result<Vec<_>>>()?, 2);
        let frame = |i| observations.clone().slice([0..rows, i..i + 1]).reshape([rows, inputs]);
        let first = |name: &str| {
            let column = Tensor::<2>::from_data(TensorData::new(batch.to_f32(name)?, [rows, 2]), device);
            Ok::<_, Error>(column.slice([0..rows, 0..1]).reshape([rows]))
        };
        let noise = |purpose: &str| {
            let values = normal(&[context.key.with(purpose)], rows * width);
            Tensor::from_data(TensorData::new(values, [rows, width]), device)
        };
        let actions = context.dataset_info.actions(batch, 2, 1, device)?.slice([0..rows, 0..1]).reshape([rows, width]);
        let batch = Transitions {
            observations: frame(0),
            actions,
            rewards: first(REWARD)?,
            terminated: first(TERMINATED)?,
            next: frame(1),
            noise: [noise("next actions"), noise("actions")],
        };
        let losses = step(self, &batch, &config.loss);
        let metrics = vec![
            ("loss", losses.critic + losses.actor),
            ("critic", losses.critic),
            ("actor", losses.actor),
            ("q", losses.q),
            ("entropy", losses.entropy),
            ("temperature", losses.temperature),
        ];
        Ok(StepOutput { metrics, gradients: losses.gradients, buffers: Named::new() })
    }

    fn after_step(mut self, context: &StepContext<'_, Self>, _: Named<Tensor<1>>) -> Self {
        self.critic_target = parameters::blend(self.critic_target, &self.critic, 1.0 - context.config.loss.tau);
        self
    }

    /// Returns the parameter group of a weight: the gradients of Q functions, policy and temperature are clipped
    /// separately.
    fn parameter_group(name: &str) -> ParameterGroup {
        let clip = ["critic.", "actor."].iter().position(|part| name.starts_with(part)).unwrap_or(2);
        ParameterGroup { clip, ..ParameterGroup::default() }
    }
}

impl StochasticActor for Sac {
    fn act(&self, config: &TrainConfig<Self>, row: RowRef<'_>, key: Option<Key>) -> Result<Vec<f32>> {
        let device = self.log_ent_coef.val().device();
        let mut observation = vec![];
        for column in &config.model.columns {
            observation.extend(row.to_f32(column)?);
        }
        let inputs = self.inputs();
        if observation.len() != inputs {
            let given = format!("{} elements in {}", observation.len(), config.model.columns.join(", "));
            return Err(Error::mismatch("acting", given, format!("{inputs}, as the policy was trained")));
        }
        let (mean, log_std) = self.actor.forward(Tensor::from_data(TensorData::new(observation, [1, inputs]), &device));
        let raw = match key {
            None => mean,
            Some(key) => {
                let width = mean.dims()[1];
                let noise = Tensor::from_data(TensorData::new(normal(&[key], width), [1, width]), &device);
                mean + log_std.exp() * noise
            }
        };
        Ok(raw.tanh().into_data().into_f32_vec())
    }
}

impl Agent for Sac {
    fn policy(
        config: &TrainConfig<Self>,
        dataset_info: &DatasetInfo,
        model: SharedModel<Self>,
        spec: &EnvSpec,
        slots: usize,
        explore: bool,
    ) -> Result<Box<dyn AgentPolicy>> {
        Ok(Box::new(StochasticPolicy::new(config, dataset_info, model, spec, slots, explore)?))
    }
}
