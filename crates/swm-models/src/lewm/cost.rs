//! [`LewmCost`]: the planning cost of a LeWM, the squared distance between the last predicted latent of a candidate and
//! the latent of the goal image.
//!
//! Every call evaluates candidates of one environment on one thread of the current rayon pool, and the shape of a call
//! does not depend on the other environments. So the bytes of an environment's plan depend neither on the other
//! environments nor on the number of threads.

use super::config::LewmConfig;
use super::host_encoder::HostEncoder;
use super::model::Lewm;
use super::pixels;
use super::rollout::Rollout;
use crate::checkpoint::Checkpoint;
use crate::checks;
use crate::device::within_memory;
use crate::nn::parameters::IntoF32;
use burn::tensor::{Device, Tensor, TensorData};
use rayon::prelude::*;
use swm_core::columns::{GOAL, PIXELS};
use swm_core::{Batch, Candidates, CostModel, DifferentiableCost, LatentDynamics, Result};

/// The planning cost of a LeWM.
pub struct LewmCost {
    pub(super) model: Lewm,
    host: Option<Host>,
    pub(super) config: LewmConfig,
    pub(super) action_dim: usize,
    pub(super) contexts: Vec<PlanContext>,
}

/// The weights laid out for the CPU kernels. On other devices, the cost uses the tensors of the model.
struct Host {
    rollout: Rollout,
    encoder: Option<HostEncoder>,
}

/// The start latents and the goal latent of one environment's plan.
#[derive(Clone)]
pub(super) struct PlanContext {
    /// The latents of the last frames, oldest first: `[frames, latent]`.
    pub start: Vec<f32>,
    /// The actions taken between the start frames, in model units: `[frames - 1, action_dim]`.
    pub past: Vec<f32>,
    /// The latent of the goal image, `[latent]`.
    pub goal: Vec<f32>,
}

impl LewmCost {
    /// Creates the planning cost of a trained model.
    pub fn new(checkpoint: &Checkpoint<Lewm>) -> Self {
        Self::of(&checkpoint.model, &checkpoint.config.model, checkpoint.action_dim())
    }

    /// Creates the planning cost of a model with the configuration `config` and actions of `action_dim` elements.
    pub fn of(model: &Lewm, config: &LewmConfig, action_dim: usize) -> Self {
        let on_host = model.device() == Device::flex();
        let host = on_host.then(|| Host { rollout: Rollout::new(model), encoder: HostEncoder::new(model, config) });
        Self { model: model.clone(), host, config: config.clone(), action_dim, contexts: vec![] }
    }

    /// Checks that the lengths of candidates and costs fit the observed environments.
    pub(super) fn check_sizes(&self, candidates: &Candidates<'_>, costs: &[f32]) -> Result<()> {
        checks::candidate_sizes("costs of a LeWM", candidates, costs, [self.contexts.len(), self.action_dim])
    }

    /// Returns the latent of one image.
    ///
    /// # Shapes
    /// `rgb` is `[image, image, 3]`; returns `[latent]`.
    ///
    /// # Errors
    /// When the image has another size.
    pub fn latent_of(&self, rgb: &[u8]) -> Result<Vec<f32>> {
        let patches = pixels::patches(&self.config, rgb, &self.model.device())?;
        Ok(match self.host.as_ref().and_then(|host| host.encoder.as_ref()) {
            Some(encoder) => encoder.encode(&patches.into_data().into_f32_vec()),
            None => self.model.encode(patches).into_data().into_f32_vec(),
        })
    }

    /// Encodes the current frame, the recorded history and the goal of one environment.
    fn context(&self, infos: &Batch, env: usize) -> Result<PlanContext> {
        let row = infos.row(env);
        // One image per call: a latent must not depend on the number of images in a call.
        let mut start = vec![self.latent_of(row.get::<u8>(PIXELS)?)?];
        let mut past = vec![];
        if infos.schema().find("history.length").is_some() {
            let length = usize::try_from(row.get::<i32>("history.length")?[0]).unwrap_or(0);
            let length =
                length.min(self.config.predictor.history - 1).min(infos.schema().column("history.action")?.shape[0]);
            let bytes = self.config.image * self.config.image * 3;
            let frames = row.get::<u8>("history.pixels")?;
            let actions = row.get::<f32>("history.action")?;
            for frame in frames[frames.len() - length * bytes..].rchunks_exact(bytes) {
                start.insert(0, self.latent_of(frame)?);
            }
            past = actions[actions.len() - length * self.action_dim..].to_vec();
        }
        Ok(PlanContext { start: start.concat(), past, goal: self.latent_of(row.get::<u8>(GOAL)?)? })
    }
}

impl PlanContext {
    /// Writes the costs of candidates.
    ///
    /// # Shapes
    /// `candidates` is `[samples, horizon, action_dim]`, `costs` is `[samples]`.
    fn cost(&self, predictor: &RolloutModel<'_>, candidates: &[f32], horizon: usize, costs: &mut [f32]) {
        let (samples, latent) = (costs.len(), self.goal.len());
        let steps = self.start.len() / latent - 1 + horizon;
        let mut actions = Vec::with_capacity(samples * self.past.len() + candidates.len());
        for candidate in candidates.chunks_exact(candidates.len() / samples) {
            actions.extend_from_slice(&self.past);
            actions.extend_from_slice(candidate);
        }
        let last = predictor.last(&self.start, actions, samples, steps);
        for (cost, end) in costs.iter_mut().zip(last.chunks_exact(latent)) {
            *cost = end.iter().zip(&self.goal).map(|(a, b)| (a - b).powi(2)).sum();
        }
    }
}

/// The implementation of rollouts: the CPU kernels, or the tensors of the model.
enum RolloutModel<'a> {
    Host(&'a Rollout),
    Device(&'a Lewm),
}

impl RolloutModel<'_> {
    /// Returns the last latents of a rollout.
    ///
    /// # Shapes
    /// `start` is `[frames, latent]`, `actions` is `[samples, steps, action_dim]`; returns `[samples, latent]`.
    fn last(&self, start: &[f32], actions: Vec<f32>, samples: usize, steps: usize) -> Vec<f32> {
        match self {
            Self::Host(rollout) => rollout.run(start, &actions, samples, steps).pop().unwrap_or_default(),
            Self::Device(model) => {
                let device = model.device();
                let latent = model.latent();
                let (frames, width) = (start.len() / latent, actions.len() / (samples * steps));
                let start = Tensor::<3>::from_data(TensorData::new(start.to_vec(), [1, frames, latent]), &device);
                let actions = Tensor::from_data(TensorData::new(actions, [samples, steps, width]), &device);
                let all = model.rollout(start.expand([samples, frames, latent]), actions);
                all.slice([0..samples, steps..steps + 1, 0..latent]).into_data().into_f32_vec()
            }
        }
    }

    /// Returns the number of candidates that are rolled out in one call, given `samples` candidates.
    fn chunk_size(&self, samples: usize) -> usize {
        match self {
            Self::Host(_) => Rollout::chunk_size(samples),
            Self::Device(_) => samples,
        }
    }
}

impl CostModel for LewmCost {
    fn observe(&mut self, infos: &Batch, envs: &[usize]) -> Result<()> {
        checks::planning_images(infos.schema(), self.config.image, self.action_dim)?;
        let contexts: Result<Vec<PlanContext>> = envs.par_iter().map(|&env| self.context(infos, env)).collect();
        self.contexts = contexts?;
        Ok(())
    }

    fn cost(&mut self, candidates: Candidates<'_>, costs: &mut [f32]) -> Result<()> {
        self.check_sizes(&candidates, costs)?;
        let Candidates { actions, samples, horizon, dim, .. } = candidates;
        let predictor = match &self.host {
            Some(host) => RolloutModel::Host(&host.rollout),
            None => RolloutModel::Device(&self.model),
        };
        // The candidates of each environment are split separately, so that no chunk spans two environments.
        let (contexts, chunk_size) = (&self.contexts, predictor.chunk_size(samples));
        let compute = || {
            costs.par_chunks_mut(samples).zip(actions.par_chunks(samples * horizon * dim)).zip(contexts).for_each(
                |((costs, actions), context)| {
                    let chunks = costs.par_chunks_mut(chunk_size).zip(actions.par_chunks(chunk_size * horizon * dim));
                    chunks.for_each(|(costs, actions)| context.cost(&predictor, actions, horizon, costs));
                },
            );
            Ok(())
        };
        within_memory(&self.model.device(), "the solver's samples (--solver cem,samples=…)", compute)
    }

    fn differentiable(&mut self) -> Option<&mut dyn DifferentiableCost> {
        Some(self)
    }

    fn latent(&mut self) -> Option<&mut dyn LatentDynamics> {
        Some(self)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::TrainConfig;
    use crate::nn::{Init, parameters};
    use swm_core::{ColumnSpec, Key, Schema};

    #[test]
    fn host_and_device_rollouts_give_equal_costs() {
        check_costs("tiny", &["model.predictor.history=3"]);
        let small = ["model.image=12", "model.encoder.conv.channels=[6, 9]", "model.latent=5", "model.predictor.dim=8"];
        check_costs("small", &small);
    }

    fn check_costs(preset: &str, settings: &[&str]) {
        let settings: Vec<String> = settings.iter().map(|setting| (*setting).to_owned()).collect();
        let config = TrainConfig::<Lewm>::load(preset, &settings).expect("loading the preset");
        let (samples, horizon, dim) = (5, 5, 4);
        let model = Lewm::init(&config.model, dim, &Init::new(Key::new(0), &Device::flex()));
        // Modulations are zero-initialised, and actions have no effect through zero modulations.
        let mut values = parameters::values(&model);
        for (_, tensor) in values.iter_mut().filter(|(name, _)| name.contains("adaLN")) {
            for (i, value) in tensor.values.iter_mut().enumerate() {
                *value = ((i * 37 % 101) as f32 / 101.0 - 0.5) * 0.4;
            }
        }
        let model = parameters::load(model, &values);
        let side = config.model.image;
        let columns = [ColumnSpec::image("pixels", side, side), ColumnSpec::image("goal", side, side)];
        let mut infos = Batch::zeros(&Schema::new(columns).expect("creating the schema"), 1);
        infos.row_mut(0).at::<u8>(1).fill(200);
        let actions: Vec<f32> = (0..samples * horizon * dim).map(|i| (i * 29 % 97) as f32 / 50.0 - 1.0).collect();
        let costs = |on_host: bool| {
            let mut cost = LewmCost::of(&model, &config.model, dim);
            cost.host = cost.host.filter(|_| on_host);
            cost.observe(&infos, &[0]).expect("observing the environment");
            let mut costs = vec![0.0; samples];
            let candidates = Candidates { actions: &actions, envs: 1, samples, horizon, dim };
            cost.cost(candidates, &mut costs).expect("computing the costs");
            costs
        };
        let (host, device) = (costs(true), costs(false));
        assert!(host.windows(2).all(|pair| pair[0] != pair[1]), "actions have no effect: {host:?}");
        for (host, device) in host.iter().zip(&device) {
            assert!((host - device).abs() < 1e-4 * device.abs(), "the CPU cost is {host}, the device cost is {device}");
        }
    }
}
