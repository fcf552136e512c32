//! [`LewmCost`]: the planning cost of a LeWM, the squared distance between the last predicted latent of a candidate, or the closest
//! one, and the latent of the goal image.
//!
//! Every call evaluates candidates of one environment on one thread of the current rayon pool, and the shape of a call
//! does not depend on the other environments. So the bytes of an environment's plan depend neither on the other
//! environments nor on the number of threads. On a GPU, [`LewmCost::plan_together`] gives this up for speed.

use super::config::LewmConfig;
use super::device_rollout::DeviceRollout;
use super::host_encoder::HostEncoder;
use super::model::Lewm;
use super::pixels;
use super::rollout::Rollout;
use crate::checkpoint::Checkpoint;
use crate::checks;
use crate::device::{Precision, within_memory};
use crate::nn::parameters::IntoF32;
use burn::tensor::Device;
use rayon::prelude::*;
use swm_core::columns::{GOAL, PIXELS};
use swm_core::{Batch, Candidates, CostModel, DifferentiableCost, LatentDynamics, Result};

/// The planning cost of a LeWM.
pub struct LewmCost {
    pub(super) model: Lewm,
    host: Option<Host>,
    /// The weights laid out for rollouts on another device.
    device: Option<DeviceRollout>,
    /// Whether a call to the device computes the candidates of all environments.
    together: bool,
    /// Whether the closest predicted latent is compared with the goal's, not the last one.
    pub(super) closest: bool,
    pub(super) config: LewmConfig,
    pub(super) action_dim: usize,
    pub(super) contexts: Vec<PlanContext>,
}

/// The weights laid out for the CPU kernels.
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
        let device = (!on_host).then(|| DeviceRollout::new(model, Precision::chosen()));
        Self {
            model: model.clone(),
            host,
            device,
            together: false,
            closest: false,
            config: config.clone(),
            action_dim,
            contexts: vec![],
        }
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

    /// Returns the frames of one environment, from the oldest recorded one to the current one and the goal, and the actions taken between
    /// the recorded frames.
    fn frames<'a>(&self, infos: &'a Batch, env: usize) -> Result<(Vec<&'a [u8]>, Vec<f32>)> {
        let row = infos.row(env);
        let (mut frames, mut past) = (vec![], vec![]);
        if infos.schema().find("history.length").is_some() {
            let length = usize::try_from(row.get::<i32>("history.length")?[0]).unwrap_or(0);
            let length =
                length.min(self.config.predictor.history - 1).min(infos.schema().column("history.action")?.shape[0]);
            let bytes = self.config.image * self.config.image * 3;
            let recorded = row.get::<u8>("history.pixels")?;
            let actions = row.get::<f32>("history.action")?;
            frames.extend(recorded[recorded.len() - length * bytes..].chunks_exact(bytes));
            past = actions[actions.len() - length * self.action_dim..].to_vec();
        }
        frames.extend([row.get::<u8>(PIXELS)?, row.get::<u8>(GOAL)?]);
        Ok((frames, past))
    }

    /// Encodes the frames of one environment. One image per call: a latent must not depend on the number of images in a call.
    fn context(&self, infos: &Batch, env: usize) -> Result<PlanContext> {
        let (frames, past) = self.frames(infos, env)?;
        let latents: Result<Vec<Vec<f32>>> = frames.into_iter().map(|frame| self.latent_of(frame)).collect();
        Ok(PlanContext::new(latents?.concat(), past, self.config.latent))
    }

    /// Encodes the frames of all environments, [`DEVICE_FRAMES`] at once.
    fn contexts_together(&self, infos: &Batch, envs: &[usize]) -> Result<Vec<PlanContext>> {
        let parts: Result<Vec<_>> = envs.iter().map(|&env| self.frames(infos, env)).collect();
        let parts = parts?;
        let frames: Vec<&[u8]> = parts.iter().flat_map(|(frames, _)| frames.iter().copied()).collect();
        let mut latents = vec![];
        for frames in frames.chunks(DEVICE_FRAMES) {
            let patches = pixels::patches(&self.config, &frames.concat(), &self.model.device())?;
            latents.extend(self.model.encode(patches).into_data().into_f32_vec());
        }
        let mut rest = &latents[..];
        let context = |(frames, past): (Vec<&[u8]>, Vec<f32>)| {
            let (own, later) = rest.split_at(frames.len() * self.config.latent);
            rest = later;
            PlanContext::new(own.to_vec(), past, self.config.latent)
        };
        Ok(parts.into_iter().map(context).collect())
    }
}

impl PlanContext {
    /// Creates a context from the latents of the frames, of which the last is the goal.
    fn new(mut latents: Vec<f32>, past: Vec<f32>, latent: usize) -> Self {
        let goal = latents.split_off(latents.len() - latent);
        Self { start: latents, past, goal }
    }

    /// Writes the costs of candidates.
    ///
    /// # Shapes
    /// `candidates` is `[samples, horizon, action_dim]`, `costs` is `[samples]`.
    fn cost(&self, rollout: &Rollout, candidates: &[f32], horizon: usize, closest: bool, costs: &mut [f32]) {
        let (samples, latent) = (costs.len(), self.goal.len());
        let steps = self.start.len() / latent - 1 + horizon;
        let mut actions = Vec::with_capacity(samples * self.past.len() + candidates.len());
        self.extend(&mut actions, candidates, samples);
        let latents = rollout.run(&self.start, &actions, samples, steps);
        let compared = if closest { horizon } else { 1 };
        // The smaller of NaN and a number is the number.
        costs.fill(f32::NAN);
        for latents in &latents[latents.len() - compared..] {
            for (cost, end) in costs.iter_mut().zip(latents.chunks_exact(latent)) {
                *cost = cost.min(end.iter().zip(&self.goal).map(|(a, b)| (a - b).powi(2)).sum());
            }
        }
    }

    /// Appends the past actions and the actions of each candidate.
    fn extend(&self, actions: &mut Vec<f32>, candidates: &[f32], samples: usize) {
        for candidate in candidates.chunks_exact(candidates.len() / samples) {
            actions.extend_from_slice(&self.past);
            actions.extend_from_slice(candidate);
        }
    }
}

/// What to lower if the memory of a device does not suffice for all environments.
const TOGETHER: &str = "the environments (--envs), plan without --fast";
/// The most frames that a device encodes at once.
const DEVICE_FRAMES: usize = 256;
/// The most rollouts of one call to a device: activations of a published model then take about 5 GB.
const DEVICE_ROWS: usize = 20_000;

impl LewmCost {
    /// Writes the costs of candidates, computed on a device. All calls are queued before the first result is read.
    fn device_costs(&self, rollout: &DeviceRollout, candidates: &Candidates<'_>, costs: &mut [f32]) {
        let Candidates { actions, samples, horizon, dim, .. } = *candidates;
        let size = samples * horizon * dim;
        let most = if self.together { (DEVICE_ROWS / samples).max(1) } else { 1 };
        let mut queued = vec![];
        let mut done = 0;
        // Environments of one call have equally many past frames.
        for alike in self.contexts.chunk_by(|a, b| a.start.len() == b.start.len()) {
            for group in alike.chunks(most) {
                let (mut starts, mut goals) = (vec![], vec![]);
                let mut sequences = Vec::with_capacity(group.len() * (samples * group[0].past.len() + size));
                for (context, actions) in group.iter().zip(actions[done * size..].chunks_exact(size)) {
                    starts.extend_from_slice(&context.start);
                    goals.extend_from_slice(&context.goal);
                    context.extend(&mut sequences, actions, samples);
                }
                let steps = group[0].start.len() / group[0].goal.len() - 1 + horizon;
                queued.push(rollout.costs(starts, goals, sequences, samples, steps));
                done += group.len();
            }
        }
        let mut costs = costs;
        for part in queued {
            let values = part.into_data().into_f32_vec();
            let (now, later) = costs.split_at_mut(values.len());
            now.copy_from_slice(&values);
            costs = later;
        }
    }
}

impl CostModel for LewmCost {
    fn observe(&mut self, infos: &Batch, envs: &[usize]) -> Result<()> {
        checks::planning_images(infos.schema(), self.config.image, self.action_dim)?;
        let contexts: Result<Vec<PlanContext>> = match &self.device {
            Some(_) if self.together => {
                within_memory(&self.model.device(), TOGETHER, || self.contexts_together(infos, envs))
            }
            // Calls from several threads would wait for each other.
            Some(_) => envs.iter().map(|&env| self.context(infos, env)).collect(),
            None => envs.par_iter().map(|&env| self.context(infos, env)).collect(),
        };
        self.contexts = contexts?;
        Ok(())
    }

    fn cost(&mut self, candidates: Candidates<'_>, costs: &mut [f32]) -> Result<()> {
        self.check_sizes(&candidates, costs)?;
        let Candidates { actions, samples, horizon, dim, .. } = candidates;
        let closest = self.closest;
        let compute = || {
            let Some(host) = &self.host else {
                if let Some(rollout) = &self.device {
                    self.device_costs(rollout, &candidates, costs);
                }
                return Ok(());
            };
            // The candidates of each environment are split separately, so that no chunk spans two environments.
            let chunk_size = Rollout::chunk_size(samples);
            costs
                .par_chunks_mut(samples)
                .zip(actions.par_chunks(samples * horizon * dim))
                .zip(&self.contexts)
                .for_each(|((costs, actions), context)| {
                    let chunks = costs.par_chunks_mut(chunk_size).zip(actions.par_chunks(chunk_size * horizon * dim));
                    chunks.for_each(|(costs, actions)| context.cost(&host.rollout, actions, horizon, closest, costs));
                });
            Ok(())
        };
        let setting = if self.together { TOGETHER } else { "the solver's samples (--solver cem,samples=…)" };
        within_memory(&self.model.device(), setting, compute)
    }

    /// On a GPU, a call computes the candidates of all environments. On the CPU, this has no effect.
    fn plan_together(&mut self) {
        self.together = true;
    }

    /// On a GPU, the model cannot; an objective then compares latents of one-step predictions.
    fn compare_closest(&mut self) -> bool {
        self.closest = self.host.is_some();
        self.closest
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

    #[test]
    fn the_closest_latent_is_the_last_one_of_the_cheapest_shorter_plan() {
        let (samples, horizon, dim) = (5, 4, 4);
        let (config, model, infos) = model_of("tiny", &["model.predictor.history=2"], dim);
        let actions: Vec<f32> = (0..samples * horizon * dim).map(|i| (i * 29 % 97) as f32 / 20.0 - 2.0).collect();
        let costs = |horizon: usize, closest: bool, goal: usize| {
            let shorter: Vec<f32> =
                actions.chunks_exact(4 * dim).flat_map(|candidate| candidate[..horizon * dim].to_vec()).collect();
            let mut cost = LewmCost::of(&model, &config.model, dim);
            assert!(!closest || cost.compare_closest());
            cost.observe(&infos, &[0]).expect("observing the environment");
            for (index, value) in cost.contexts[0].goal.iter_mut().enumerate() {
                *value = ((goal * 7 + index) as f32).sin();
            }
            let candidates = Candidates { actions: &shorter, envs: 1, samples, horizon, dim };
            let (mut costs, mut again) = (vec![0.0; samples], vec![0.0; samples]);
            let mut gradient = vec![f32::NAN; shorter.len()];
            cost.cost(candidates, &mut costs).expect("computing the costs");
            cost.cost_and_gradient(candidates, &mut again, &mut gradient).expect("computing the gradients");
            for (cost, again) in costs.iter().zip(&again) {
                assert!((cost - again).abs() < 1e-4 * cost, "cost {cost}, with its gradient {again}");
            }
            (costs, gradient)
        };
        let mut steps = std::collections::BTreeSet::new();
        for goal in 0..8 {
            let (closest, gradients) = costs(horizon, true, goal);
            let shorter: Vec<(Vec<f32>, Vec<f32>)> = (1..=horizon).map(|horizon| costs(horizon, false, goal)).collect();
            for sample in 0..samples {
                let cheapest = (0..horizon)
                    .min_by(|&a, &b| shorter[a].0[sample].total_cmp(&shorter[b].0[sample]))
                    .expect("plans of every length");
                steps.insert(cheapest);
                assert_eq!(closest[sample], shorter[cheapest].0[sample]);
                let width = (cheapest + 1) * dim;
                let gradient = &gradients[sample * horizon * dim..][..horizon * dim];
                let expected = &shorter[cheapest].1[sample * width..][..width];
                for (value, expected) in gradient.iter().zip(expected) {
                    assert!((value - expected).abs() < 1e-4, "gradient {value}, of the shorter plan {expected}");
                }
                assert!(gradient[width..].iter().all(|&value| value == 0.0), "later actions have no effect");
            }
        }
        assert!(steps.len() > 1, "all plans are closest after step {steps:?}");
    }

    /// A model whose actions have an effect, its configuration, and a batch of one environment.
    fn model_of(preset: &str, settings: &[&str], dim: usize) -> (TrainConfig<Lewm>, Lewm, Batch) {
        let settings: Vec<String> = settings.iter().map(|setting| (*setting).to_owned()).collect();
        let config = TrainConfig::<Lewm>::load(preset, &settings).expect("loading the preset");
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
        (config, model, infos)
    }

    fn check_costs(preset: &str, settings: &[&str]) {
        let (samples, horizon, dim) = (5, 5, 4);
        let (config, model, infos) = model_of(preset, settings, dim);
        let actions: Vec<f32> = (0..samples * horizon * dim).map(|i| (i * 29 % 97) as f32 / 50.0 - 1.0).collect();
        // Environments with one frame and with two, so that a call for several environments is divided.
        let actions = actions.repeat(4);
        let costs = |on_host: bool, together: bool| {
            let mut cost = LewmCost::of(&model, &config.model, dim);
            if !on_host {
                cost.host = None;
                cost.device = Some(DeviceRollout::new(&model, Precision::Single));
            }
            if together {
                cost.plan_together();
            }
            cost.observe(&infos, &[0, 0, 0, 0]).expect("observing the environments");
            for (index, context) in cost.contexts.iter_mut().enumerate() {
                context.goal.iter_mut().for_each(|value| *value += index as f32);
                if index < 2 {
                    context.start.extend_from_within(..);
                    context.past = (0..dim).map(|i| i as f32 / 4.0 - 0.5).collect();
                }
            }
            let mut costs = vec![0.0; 4 * samples];
            let candidates = Candidates { actions: &actions, envs: 4, samples, horizon, dim };
            cost.cost(candidates, &mut costs).expect("computing the costs");
            costs
        };
        let (host, device) = (costs(true, false), costs(false, false));
        for (alone, together) in device.iter().zip(costs(false, true)) {
            assert!((alone - together).abs() < 1e-5 * alone.abs(), "alone {alone}, together {together}");
        }
        assert!(host.windows(2).all(|pair| pair[0] != pair[1]), "actions have no effect: {host:?}");
        for (host, device) in host.iter().zip(&device) {
            assert!((host - device).abs() < 1e-4 * device.abs(), "the CPU cost is {host}, the device cost is {device}");
        }
    }
}
