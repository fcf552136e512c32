//! [`Lewm`]: encoder, action encoder, predictor and projectors.

use super::config::LewmConfig;
pub use crate::nn::Backbone as Encoder;
use crate::nn::{DropoutRng, Embedder, Init, Mlp, Predictor, Projector};
use burn::module::Module;
use burn::tensor::{Device, Tensor};

/// The networks of a LeWM, which encode images to latents and predict the next latents from latents and actions.
#[derive(Module, Debug)]
pub struct Lewm {
    /// Maps images to features.
    pub encoder: Encoder,
    /// Maps features to latents.
    pub projector: Projector,
    /// Maps actions to conditions.
    pub action_encoder: Embedder,
    /// Maps latents and conditions to features of the next latents.
    pub predictor: Predictor,
    /// Maps features of the predictor to latents.
    pub pred_proj: Projector,
    /// Maps latents to the features of the encoder's fixed filters; part of the loss only.
    pub decoder: Option<Decoder>,
}

/// A decoder of latents.
#[derive(Module, Debug)]
pub struct Decoder {
    /// The network.
    pub net: Mlp,
    #[module(skip)]
    weight: f32,
}

impl Decoder {
    /// The weight of the mean squared error in the loss.
    pub fn weight(&self) -> f64 {
        f64::from(self.weight)
    }
}

impl Lewm {
    /// Creates a model with random weights for actions of `action_dim` elements per model step.
    pub fn init(config: &LewmConfig, action_dim: usize, init: &Init) -> Self {
        let features = config.encoder.dim();
        let project = |name| Projector::new(&init.of(name), features, config.projector, config.latent);
        let smoothed = if config.smoothed == 0 { action_dim } else { config.smoothed };
        Self {
            encoder: config.encoder.init(&init.of("encoder"), config.image),
            projector: project("projector"),
            action_encoder: Embedder::new(&init.of("action_encoder"), action_dim, smoothed, config.latent),
            predictor: config.predictor.init(&init.of("predictor"), config.latent),
            pred_proj: Projector::new(&init.of("pred_proj"), config.latent, config.projector, config.latent),
            decoder: config.decoder.as_ref().map(|decoder| Decoder {
                net: Mlp::new(&init.of("decoder"), config.latent, decoder.hidden, config.encoder.fixed_features()),
                weight: decoder.weight,
            }),
        }
    }

    /// Returns the device of the weights.
    pub fn device(&self) -> Device {
        self.predictor.pos_embedding.val().device()
    }

    /// Returns the latent dimension.
    pub fn latent(&self) -> usize {
        let [_, _, latent] = self.predictor.pos_embedding.dims();
        latent
    }

    /// Encodes images.
    ///
    /// # Shapes
    /// Maps `[frames, patches, 3 * patch * patch]` to `[frames, latent]`.
    pub fn encode(&self, patches: Tensor<3>) -> Tensor<2> {
        self.projector.forward(self.encoder.forward(patches))
    }

    /// Embeds actions as conditions of the predictor.
    ///
    /// # Shapes
    /// Maps `[windows, steps, action_dim]` to `[windows, steps, latent]`.
    pub fn embed_actions(&self, actions: Tensor<3>) -> Tensor<3> {
        let [windows, steps, elements] = actions.dims();
        let embedded = self.action_encoder.forward(actions.reshape([windows * steps, elements]));
        let [_, latent] = embedded.dims();
        embedded.reshape([windows, steps, latent])
    }

    /// Predicts the latent after each latent of a window.
    ///
    /// # Shapes
    /// `latents` and `conditions` are `[windows, steps, latent]`; returns the same shape.
    pub fn predict(&self, latents: Tensor<3>, conditions: Tensor<3>) -> Tensor<3> {
        let features = self.predictor.forward(latents, conditions, &mut DropoutRng::disabled());
        let [windows, steps, latent] = features.dims();
        self.pred_proj.forward(features.reshape([windows * steps, latent])).reshape([windows, steps, latent])
    }

    /// Rolls the model out: returns the given latents, then one predicted latent after each further action.
    ///
    /// # Shapes
    /// `latents` is `[windows, given, latent]`, `actions` is `[windows, steps, action_dim]` with `steps >= given`;
    /// returns `[windows, steps + 1, latent]`.
    pub fn rollout(&self, latents: Tensor<3>, actions: Tensor<3>) -> Tensor<3> {
        let [windows, given, latent] = latents.dims();
        let [_, steps, _] = actions.dims();
        let history = self.predictor.config().history;
        let conditions = self.embed_actions(actions);
        let mut all = latents;
        for end in given..=steps {
            let window = [0..windows, end.saturating_sub(history)..end, 0..latent];
            let next = self.predict(all.clone().slice(window.clone()), conditions.clone().slice(window));
            let [_, count, _] = next.dims();
            all = Tensor::cat(vec![all, next.slice([0..windows, count - 1..count, 0..latent])], 1);
        }
        all
    }
}
