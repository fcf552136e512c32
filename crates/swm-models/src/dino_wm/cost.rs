//! [`DinoWmCost`]: what a candidate action sequence costs, as the mean squared distance between the patches it is
//! predicted to end in and those of the goal picture; where the goal of a column is known (`goal_proprio` for `proprio`),
//! the distance between the features of both is added.
//!
//! As for a LeWM, an environment is evaluated in calls of its own whose shapes do not depend on its neighbours: its plan
//! is the same bytes whoever is planned beside it and however many threads there are.

use super::config::{ACTION, DinoWmConfig};
use super::model::DinoWm;
use super::train::normalised;
use crate::checkpoint::Checkpoint;
use crate::nn::parameters::IntoF32;
use crate::pixels;
use crate::train::DatasetInfo;
use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use rayon::prelude::*;
use swm_core::{Batch, Candidates, CostModel, DifferentiableCost, Error, Result, Schema};

/// The planning cost of a DINO-WM.
pub struct DinoWmCost {
    model: DinoWm,
    config: DinoWmConfig,
    dataset_info: DatasetInfo,
    actions: usize,
    scenes: Vec<Scene>,
}

/// Present and goal of one environment.
struct Scene {
    /// The frames seen, oldest first, the present last: `[1, seen, patches, dim]`.
    start: Tensor<4>,
    /// The actions taken between them, in model units: `[seen - 1, actions]`.
    past: Vec<f32>,
    /// The features of the goal's patches, `[1, patches, features]`.
    goal: Tensor<3>,
    /// Where a column stands in a frame, and the features of its goal, `[1, dim]`.
    columns: Vec<(std::ops::Range<usize>, Tensor<2>)>,
}

/// Candidates that are predicted at once: a frame is many tokens, so few fill a core's cache.
const PART: usize = 16;

impl DinoWmCost {
    /// The cost of a trained model.
    pub fn new(checkpoint: &Checkpoint<DinoWm>) -> Self {
        Self {
            model: checkpoint.model.clone(),
            config: checkpoint.config.model.clone(),
            dataset_info: checkpoint.dataset_info.clone(),
            actions: checkpoint.actions(),
            scenes: vec![],
        }
    }

    /// Checks that everything needed is there.
    fn check(&self, schema: &Schema) -> Result<()> {
        let side = self.config.image;
        pixels::check(side, schema, "pixels")?;
        pixels::check(side, schema, "goal")?;
        for column in self.config.columns.iter().filter(|column| column.name != ACTION) {
            let (given, wanted) = (&schema.column(&column.name)?.shape, &self.dataset_info.column(&column.name)?.shape);
            if given != wanted {
                return Err(Error::mismatch(
                    format!("reading '{}'", column.name),
                    format!("{given:?}"),
                    format!("{wanted:?}, as the model was trained"),
                ));
            }
        }
        if schema.find("history.length").is_some() {
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
    fn fits(&self, candidates: &Candidates<'_>, costs: &[f32]) -> Result<()> {
        let Candidates { envs, samples, dim, .. } = *candidates;
        if envs == self.scenes.len() && dim == self.actions && costs.len() == envs * samples {
            return Ok(());
        }
        let words = |envs, dim, costs| format!("{envs} environments, {dim} numbers a model step, {costs} costs");
        Err(Error::mismatch(
            "costs of a DINO-WM",
            words(envs, dim, costs.len()),
            words(self.scenes.len(), self.actions, envs * samples),
        ))
    }

    /// Present and goal of one environment.
    fn look(&self, infos: &Batch, env: usize) -> Result<Scene> {
        let (row, device) = (infos.row(env), Device::flex());
        // Each picture by itself: what a frame is must not depend on how many are encoded at once.
        let encode = |rgb: &[u8]| Ok::<_, Error>(self.model.backbone.patches(self.config.cut(rgb, &device)?));
        let column = |name: &str, values: &[f32]| normalised(&self.dataset_info, name, values, [1, 1], &device);
        // Columns are not among the past that a policy keeps, so with any the present alone is seen.
        let others: Vec<&str> =
            self.config.columns.iter().map(|column| column.name.as_str()).filter(|name| *name != ACTION).collect();
        let (mut frames, mut past) = (vec![encode(row.get::<u8>("pixels")?)?], vec![]);
        if others.is_empty() && infos.schema().find("history.length").is_some() {
            let kept = infos.schema().column("history.action")?.shape[0];
            let length = usize::try_from(row.get::<i32>("history.length")?[0]).unwrap_or(0);
            let length = length.min(self.config.predictor.history - 1).min(kept);
            let (pictures, actions) = (row.get::<u8>("history.pixels")?, row.get::<f32>("history.action")?);
            let bytes = self.config.image.pow(2) * 3;
            for frame in pictures[pictures.len() - length * bytes..].rchunks_exact(bytes) {
                frames.insert(0, encode(frame)?);
            }
            past = actions[actions.len() - length * self.actions..].to_vec();
        }
        let seen = frames.len();
        let features: Tensor<4> = Tensor::cat(frames, 0).unsqueeze_dim(0);
        let beside: Result<Vec<Tensor<3>>> = self
            .config
            .columns
            .iter()
            .map(|spec| match spec.name.as_str() {
                ACTION => Ok(Tensor::zeros([1, seen, self.actions], &device)),
                name => column(name, row.get::<f32>(name)?),
            })
            .collect();
        let mut columns = vec![];
        let spans = self.model.columns();
        for ((name, encoder), (_, span)) in self.model.extra_encoders.iter().zip(spans) {
            let goal = format!("goal_{name}");
            if name != ACTION && infos.schema().find(&goal).is_some() {
                let features = encoder.forward(column(name, row.get::<f32>(&goal)?)?);
                columns.push((span, features.squeeze_dim(0)));
            }
        }
        Ok(Scene { start: self.model.embed(features, &beside?), past, goal: encode(row.get::<u8>("goal")?)?, columns })
    }
}

impl Scene {
    /// The costs `[samples]` of candidates `[samples, horizon, numbers]`, all with autodiff or all without.
    fn cost(&self, model: &DinoWm, candidates: Tensor<3>) -> Tensor<1> {
        // Where the candidates are differentiated, everything that meets them is in their graph.
        let differentiated = candidates.is_autodiff();
        let [samples, _, numbers] = candidates.dims();
        let [_, seen, patches, dim] = self.start.dims();
        let past = TensorData::new(self.past.repeat(samples), [samples, seen - 1, numbers]);
        let past = Tensor::<3>::from_data(past, &Device::flex());
        let (start, past, goal) = (self.start.clone(), past, self.goal.clone());
        let (start, past, goal) =
            if differentiated { (start.autodiff(), past.autodiff(), goal.autodiff()) } else { (start, past, goal) };
        let actions = if seen > 1 { Tensor::cat(vec![past, candidates], 1) } else { candidates };
        let [_, steps, _] = actions.dims();
        let all = model.rollout(start.expand([samples, seen, patches, dim]), actions);
        let end = all.slice([0..samples, steps..steps + 1, 0..patches, 0..dim]).reshape([samples, patches, dim]);
        let [_, _, width] = goal.dims();
        let apart = (end.clone().slice([0..samples, 0..patches, 0..width]) - goal).square();
        let mut cost = apart.reshape([samples, patches * width]).mean_dim(1);
        for (span, goal) in &self.columns {
            // A column's features are the same beside every patch; the first stands for all, as published.
            let goal = if differentiated { goal.clone().autodiff() } else { goal.clone() };
            let found = end.clone().slice([0..samples, 0..1, span.clone()]).reshape([samples, span.len()]);
            cost = cost + (found - goal).square().mean_dim(1);
        }
        cost.reshape([samples])
    }
}

impl CostModel for DinoWmCost {
    fn observe(&mut self, infos: &Batch, envs: &[usize]) -> Result<()> {
        self.check(infos.schema())?;
        let scenes: Result<Vec<Scene>> = envs.par_iter().map(|&env| self.look(infos, env)).collect();
        self.scenes = scenes?;
        Ok(())
    }

    fn cost(&mut self, candidates: Candidates<'_>, costs: &mut [f32]) -> Result<()> {
        self.fits(&candidates, costs)?;
        let Candidates { actions, samples, horizon, dim, .. } = candidates;
        let (model, per) = (&self.model, horizon * dim);
        let work = costs.par_chunks_mut(samples).zip(actions.par_chunks(samples * per)).zip(&self.scenes);
        work.for_each(|((costs, actions), scene)| {
            costs.par_chunks_mut(PART).zip(actions.par_chunks(PART * per)).for_each(|(costs, actions)| {
                let data = TensorData::new(actions.to_vec(), [costs.len(), horizon, dim]);
                let found = scene.cost(model, Tensor::from_data(data, &Device::flex()));
                costs.copy_from_slice(&found.into_data().into_f32_vec());
            });
        });
        Ok(())
    }

    fn differentiable(&mut self) -> Option<&mut dyn DifferentiableCost> {
        Some(self)
    }
}

impl DifferentiableCost for DinoWmCost {
    fn cost_and_gradient(&mut self, candidates: Candidates<'_>, costs: &mut [f32], gradient: &mut [f32]) -> Result<()> {
        self.fits(&candidates, costs)?;
        let Candidates { actions, samples, horizon, dim, .. } = candidates;
        if gradient.len() != actions.len() {
            return Err(Error::mismatch(
                "gradients of a DINO-WM",
                gradient.len().to_string(),
                actions.len().to_string(),
            ));
        }
        // The weights are constants.
        let (model, per) = (self.model.clone().train().no_grad(), horizon * dim);
        let envs = costs.par_chunks_mut(samples).zip(gradient.par_chunks_mut(samples * per));
        envs.zip(actions.par_chunks(samples * per)).zip(&self.scenes).for_each(
            |(((costs, gradient), actions), scene)| {
                let parts = costs.par_chunks_mut(PART).zip(gradient.par_chunks_mut(PART * per));
                parts.zip(actions.par_chunks(PART * per)).for_each(|((costs, gradient), actions)| {
                    let data = TensorData::new(actions.to_vec(), [costs.len(), horizon, dim]);
                    let free = Tensor::<3>::from_data(data, &Device::flex()).autodiff().require_grad();
                    let found = scene.cost(&model, free.clone());
                    costs.copy_from_slice(&found.clone().inner().into_data().into_f32_vec());
                    match free.grad(&found.sum().backward()) {
                        Some(found) => gradient.copy_from_slice(&found.into_data().into_f32_vec()),
                        None => gradient.fill(0.0),
                    }
                });
            },
        );
        Ok(())
    }
}
