//! The heads of goal-conditioned models, whose inputs are the patches of frames and of a goal: policies and values
//! ([`Head`]), values that are distances ([`ValueHead`]), and critics ([`Critic`]).

use super::transformer::{PatchGrid, Pool, Transformer, TransformerConfig};
use crate::nn::{Activation, DropoutRng, Init, Linear};
use burn::module::{Module, Param};
use burn::tensor::Tensor;

/// A network with one output vector per frame given the goal: the mean action of a policy, or a value.
#[derive(Module, Debug)]
pub struct Head {
    /// Position embeddings of the frames' patches, `[1, frames * patches, dim]`.
    pub pos_embedding: Param<Tensor<3>>,
    /// Position embeddings of the goal's patches, `[1, patches, dim]`.
    pub pos_embedding_goal: Param<Tensor<3>>,
    /// The transformer over frames and goal.
    pub transformer: Transformer,
    /// The output layer.
    pub out_proj: Linear,
    emb_dropout: f32,
}

/// A network for the value of a frame given the goal: a [`Head`] with one output, or a metric.
///
/// The metric is that of Hilbert representations (HILP; Park, Kreiman and Levine 2024, *Foundation Policies with Hilbert
/// Representations*, equation 4): the negative distance `-‖φ(s) - φ(g)‖` of frame and goal in a learnt space. Both are
/// encoded by the same network, the goal as if it were the first frame.
#[derive(Module, Debug)]
pub struct ValueHead {
    /// Position embeddings of the frames' patches, `[1, frames * patches, dim]`.
    pub pos_embedding: Param<Tensor<3>>,
    /// Position embeddings of the goal's patches, `[1, patches, dim]`; part of published weights of a metric, which does not
    /// read them.
    pub pos_embedding_goal: Param<Tensor<3>>,
    /// The transformer over frames and goal, or over the frames alone.
    pub transformer: Transformer,
    /// The output layer of a value without a metric.
    pub out_proj: Option<Linear>,
    /// The layer to the space of the metric.
    pub embed_proj: Option<Linear>,
    emb_dropout: f32,
}

/// A network for the value of an action given a frame and the goal.
#[derive(Module, Debug)]
pub struct Critic {
    /// Position embeddings of the frames' patches, `[1, frames * patches, dim]`.
    pub pos_embedding: Param<Tensor<3>>,
    /// Position embeddings of the goal's patches, `[1, patches, dim]`.
    pub pos_embedding_goal: Param<Tensor<3>>,
    /// The transformer over frames and goal.
    pub transformer: Transformer,
    /// Maps the transformer's output and the action to the value.
    pub q_head: CriticHead,
    emb_dropout: f32,
}

/// The last layers of a critic: two hidden layers with ReLU, then the output layer. The parameters of field `_2` are
/// stored under the name `2`.
#[derive(Module, Debug)]
pub struct CriticHead {
    /// The layer to the hidden features.
    pub _0: Linear,
    /// The layer between the hidden features.
    pub _2: Linear,
    /// The output layer.
    pub _4: Linear,
}

impl Head {
    /// Creates a head with `outputs` outputs and random weights.
    pub fn new(init: &Init, size: &TransformerConfig, grid: PatchGrid, pool: Pool, outputs: usize) -> Self {
        let [pos_embedding, pos_embedding_goal] = positions(init, grid);
        Self {
            pos_embedding,
            pos_embedding_goal,
            transformer: size.init(&init.of("transformer"), grid, pool),
            out_proj: Linear::new(&init.of("out_proj"), grid.dim, outputs),
            emb_dropout: size.emb_dropout,
        }
    }

    /// Computes the outputs of every frame.
    ///
    /// # Shapes
    /// `frames` is `[rows, frames * patches, dim]` with `frames` at most [`PatchGrid::frames`], `goal` is
    /// `[rows, patches, dim]`; returns `[rows, frames, outputs]`.
    pub fn forward(&self, frames: &Tensor<3>, goal: &Tensor<3>, rng: &mut DropoutRng<'_>) -> Tensor<3> {
        let (frames, goal) = add_positions([&self.pos_embedding, &self.pos_embedding_goal], frames, goal);
        let frames = rng.dropout(frames, self.emb_dropout);
        self.out_proj.forward(self.transformer.forward(frames, &goal, rng))
    }
}

impl ValueHead {
    /// Creates a value with random weights; `metric` is the dimension of the space of a metric, 0 for none.
    pub fn new(init: &Init, size: &TransformerConfig, grid: PatchGrid, metric: usize) -> Self {
        let [pos_embedding, pos_embedding_goal] = positions(init, grid);
        let is_metric = metric > 0;
        let pool = if is_metric { Pool::SelfAttention } else { Pool::Mean };
        Self {
            pos_embedding,
            pos_embedding_goal: if is_metric { pos_embedding_goal.set_require_grad(false) } else { pos_embedding_goal },
            transformer: size.init(&init.of("transformer"), grid, pool),
            out_proj: (!is_metric).then(|| Linear::new(&init.of("out_proj"), grid.dim, 1)),
            embed_proj: is_metric.then(|| Linear::new(&init.of("embed_proj"), grid.dim, metric)),
            emb_dropout: size.emb_dropout,
        }
    }

    /// Computes the value of every frame.
    ///
    /// # Shapes
    /// As [`Head::forward`], with one output.
    pub fn forward(&self, frames: &Tensor<3>, goal: &Tensor<3>, rng: &mut DropoutRng<'_>) -> Tensor<3> {
        let Some(projection) = &self.embed_proj else {
            let (frames, goal) = add_positions([&self.pos_embedding, &self.pos_embedding_goal], frames, goal);
            let frames = rng.dropout(frames, self.emb_dropout);
            let features = self.transformer.forward(frames, &goal, rng);
            return match &self.out_proj {
                Some(layer) => layer.forward(features),
                None => features,
            };
        };
        let mut encode = |images: &Tensor<3>| {
            let images = rng.dropout(add_position(&self.pos_embedding, images), self.emb_dropout);
            projection.forward(self.transformer.forward(images.clone(), &images, rng))
        };
        let (frames, goal) = (encode(frames), encode(goal));
        let [rows, count, dim] = frames.dims();
        let squares = (frames - goal.expand([rows, count, dim])).square().sum_dim(2);
        // The root has no gradient at 0.
        -squares.clamp_min(LEAST_SQUARE).sqrt()
    }
}

/// The least square of a distance, as published.
const LEAST_SQUARE: f32 = 1e-6;

impl Critic {
    /// Creates a critic for actions of `action_dim` elements, with `hidden` features after the transformer and random
    /// weights.
    pub fn new(
        init: &Init,
        size: &TransformerConfig,
        grid: PatchGrid,
        pool: Pool,
        action_dim: usize,
        hidden: usize,
    ) -> Self {
        let [pos_embedding, pos_embedding_goal] = positions(init, grid);
        Self {
            pos_embedding,
            pos_embedding_goal,
            transformer: size.init(&init.of("transformer"), grid, pool),
            q_head: CriticHead {
                _0: Linear::new(&init.of("0"), grid.dim + action_dim, hidden),
                _2: Linear::new(&init.of("2"), hidden, hidden),
                _4: Linear::new(&init.of("4"), hidden, 1),
            },
            emb_dropout: size.emb_dropout,
        }
    }

    /// Computes the value of the actions at every frame.
    ///
    /// # Shapes
    /// `frames` is `[rows, frames * patches, dim]`, `actions` is `[rows, frames, action_dim]`, `goal` is
    /// `[rows, patches, dim]`; returns `[rows, frames, 1]`.
    pub fn forward(
        &self,
        frames: &Tensor<3>,
        actions: Tensor<3>,
        goal: &Tensor<3>,
        rng: &mut DropoutRng<'_>,
    ) -> Tensor<3> {
        let (frames, goal) = add_positions([&self.pos_embedding, &self.pos_embedding_goal], frames, goal);
        let frames = rng.dropout(frames, self.emb_dropout);
        let features = self.transformer.forward(frames, &goal, rng);
        let head = &self.q_head;
        let hidden = Activation::Relu.forward(head._0.forward(Tensor::cat(vec![features, actions], 2)));
        head._4.forward(Activation::Relu.forward(head._2.forward(hidden)))
    }
}

/// The standard deviation of initial position embeddings. The reference implementation uses 1, the standard
/// deviation of DINOv2's features. The features of an encoder with random weights are a tenth as large, and position
/// embeddings with a standard deviation of 1 would dominate them.
const POSITION_STD: f32 = 0.02;

/// Draws the position embeddings of frames and goal.
fn positions(init: &Init, PatchGrid { frames, patches, dim }: PatchGrid) -> [Param<Tensor<3>>; 2] {
    [
        init.normal("pos_embedding", [1, frames * patches, dim], POSITION_STD),
        init.normal("pos_embedding_goal", [1, patches, dim], POSITION_STD),
    ]
}

/// Adds the position embeddings to frames and goal.
fn add_positions(positions: [&Param<Tensor<3>>; 2], frames: &Tensor<3>, goal: &Tensor<3>) -> (Tensor<3>, Tensor<3>) {
    (add_position(positions[0], frames), add_position(positions[1], goal))
}

/// Adds the position embeddings to the patches of frames or of goals.
fn add_position(position: &Param<Tensor<3>>, x: &Tensor<3>) -> Tensor<3> {
    let [_, tokens, dim] = x.dims();
    x.clone() + position.val().slice([0..1, 0..tokens, 0..dim])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::parameters;
    use burn::tensor::Device;
    use swm_core::Key;

    #[test]
    fn a_metric_is_symmetric_and_zero_up_to_the_least_distance_at_the_goal() {
        let size = TransformerConfig { depth: 3, heads: 2, dim_head: 4, mlp: 16, dropout: 0.0, emb_dropout: 0.0 };
        let (grid, device) = (PatchGrid { frames: 2, patches: 3, dim: 8 }, Device::flex());
        let head = ValueHead::new(&Init::new(Key::new(0), &device), &size, grid, 5);
        let names: Vec<String> = parameters::shapes(&head).into_keys().collect();
        assert!(names.contains(&"embed_proj.weight".to_owned()) && !names.iter().any(|name| name.contains("norm_c")));
        let images = |seed: f32| {
            let values: Vec<f32> = (0..96).map(|i| (seed + i as f32 * i as f32 * 0.37).sin()).collect();
            Tensor::<1>::from_floats(values.as_slice(), &device).reshape([4, 3, 8])
        };
        let value = |frames: &Tensor<3>, goal: &Tensor<3>| -> Vec<f32> {
            head.forward(frames, goal, &mut DropoutRng::disabled()).into_data().iter::<f32>().collect()
        };
        let (state, goal, between) = (images(1.0), images(2.0), images(3.0));
        assert!(value(&state, &state).iter().all(|value| (value + 1e-3).abs() < 1e-6));
        assert_eq!(value(&state, &goal), value(&goal, &state));
        let detour = value(&state, &between).into_iter().zip(value(&between, &goal)).map(|(a, b)| a + b);
        assert!(
            value(&state, &goal)
                .into_iter()
                .zip(detour)
                .all(|(direct, detour)| direct < -1e-3 && direct >= detour - 1e-5)
        );
        // Each frame has a value, and a later frame does not change an earlier one's.
        let two = head.forward(&Tensor::cat(vec![state.clone(), between], 1), &goal, &mut DropoutRng::disabled());
        assert_eq!(two.dims(), [4, 2, 1]);
        let first: Vec<f32> = two.slice([0..4, 0..1, 0..1]).into_data().iter::<f32>().collect();
        assert!(first.iter().zip(value(&state, &goal)).all(|(a, b)| (a - b).abs() < 1e-5));
    }
}
