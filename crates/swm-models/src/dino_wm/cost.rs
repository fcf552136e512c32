//! [`DinoWmCost`]: the planning cost of a DINO-WM, the mean squared distance between the patches of the goal image and the last
//! predicted patches of a candidate, or the closest ones. If the goal of a column is given (`goal_proprio` for `proprio`), the
//! mean squared distance between the predicted features and the goal features of the column is added.
//!
//! Every environment is evaluated in calls whose shapes do not depend on the other environments, so the
//! bytes of an environment's plan depend neither on the other environments nor on the number of threads.

use super::config::{ACTION, DinoWmConfig};
use super::model::DinoWm;
use super::train::normalised;
use crate::checkpoint::Checkpoint;
use crate::checks;
use crate::nn::parameters::IntoF32;
use crate::train::DatasetInfo;
use burn::module::Module;
use burn::tensor::{Tensor, TensorData};
use rayon::prelude::*;
use swm_core::columns::{GOAL, PIXELS};
use swm_core::{Batch, Candidates, CostModel, DifferentiableCost, Error, Result, Schema};

/// The planning cost of a DINO-WM.
pub struct DinoWmCost {
    model: DinoWm,
    config: DinoWmConfig,
    dataset_info: DatasetInfo,
    action_dim: usize,
    /// Whether the cost is that of the closest predicted frame, not of the last one.
    closest: bool,
    contexts: Vec<PlanContext>,
}

/// The start frames and the goal of one environment's plan.
struct PlanContext {
    /// The last frames, oldest first: `[1, frames, patches, dim]`.
    start: Tensor<4>,
    /// The actions taken between the start frames, in model units: `[frames - 1, action_dim]`.
    past: Vec<f32>,
    /// The features of the goal's patches, `[1, patches, features]`.
    goal: Tensor<3>,
    /// The feature range of each column with a goal, and the features of the goal, `[1, dim]`.
    columns: Vec<(std::ops::Range<usize>, Tensor<2>)>,
}

/// The number of tokens in the windows of a rollout call: enough for efficient matrix products, few enough for a core's cache.
const CHUNK_TOKENS: usize = 256;
/// The least and the largest number of candidates in a rollout call.
const CHUNK_SIZES: (usize, usize) = (16, 160);

impl DinoWmCost {
    /// Creates the planning cost of a trained model.
    pub fn new(checkpoint: &Checkpoint<DinoWm>) -> Self {
        Self {
            model: checkpoint.model.clone(),
            config: checkpoint.config.model.clone(),
            dataset_info: checkpoint.dataset_info.clone(),
            action_dim: checkpoint.action_dim(),
            closest: false,
            contexts: vec![],
        }
    }

    fn check_columns(&self, schema: &Schema) -> Result<()> {
        checks::planning_images(schema, self.config.image, self.action_dim)?;
        let columns = self.config.columns.iter().filter(|column| column.name != ACTION);
        columns
            .map(|column| &column.name)
            .try_for_each(|name| checks::column_shape(schema, name, &self.dataset_info.column(name)?.shape))
    }

    /// Checks that the lengths of candidates and costs fit the observed environments.
    fn check_sizes(&self, candidates: &Candidates<'_>, costs: &[f32]) -> Result<()> {
        checks::candidate_sizes("costs of a DINO-WM", candidates, costs, [self.contexts.len(), self.action_dim])
    }

    /// Returns the number of candidates in a rollout call: equal parts of `samples`. It depends on no other environment and not on
    /// the machine, because the rounding of products could depend on it.
    fn chunk_size(&self, samples: usize) -> usize {
        let window = self.config.patches() * self.config.predictor.history;
        let most = (CHUNK_TOKENS / window.max(1)).clamp(CHUNK_SIZES.0, CHUNK_SIZES.1);
        samples.div_ceil(samples.div_ceil(most).max(1)).max(1)
    }

    /// Encodes the current frame, the recorded history and the goal of one environment.
    fn context(&self, infos: &Batch, env: usize) -> Result<PlanContext> {
        let (row, device) = (infos.row(env), self.model.device());
        // One image per call: features must not depend on the number of images in a call.
        let encode = |rgb: &[u8]| Ok::<_, Error>(self.model.backbone.patches(self.config.image_patches(rgb, &device)?));
        let column = |name: &str, from: &str| normalised(&self.dataset_info, name, &row.to_f32(from)?, [1, 1], &device);
        // The recorded history has images and actions only: if the model reads further columns, a plan starts from the
        // current frame.
        let further_columns: Vec<&str> =
            self.config.columns.iter().map(|column| column.name.as_str()).filter(|name| *name != ACTION).collect();
        let (mut frames, mut past) = (vec![encode(row.get::<u8>(PIXELS)?)?], vec![]);
        if further_columns.is_empty() && infos.schema().find("history.length").is_some() {
            let recorded = infos.schema().column("history.action")?.shape[0];
            let length = usize::try_from(row.get::<i32>("history.length")?[0]).unwrap_or(0);
            let length = length.min(self.config.predictor.history - 1).min(recorded);
            let (images, actions) = (row.get::<u8>("history.pixels")?, row.get::<f32>("history.action")?);
            let bytes = self.config.image.pow(2) * 3;
            for frame in images[images.len() - length * bytes..].rchunks_exact(bytes) {
                frames.insert(0, encode(frame)?);
            }
            past = actions[actions.len() - length * self.action_dim..].to_vec();
        }
        let count = frames.len();
        let features: Tensor<4> = Tensor::cat(frames, 0).unsqueeze_dim(0);
        let inputs: Result<Vec<Tensor<3>>> = self
            .config
            .columns
            .iter()
            .map(|spec| match spec.name.as_str() {
                ACTION => Ok(Tensor::zeros([1, count, self.action_dim], &device)),
                name => column(name, name),
            })
            .collect();
        let mut columns = vec![];
        let spans = self.model.columns();
        for ((name, encoder), (_, span)) in self.model.extra_encoders.iter().zip(spans) {
            let goal = format!("goal_{name}");
            if name != ACTION && infos.schema().find(&goal).is_some() {
                let features = encoder.forward(column(name, &goal)?);
                columns.push((span, features.squeeze_dim(0)));
            }
        }
        Ok(PlanContext {
            start: self.model.embed(features, &inputs?),
            past,
            goal: encode(row.get::<u8>(GOAL)?)?,
            columns,
        })
    }
}

impl PlanContext {
    /// Returns the costs of candidates, in the autodiff graph of the candidates if there is one: of the last frame, or of the
    /// `closest` one.
    ///
    /// # Shapes
    /// `candidates` is `[samples, horizon, action_dim]`; returns `[samples]`.
    fn cost(&self, model: &DinoWm, candidates: Tensor<3>, closest: bool) -> Tensor<1> {
        // If the candidates are in an autodiff graph, all operands must be in the graph.
        let differentiated = candidates.is_autodiff();
        let [samples, horizon, elements] = candidates.dims();
        let [_, frames, patches, dim] = self.start.dims();
        let past = TensorData::new(self.past.repeat(samples), [samples, frames - 1, elements]);
        let past = Tensor::<3>::from_data(past, &self.start.device());
        let (start, past, goal) = (self.start.clone(), past, self.goal.clone());
        let (start, past, goal) =
            if differentiated { (start.autodiff(), past.autodiff(), goal.autodiff()) } else { (start, past, goal) };
        let actions = if frames > 1 { Tensor::cat(vec![past, candidates], 1) } else { candidates };
        let [_, steps, _] = actions.dims();
        let all = model.rollout(start.expand([samples, frames, patches, dim]), actions);
        let compared = if closest { horizon } else { 1 };
        let ends = all.slice([0..samples, steps + 1 - compared..steps + 1, 0..patches, 0..dim]);
        let [_, _, width] = goal.dims();
        let part = |patches: usize, span: std::ops::Range<usize>| {
            let features = span.len();
            let part = ends.clone().slice([0..samples, 0..compared, 0..patches, span]);
            part.reshape([samples, compared, patches * features])
        };
        let mut cost = (part(patches, 0..width) - goal.reshape([1, 1, patches * width])).square().mean_dim(2);
        for (span, goal) in &self.columns {
            // Every patch of a recorded frame has the same column features, so, as published, only the first patch is
            // compared.
            let goal = if differentiated { goal.clone().autodiff() } else { goal.clone() };
            cost = cost + (part(1, span.clone()) - goal.unsqueeze_dim(0)).square().mean_dim(2);
        }
        let cost = if closest { cost.min_dim(1) } else { cost };
        cost.reshape([samples])
    }
}

impl CostModel for DinoWmCost {
    fn observe(&mut self, infos: &Batch, envs: &[usize]) -> Result<()> {
        self.check_columns(infos.schema())?;
        let contexts: Result<Vec<PlanContext>> = envs.par_iter().map(|&env| self.context(infos, env)).collect();
        self.contexts = contexts?;
        Ok(())
    }

    fn cost(&mut self, candidates: Candidates<'_>, costs: &mut [f32]) -> Result<()> {
        self.check_sizes(&candidates, costs)?;
        let Candidates { actions, samples, horizon, dim, .. } = candidates;
        let (model, closest, candidate_len) = (&self.model, self.closest, horizon * dim);
        let chunk_size = self.chunk_size(samples);
        let work = costs.par_chunks_mut(samples).zip(actions.par_chunks(samples * candidate_len)).zip(&self.contexts);
        work.for_each(|((costs, actions), context)| {
            costs.par_chunks_mut(chunk_size).zip(actions.par_chunks(chunk_size * candidate_len)).for_each(
                |(costs, actions)| {
                    let data = TensorData::new(actions.to_vec(), [costs.len(), horizon, dim]);
                    let found = context.cost(model, Tensor::from_data(data, &context.start.device()), closest);
                    costs.copy_from_slice(&found.into_data().into_f32_vec());
                },
            );
        });
        Ok(())
    }

    fn compare_closest(&mut self) -> bool {
        self.closest = true;
        true
    }

    fn differentiable(&mut self) -> Option<&mut dyn DifferentiableCost> {
        Some(self)
    }
}

impl DifferentiableCost for DinoWmCost {
    fn cost_and_gradient(&mut self, candidates: Candidates<'_>, costs: &mut [f32], gradient: &mut [f32]) -> Result<()> {
        self.check_sizes(&candidates, costs)?;
        let Candidates { actions, samples, horizon, dim, .. } = candidates;
        if gradient.len() != actions.len() {
            return Err(Error::mismatch(
                "the number of elements in the gradient of a DINO-WM's cost",
                gradient.len().to_string(),
                actions.len().to_string(),
            ));
        }
        // Only the candidates are differentiated; the weights are constants.
        let (model, candidate_len) = (self.model.clone().train().no_grad(), horizon * dim);
        let (closest, chunk_size) = (self.closest, self.chunk_size(samples));
        let envs = costs.par_chunks_mut(samples).zip(gradient.par_chunks_mut(samples * candidate_len));
        envs.zip(actions.par_chunks(samples * candidate_len)).zip(&self.contexts).for_each(
            |(((costs, gradient), actions), context)| {
                let chunks = costs.par_chunks_mut(chunk_size).zip(gradient.par_chunks_mut(chunk_size * candidate_len));
                chunks.zip(actions.par_chunks(chunk_size * candidate_len)).for_each(|((costs, gradient), actions)| {
                    let data = TensorData::new(actions.to_vec(), [costs.len(), horizon, dim]);
                    let leaf = Tensor::<3>::from_data(data, &context.start.device()).autodiff().require_grad();
                    let found = context.cost(&model, leaf.clone(), closest);
                    costs.copy_from_slice(&found.clone().inner().into_data().into_f32_vec());
                    match leaf.grad(&found.sum().backward()) {
                        Some(found) => gradient.copy_from_slice(&found.into_data().into_f32_vec()),
                        None => gradient.fill(0.0),
                    }
                });
            },
        );
        Ok(())
    }
}
