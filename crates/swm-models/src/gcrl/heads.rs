//! The heads of goal-conditioned models, whose inputs are the patches of frames and of a goal: policies and values
//! ([`Head`]), and critics ([`Critic`]).

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
    let with_position = |position: &Param<Tensor<3>>, x: &Tensor<3>| {
        let [_, tokens, dim] = x.dims();
        x.clone() + position.val().slice([0..1, 0..tokens, 0..dim])
    };
    (with_position(positions[0], frames), with_position(positions[1], goal))
}
