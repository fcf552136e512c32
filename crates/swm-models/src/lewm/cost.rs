//! [`LewmCost`]: what a candidate action sequence costs, as the squared distance between the latent it is predicted
//! to end in and the latent of the goal picture.
//!
//! Every environment is evaluated in calls of its own whose shapes do not depend on its neighbours, on one thread
//! each, of the current rayon pool: the plan of an environment is the same bytes whoever is planned beside it and
//! however many threads there are.

use super::config::LewmConfig;
use super::model::Lewm;
use super::pixels;
use super::rollout::Rollout;
use crate::checkpoint::Checkpoint;
use crate::nn::parameters::IntoF32;
use burn::tensor::Device;
use rayon::prelude::*;
use swm_core::{Batch, Candidates, CostModel, DifferentiableCost, Error, LatentDynamics, Result, Schema};

/// The planning cost of a LeWM.
pub struct LewmCost {
    pub(super) model: Lewm,
    rollout: Rollout,
    pub(super) config: LewmConfig,
    pub(super) actions: usize,
    pub(super) scenes: Vec<Scene>,
}

/// Present and goal of one environment.
#[derive(Clone)]
pub(super) struct Scene {
    /// The latents of the frames seen, oldest first, the present last: `[seen, latent]`.
    pub start: Vec<f32>,
    /// The actions taken between them, in model units: `[seen - 1, actions]`.
    pub past: Vec<f32>,
    /// The latent of the goal picture, `[latent]`.
    pub goal: Vec<f32>,
}

impl LewmCost {
    /// The cost of a trained model.
    pub fn new(checkpoint: &Checkpoint<Lewm>) -> Self {
        Self::of(&checkpoint.model, &checkpoint.config.model, checkpoint.actions())
    }

    /// The cost of a model of these sizes, whose actions are `actions` numbers.
    pub fn of(model: &Lewm, config: &LewmConfig, actions: usize) -> Self {
        Self { model: model.clone(), rollout: Rollout::new(model), config: config.clone(), actions, scenes: vec![] }
    }

    /// Checks that everything needed is there.
    fn check(&self, schema: &Schema) -> Result<()> {
        pixels::check(&self.config, schema, "pixels")?;
        pixels::check(&self.config, schema, "goal")?;
        if schema.find("history.length").is_some() {
            let side = self.config.image;
            let past = schema.column("history.action")?.shape.first().copied().unwrap_or(0);
            let wanted = [("history.action", vec![past, self.actions]), ("history.pixels", vec![past, side, side, 3])];
            for (name, shape) in wanted {
                let given = &schema.column(name)?.shape;
                if *given != shape {
                    return Err(Error::mismatch(
                        format!("reading '{name}'"),
                        format!("{given:?}"),
                        format!("{shape:?}, as the model was trained"),
                    ));
                }
            }
        }
        Ok(())
    }

    /// Checks that candidates and costs are those of the observed environments.
    pub(super) fn fits(&self, candidates: &Candidates<'_>, costs: &[f32]) -> Result<()> {
        let Candidates { envs, samples, dim, .. } = *candidates;
        if envs == self.scenes.len() && dim == self.actions && costs.len() == envs * samples {
            return Ok(());
        }
        let words = |envs, dim, costs| format!("{envs} environments, {dim} numbers a model step, {costs} costs");
        Err(Error::mismatch(
            "costs of a LeWM",
            words(envs, dim, costs.len()),
            words(self.scenes.len(), self.actions, envs * samples),
        ))
    }

    /// Present and goal of one environment.
    fn look(&self, infos: &Batch, env: usize) -> Result<Scene> {
        let row = infos.row(env);
        let device = Device::flex();
        let encode = |rgb: &[u8]| {
            let latent = self.model.encode(pixels::patches(&self.config, rgb, &device)?);
            Ok::<_, Error>(latent.into_data().try_into_vec_as_f32())
        };
        // Each picture by itself: what a latent is must not depend on how many are encoded at once.
        let mut start = vec![encode(row.get::<u8>("pixels")?)?];
        let mut past = vec![];
        if infos.schema().find("history.length").is_some() {
            let length = usize::try_from(row.get::<i32>("history.length")?[0]).unwrap_or(0);
            let length =
                length.min(self.config.predictor.history - 1).min(infos.schema().column("history.action")?.shape[0]);
            let bytes = self.config.image * self.config.image * 3;
            let frames = row.get::<u8>("history.pixels")?;
            let actions = row.get::<f32>("history.action")?;
            for frame in frames[frames.len() - length * bytes..].rchunks_exact(bytes) {
                start.insert(0, encode(frame)?);
            }
            past = actions[actions.len() - length * self.actions..].to_vec();
        }
        Ok(Scene { start: start.concat(), past, goal: encode(row.get::<u8>("goal")?)? })
    }
}

impl Scene {
    /// The costs of some candidates, `[samples, horizon, numbers]`.
    fn cost(&self, rollout: &Rollout, latent: usize, candidates: &[f32], horizon: usize, costs: &mut [f32]) {
        let samples = costs.len();
        let steps = self.start.len() / latent - 1 + horizon;
        let mut actions = Vec::with_capacity(samples * self.past.len() + candidates.len());
        for candidate in candidates.chunks_exact(candidates.len() / samples) {
            actions.extend_from_slice(&self.past);
            actions.extend_from_slice(candidate);
        }
        let latents = rollout.run(&self.start, &actions, samples, steps);
        for (cost, end) in costs.iter_mut().zip(latents[steps].chunks_exact(latent)) {
            *cost = end.iter().zip(&self.goal).map(|(a, b)| (a - b).powi(2)).sum();
        }
    }
}

impl CostModel for LewmCost {
    fn observe(&mut self, infos: &Batch, envs: &[usize]) -> Result<()> {
        self.check(infos.schema())?;
        let scenes: Result<Vec<Scene>> = envs.par_iter().map(|&env| self.look(infos, env)).collect();
        self.scenes = scenes?;
        Ok(())
    }

    fn cost(&mut self, candidates: Candidates<'_>, costs: &mut [f32]) -> Result<()> {
        self.fits(&candidates, costs)?;
        let Candidates { actions, samples, horizon, dim, .. } = candidates;
        let (rollout, scenes, latent) = (&self.rollout, &self.scenes, self.config.latent);
        // Parts are counted from each environment's first candidate.
        let part = Rollout::part(samples);
        costs.par_chunks_mut(samples).zip(actions.par_chunks(samples * horizon * dim)).zip(scenes).for_each(
            |((costs, actions), scene)| {
                let parts = costs.par_chunks_mut(part).zip(actions.par_chunks(part * horizon * dim));
                parts.for_each(|(costs, actions)| scene.cost(rollout, latent, actions, horizon, costs));
            },
        );
        Ok(())
    }

    fn differentiable(&mut self) -> Option<&mut dyn DifferentiableCost> {
        Some(self)
    }

    fn latent(&mut self) -> Option<&mut dyn LatentDynamics> {
        Some(self)
    }
}
