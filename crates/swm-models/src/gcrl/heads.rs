//! The heads of goal-conditioned models, on the patches that an encoder made of frames and goal: what to do
//! ([`Head`]), what a state is worth ([`Head`] of one number), what an action is worth ([`Critic`]).

use super::transformer::{PatchGrid, Pool, Transformer, TransformerConfig};
use crate::nn::{Activation, DropoutRng, Init, Linear};
use burn::module::{Module, Param};
use burn::tensor::Tensor;

/// Numbers for every frame, given the goal: a policy's mean action, or a value.
#[derive(Module, Debug)]
pub struct Head {
    /// Where a patch is, and in which frame, `[1, frames * patches, dim]`.
    pub pos_embedding: Param<Tensor<3>>,
    /// Where a patch of the goal is, `[1, patches, dim]`.
    pub pos_embedding_goal: Param<Tensor<3>>,
    /// Looks at frames and goal.
    pub transformer: Transformer,
    /// To the numbers.
    pub out_proj: Linear,
    emb_dropout: f32,
}

/// The value of an action, given frame and goal.
#[derive(Module, Debug)]
pub struct Critic {
    /// Where a patch is, and in which frame, `[1, frames * patches, dim]`.
    pub pos_embedding: Param<Tensor<3>>,
    /// Where a patch of the goal is, `[1, patches, dim]`.
    pub pos_embedding_goal: Param<Tensor<3>>,
    /// Looks at frames and goal.
    pub transformer: Transformer,
    /// From what it saw, and the action, to the value.
    pub q_head: CriticHead,
    emb_dropout: f32,
}

/// Two hidden layers with ReLU. A field `_2` is number 2 of a sequence.
#[derive(Module, Debug)]
pub struct CriticHead {
    /// Into hidden features.
    pub _0: Linear,
    /// From hidden features to hidden features.
    pub _2: Linear,
    /// To the value.
    pub _4: Linear,
}

impl Head {
    /// A head of `outputs` numbers.
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

    /// # Shapes
    /// Frames `[rows, frames * patches, dim]`, at most as many as the head was made for, and a goal
    /// `[rows, patches, dim]` to `[rows, frames, outputs]`.
    pub fn forward(&self, frames: &Tensor<3>, goal: &Tensor<3>, noise: &mut DropoutRng<'_>) -> Tensor<3> {
        let (frames, goal) = add_positions([&self.pos_embedding, &self.pos_embedding_goal], frames, goal);
        let frames = noise.dropout(frames, self.emb_dropout);
        self.out_proj.forward(self.transformer.forward(frames, &goal, noise))
    }
}

impl Critic {
    /// A critic of `actions` numbers an action, with `hidden` features behind the transformer.
    pub fn new(
        init: &Init,
        size: &TransformerConfig,
        grid: PatchGrid,
        pool: Pool,
        actions: usize,
        hidden: usize,
    ) -> Self {
        let [pos_embedding, pos_embedding_goal] = positions(init, grid);
        Self {
            pos_embedding,
            pos_embedding_goal,
            transformer: size.init(&init.of("transformer"), grid, pool),
            q_head: CriticHead {
                _0: Linear::new(&init.of("0"), grid.dim + actions, hidden),
                _2: Linear::new(&init.of("2"), hidden, hidden),
                _4: Linear::new(&init.of("4"), hidden, 1),
            },
            emb_dropout: size.emb_dropout,
        }
    }

    /// # Shapes
    /// As [`Head::forward`], with actions `[rows, frames, actions]`, to `[rows, frames, 1]`.
    pub fn forward(
        &self,
        frames: &Tensor<3>,
        actions: Tensor<3>,
        goal: &Tensor<3>,
        noise: &mut DropoutRng<'_>,
    ) -> Tensor<3> {
        let (frames, goal) = add_positions([&self.pos_embedding, &self.pos_embedding_goal], frames, goal);
        let frames = noise.dropout(frames, self.emb_dropout);
        let seen = self.transformer.forward(frames, &goal, noise);
        let head = &self.q_head;
        let hidden = Activation::Relu.forward(head._0.forward(Tensor::cat(vec![seen, actions], 2)));
        head._4.forward(Activation::Relu.forward(head._2.forward(hidden)))
    }
}

/// The spread of initial positions. The reference draws them with a spread of 1, that of DINOv2's features; an encoder that is
/// trained along begins with features of a tenth of that, which such positions would drown.
const POSITION_STD: f32 = 0.02;

/// Positions of frames and goal.
fn positions(init: &Init, PatchGrid { frames, patches, dim }: PatchGrid) -> [Param<Tensor<3>>; 2] {
    [
        init.normal("pos_embedding", [1, frames * patches, dim], POSITION_STD),
        init.normal("pos_embedding_goal", [1, patches, dim], POSITION_STD),
    ]
}

/// Adds the position embeddings to frames and goal.
fn add_positions(positions: [&Param<Tensor<3>>; 2], frames: &Tensor<3>, goal: &Tensor<3>) -> (Tensor<3>, Tensor<3>) {
    let placed = |position: &Param<Tensor<3>>, x: &Tensor<3>| {
        let [_, tokens, dim] = x.dims();
        x.clone() + position.val().slice([0..1, 0..tokens, 0..dim])
    };
    (placed(positions[0], frames), placed(positions[1], goal))
}
