//! The model family `line`: a world model of `ext/Line-v0`, `next = position + gain * action`.

use burn::module::{Module, Param};
use burn::tensor::{Tensor, TensorData};
use serde::{Deserialize, Serialize};
use swm::core::requirements::{DatasetRequirements, RequiredObservations};
use swm::core::{Batch, Candidates, CostModel, Result, Schema};
use swm::data::dataset::{ClipSpec, LoaderConfig};
use swm::models::nn::{Init, parameters};
use swm::models::train::{DatasetInfo, Preset, StepContext, StepOutput};
use swm::models::{Checkpoint, FamilyEntry, ModelFamily, TrainConfig, Trainable};

pub const ENTRY: FamilyEntry = FamilyEntry::of::<Line>();

#[derive(Module, Debug)]
pub struct Line {
    /// Movement per unit of the normalised action, `[1]`.
    gain: Param<Tensor<1>>,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LineConfig {}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LineLoss {}

impl Trainable for Line {
    const FAMILY: &'static str = "line";
    const SUMMARY: &'static str = "a point on a line that moves in proportion to the action";
    const PRESETS: &'static [Preset] = &[Preset {
        id: "tiny",
        summary: "one parameter",
        toml: "
            seed = 0
            shards = 1
            log_every = 100
            save_every = 0
            [model]
            [loss]
            [data]
            num_steps = 2
            frameskip = 1
            batch_size = 32
            [optim]
            lr = 1e-2
            weight_decay = 0.0
            betas = [0.9, 0.999]
            epsilon = 1e-8
            clip = 1e9
            [schedule]
            steps = 200
            warmup = 0
            floor = 0.1
        ",
    }];
    type Config = LineConfig;
    type Loss = LineLoss;

    fn check(_: &TrainConfig<Self>) -> Result<()> {
        Ok(())
    }

    fn image_size(_: &LineConfig) -> Option<usize> {
        None
    }

    fn loader_config(config: &TrainConfig<Self>, _: &Schema) -> Result<LoaderConfig> {
        let columns = ["state", "action"].map(str::to_owned).to_vec();
        let clip = ClipSpec { num_steps: config.data.num_steps, frameskip: config.data.frameskip, columns };
        Ok(LoaderConfig { clip, ..LoaderConfig::default() })
    }

    fn new(_: &TrainConfig<Self>, _: &DatasetInfo, init: &Init) -> Result<Self> {
        Ok(Self { gain: init.constant([1], 0.0) })
    }

    fn step(&self, context: &StepContext<'_, Self>, batch: &Batch) -> Result<StepOutput> {
        let (clips, device) = (batch.rows(), context.device);
        let states = Tensor::<2>::from_data(TensorData::new(batch.to_f32("state")?, [clips, 2]), device);
        let actions = context.dataset_info.actions(batch, 2, 1, device)?.reshape([clips, 2]).narrow(1, 0, 1);
        let movement = states.clone().narrow(1, 1, 1) - states.narrow(1, 0, 1);
        let model = self.clone().train();
        let predicted = actions.autodiff() * model.gain.val().unsqueeze();
        let loss = (predicted - movement.autodiff()).square().mean();
        let value = f64::from(loss.clone().inner().into_scalar::<f32>());
        let gradients = parameters::gradients(&model, &loss.backward());
        Ok(StepOutput { metrics: vec![("loss", value)], gradients, ..StepOutput::default() })
    }
}

impl ModelFamily for Line {
    fn requirements(config: &TrainConfig<Self>) -> DatasetRequirements {
        DatasetRequirements {
            model: "Line",
            observations: RequiredObservations::State,
            reward: false,
            clip_rows: config.data.num_steps * config.data.frameskip,
        }
    }

    fn cost(checkpoint: &Checkpoint<Self>) -> Option<Box<dyn CostModel>> {
        let gain = checkpoint.model.gain.val().into_data().iter::<f32>().next()?;
        Some(Box::new(LineCost { gain, contexts: vec![] }))
    }
}

struct LineCost {
    /// Movement per unit of the normalised action.
    gain: f32,
    /// Position and goal of each observed environment.
    contexts: Vec<[f32; 2]>,
}

impl CostModel for LineCost {
    fn observe(&mut self, infos: &Batch, envs: &[usize]) -> Result<()> {
        let (positions, goals) = (infos.get::<f32>("state")?, infos.get::<f32>("target")?);
        self.contexts = envs.iter().map(|&env| [positions[env], goals[env]]).collect();
        Ok(())
    }

    fn cost(&mut self, candidates: Candidates<'_>, costs: &mut [f32]) -> Result<()> {
        let Candidates { actions, samples, horizon, dim, .. } = candidates;
        let rows = costs.chunks_exact_mut(samples).zip(actions.chunks_exact(samples * horizon * dim));
        for ((costs, actions), [position, goal]) in rows.zip(&self.contexts) {
            for (cost, actions) in costs.iter_mut().zip(actions.chunks_exact(horizon * dim)) {
                *cost = (position + self.gain * actions.iter().sum::<f32>() - goal).powi(2);
            }
        }
        Ok(())
    }
}
