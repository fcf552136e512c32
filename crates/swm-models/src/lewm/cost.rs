//! [`LewmCost`]: what a candidate action sequence costs, as the squared distance between the latent it is predicted
//! to end in and the latent of the goal picture.
//!
//! Every environment is evaluated in calls of its own whose shapes do not depend on its neighbours, on one thread
//! each, of the current rayon pool: the plan of an environment is the same bytes whoever is planned beside it and
//! however many threads there are.

use super::config::LewmConfig;
use super::encode::HostEncoder;
use super::model::Lewm;
use super::pixels;
use super::rollout::Rollout;
use crate::checkpoint::Checkpoint;
use crate::nn::parameters::IntoF32;
use burn::tensor::{Device, Tensor, TensorData};
use rayon::prelude::*;
use swm_core::{Batch, Candidates, CostModel, DifferentiableCost, Error, LatentDynamics, Result, Schema};

/// The planning cost of a LeWM.
pub struct LewmCost {
    pub(super) model: Lewm,
    host: Option<Host>,
    pub(super) config: LewmConfig,
    pub(super) actions: usize,
    pub(super) scenes: Vec<Scene>,
}

/// The model laid out for the CPU; on other devices, it computes as it is.
struct Host {
    rollout: Rollout,
    encoder: Option<HostEncoder>,
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
        let on_host = model.device() == Device::flex();
        let host = on_host.then(|| Host { rollout: Rollout::new(model), encoder: HostEncoder::new(model, config) });
        Self { model: model.clone(), host, config: config.clone(), actions, scenes: vec![] }
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

    /// The latent of one picture, `[image, image, 3]` bytes.
    ///
    /// # Errors
    /// When it is of another size.
    pub fn latent_of(&self, rgb: &[u8]) -> Result<Vec<f32>> {
        let patches = pixels::patches(&self.config, rgb, &self.model.device())?;
        Ok(match self.host.as_ref().and_then(|host| host.encoder.as_ref()) {
            Some(encoder) => encoder.encode(&patches.into_data().into_f32_vec()),
            None => self.model.encode(patches).into_data().into_f32_vec(),
        })
    }

    /// Present and goal of one environment.
    fn look(&self, infos: &Batch, env: usize) -> Result<Scene> {
        let row = infos.row(env);
        // Each picture by itself: what a latent is must not depend on how many are encoded at once.
        let mut start = vec![self.latent_of(row.get::<u8>("pixels")?)?];
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
            past = actions[actions.len() - length * self.actions..].to_vec();
        }
        Ok(Scene { start: start.concat(), past, goal: self.latent_of(row.get::<u8>("goal")?)? })
    }
}

impl Scene {
    /// The costs of some candidates, `[samples, horizon, numbers]`.
    fn cost(&self, predictor: &Predicts<'_>, candidates: &[f32], horizon: usize, costs: &mut [f32]) {
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

/// Who predicts.
enum Predicts<'a> {
    Host(&'a Rollout),
    Device(&'a Lewm),
}

impl Predicts<'_> {
    /// The last latents of a rollout, `[samples, latent]`, from `start` `[seen, latent]`, with actions
    /// `[samples, steps, numbers]`.
    fn last(&self, start: &[f32], actions: Vec<f32>, samples: usize, steps: usize) -> Vec<f32> {
        match self {
            Self::Host(rollout) => rollout.run(start, &actions, samples, steps).pop().unwrap_or_default(),
            Self::Device(model) => {
                let device = model.device();
                let latent = model.latent();
                let (seen, numbers) = (start.len() / latent, actions.len() / (samples * steps));
                let start = Tensor::<3>::from_data(TensorData::new(start.to_vec(), [1, seen, latent]), &device);
                let actions = Tensor::from_data(TensorData::new(actions, [samples, steps, numbers]), &device);
                let all = model.rollout(start.expand([samples, seen, latent]), actions);
                all.slice([0..samples, steps..steps + 1, 0..latent]).into_data().into_f32_vec()
            }
        }
    }

    /// How many of `samples` candidates go together.
    fn part(&self, samples: usize) -> usize {
        match self {
            Self::Host(_) => Rollout::part(samples),
            Self::Device(_) => samples,
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
        let predictor = match &self.host {
            Some(host) => Predicts::Host(&host.rollout),
            None => Predicts::Device(&self.model),
        };
        // Parts are counted from each environment's first candidate.
        let (scenes, part) = (&self.scenes, predictor.part(samples));
        costs.par_chunks_mut(samples).zip(actions.par_chunks(samples * horizon * dim)).zip(scenes).for_each(
            |((costs, actions), scene)| {
                let parts = costs.par_chunks_mut(part).zip(actions.par_chunks(part * horizon * dim));
                parts.for_each(|(costs, actions)| scene.cost(&predictor, actions, horizon, costs));
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::TrainConfig;
    use crate::nn::parameters;
    use swm_core::{ColumnSpec, Key};

    #[test]
    fn other_devices_come_to_the_same_costs() {
        let config = TrainConfig::<Lewm>::load("tiny", &["model.predictor.history=3".to_owned()]).expect("a preset");
        let (samples, horizon, dim) = (5, 5, 4);
        let model = Lewm::init(&config.model, dim, Key::new(0), &Device::flex());
        // Modulations are zero before training; without them actions have no effect.
        let mut values = parameters::values(&model);
        for (_, tensor) in values.iter_mut().filter(|(name, _)| name.contains("adaLN")) {
            for (i, value) in tensor.values.iter_mut().enumerate() {
                *value = ((i * 37 % 101) as f32 / 101.0 - 0.5) * 0.4;
            }
        }
        let model = parameters::load(model, &values);
        let side = config.model.image;
        let columns = [ColumnSpec::image("pixels", side, side), ColumnSpec::image("goal", side, side)];
        let mut infos = Batch::zeros(&Schema::new(columns).expect("columns"), 1);
        infos.row_mut(0).at::<u8>(1).fill(200);
        let actions: Vec<f32> = (0..samples * horizon * dim).map(|i| (i * 29 % 97) as f32 / 50.0 - 1.0).collect();
        let costs = |on_host: bool| {
            let mut cost = LewmCost::of(&model, &config.model, dim);
            cost.host = cost.host.filter(|_| on_host);
            cost.observe(&infos, &[0]).expect("observed");
            let mut costs = vec![0.0; samples];
            let candidates = Candidates { actions: &actions, envs: 1, samples, horizon, dim };
            cost.cost(candidates, &mut costs).expect("costs");
            costs
        };
        let (host, other) = (costs(true), costs(false));
        assert!(host.windows(2).all(|pair| pair[0] != pair[1]), "actions have no effect: {host:?}");
        for (host, other) in host.iter().zip(&other) {
            assert!((host - other).abs() < 1e-4 * other.abs(), "{host} for {other}");
        }
    }
}
