//! [`Backbone`]: an image encoder of one of five kinds.

use super::keypoints::KeypointKernels;
use super::{
    BatchStatistics, Conv, ConvConfig, Dino, DinoConfig, Init, Keypoints, KeypointsConfig, Named, PatchCnn,
    PatchCnnConfig, Vit, VitConfig, keypoints,
};
use crate::train::{check_sizes, limits};
use burn::module::Module;
use burn::tensor::Tensor;
use serde::{Deserialize, Serialize};
use swm_core::{Error, Result};

/// The kind and the size of an image encoder.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum BackboneConfig {
    /// A vision transformer.
    Vit(VitConfig),
    /// DINOv2.
    Dinov2(DinoConfig),
    /// Convolutions over disjoint patches: small and fast.
    #[serde(rename = "pyramid")]
    PatchCnn(PatchCnnConfig),
    /// Overlapping convolutions with batch normalisation.
    Conv(ConvConfig),
    /// Positions of the responses of fixed random filters, moments of colours, and trained linear layers.
    Keypoints(KeypointsConfig),
}

/// An image encoder.
#[derive(Module, Debug)]
#[allow(
    clippy::large_enum_variant,
    reason = "a model has one encoder, so the size of the smaller variants does not matter"
)]
pub enum Backbone {
    /// A vision transformer.
    Vit(Vit),
    /// DINOv2.
    Dinov2(Dino),
    /// Convolutions over disjoint patches.
    PatchCnn(PatchCnn),
    /// Overlapping convolutions with batch normalisation.
    Conv(Conv),
    /// Positions of the responses of fixed random filters, moments of colours, and trained linear layers.
    Keypoints(Keypoints),
}

impl BackboneConfig {
    /// The side of the patches that an image is cut into, in pixels.
    pub fn patch(&self) -> usize {
        match self {
            Self::Vit(vit) => vit.patch,
            Self::Dinov2(dino) => dino.patch,
            Self::PatchCnn(cnn) => cnn.stages.first().map_or(0, |stage| stage.patch),
            Self::Conv(_) | Self::Keypoints(_) => 1,
        }
    }

    /// The number of features of an image.
    pub fn dim(&self) -> usize {
        match self {
            Self::Vit(vit) => vit.dim,
            Self::Dinov2(dino) => dino.dim,
            Self::PatchCnn(cnn) => cnn.dim,
            Self::Conv(conv) => conv.dim,
            Self::Keypoints(keypoints) => keypoints.dim,
        }
    }

    /// The number of features of the part that is not trained; 0 if there is no such part.
    pub fn fixed_features(&self) -> usize {
        match self {
            Self::Keypoints(keypoints) => keypoints.features(),
            _ => 0,
        }
    }

    /// The colours of an encoder that are to be found in the training data before a model is made; `None` if there are none to find.
    pub fn colours_to_find(&mut self) -> Option<(usize, &mut Vec<[f32; 3]>)> {
        match self {
            Self::Keypoints(keypoints) if keypoints.colours.is_empty() && keypoints.find_colours > 0 => {
                Some((keypoints.find_colours, &mut keypoints.colours))
            }
            _ => None,
        }
    }

    /// The number of features of each of the [`Backbone::patches`].
    pub fn patch_dim(&self) -> usize {
        match self {
            Self::Conv(conv) => conv.last(),
            _ => self.dim(),
        }
    }

    /// The number of [`Backbone::patches`] of an image with a side of `image` pixels.
    pub fn patches(&self, image: usize) -> usize {
        match self {
            Self::Vit(_) | Self::Dinov2(_) => (image / self.patch().max(1)).pow(2),
            Self::PatchCnn(_) | Self::Keypoints(_) => 1,
            Self::Conv(conv) => conv.map(image).pow(2),
        }
    }

    /// Checks that the sizes fit each other and images with a side of `image` pixels. `at` is the dotted path
    /// of the settings, for errors.
    ///
    /// # Errors
    /// When a size does not fit; the error names the first such size.
    pub fn check(&self, at: &str, image: usize) -> Result<()> {
        let invalid = |what: &str, problem: String, fix: &str| Err(Error::config(format!("{at}.{what}"), problem, fix));
        let transformer = |name: &str, sizes: [(&str, usize); 5], dim: usize, heads: usize| {
            for (what, size) in sizes {
                let most = if what == "depth" { limits::LAYERS } else { limits::FEATURES };
                check_sizes(&[(&format!("{at}.{name}.{what}"), size, 1, most)])?;
            }
            if !dim.is_multiple_of(heads) {
                let problem = format!("{dim} features do not split into {heads} heads");
                return invalid(&format!("{name}.heads"), problem, "choose a divisor of `dim`");
            }
            Ok(())
        };
        let patches = match self {
            Self::Vit(VitConfig { patch, dim, depth, heads, mlp }) => {
                let sizes = [("patch", *patch), ("dim", *dim), ("depth", *depth), ("heads", *heads), ("mlp", *mlp)];
                transformer("vit", sizes, *dim, *heads)?;
                vec![*patch]
            }
            Self::Dinov2(DinoConfig { patch, dim, depth, heads, mlp, grid, registers }) => {
                let sizes = [("patch", *patch), ("dim", *dim), ("depth", *depth), ("heads", *heads), ("mlp", *mlp)];
                transformer("dinov2", sizes, *dim, *heads)?;
                check_sizes(&[
                    (&format!("{at}.dinov2.grid"), *grid, 1, limits::SIDE),
                    (&format!("{at}.dinov2.registers"), *registers, 0, limits::LAYERS),
                ])?;
                vec![*patch]
            }
            Self::PatchCnn(cnn) => {
                if cnn.stages.is_empty() {
                    return invalid("pyramid.stages", "the list is empty".to_owned(), "give at least one stage");
                }
                let channels = cnn.stages.iter().map(|stage| ("stages.channels", stage.channels));
                for (what, size) in [("hidden", cnn.hidden), ("dim", cnn.dim)].into_iter().chain(channels) {
                    check_sizes(&[(&format!("{at}.pyramid.{what}"), size, 1, limits::FEATURES)])?;
                }
                cnn.stages.iter().map(|stage| stage.patch).collect()
            }
            Self::Conv(conv) => {
                conv.check(&format!("{at}.conv"), image)?;
                vec![]
            }
            Self::Keypoints(keypoints) => {
                keypoints.check(&format!("{at}.keypoints"), image)?;
                vec![]
            }
        };
        check_sizes(&[("model.image", image, 1, limits::SIDE)])?;
        let mut side = image;
        for patch in patches {
            if patch == 0 || !side.is_multiple_of(patch) || side == 0 {
                let problem = format!("a side of {side} pixels does not split into patches of {patch}");
                return Err(Error::config(at, problem, "choose patches whose product divides the image's side"));
            }
            side /= patch;
        }
        Ok(())
    }

    /// Creates the encoder for images with a side of `image` pixels.
    pub fn init(&self, init: &Init, image: usize) -> Backbone {
        match self {
            Self::Vit(vit) => Backbone::Vit(vit.init(init, image)),
            Self::Dinov2(dino) => Backbone::Dinov2(dino.init(init)),
            Self::PatchCnn(cnn) => Backbone::PatchCnn(cnn.init(init, image)),
            Self::Conv(conv) => Backbone::Conv(conv.init(init, image)),
            Self::Keypoints(keypoints) => Backbone::Keypoints(keypoints.init(init)),
        }
    }
}

impl Backbone {
    /// Computes the features of images: the class token of a transformer.
    ///
    /// # Shapes
    /// Maps `[frames, patches, 3 * patch * patch]` to `[frames, dim]`.
    pub fn forward(&self, patches: Tensor<3>) -> Tensor<2> {
        match self {
            Self::Vit(vit) => vit.forward(patches),
            Self::Dinov2(dino) => dino.forward(patches),
            Self::PatchCnn(cnn) => cnn.forward(patches),
            Self::Conv(conv) => conv.forward(patches),
            Self::Keypoints(keypoints) => keypoints.forward(patches),
        }
    }

    /// Computes the features of images in training. Also returns the statistics of the batch for
    /// [`Backbone::track`], one for each batch normalisation.
    ///
    /// # Shapes
    /// As [`Backbone::forward`].
    pub fn forward_train(&self, patches: Tensor<3>) -> (Tensor<2>, Vec<BatchStatistics>) {
        match self {
            Self::Conv(conv) => conv.forward_train(patches),
            Self::Keypoints(keypoints) => {
                let (features, statistics) = keypoints.forward_train(patches);
                (features, vec![statistics])
            }
            _ => (self.forward(patches), vec![]),
        }
    }

    /// Computes the features of every patch; a [`PatchCnn`] and [`Keypoints`] return the features of the
    /// image as one patch, and a [`Conv`] returns the cells of its last feature map.
    ///
    /// # Shapes
    /// Maps `[frames, patches, 3 * patch * patch]` to `[frames, patches, patch_dim]`.
    pub fn patches(&self, patches: Tensor<3>) -> Tensor<3> {
        match self {
            Self::Vit(vit) => {
                let [frames, count, _] = patches.dims();
                let tokens = vit.tokens(patches);
                let [_, all, dim] = tokens.dims();
                tokens.slice([0..frames, all - count..all, 0..dim])
            }
            Self::Dinov2(dino) => dino.patches(patches),
            Self::PatchCnn(cnn) => cnn.forward(patches).unsqueeze_dim(1),
            Self::Keypoints(keypoints) => keypoints.forward(patches).unsqueeze_dim(1),
            Self::Conv(conv) => conv.cells(patches),
        }
    }

    /// Computes the features of every patch in training, and the statistics of the batch for [`Backbone::track`].
    ///
    /// # Shapes
    /// As [`Backbone::patches`].
    pub fn patches_train(&self, patches: Tensor<3>) -> (Tensor<3>, Vec<BatchStatistics>) {
        match self {
            Self::Conv(conv) => conv.cells_train(patches),
            Self::Keypoints(_) => {
                let (features, statistics) = self.forward_train(patches);
                (features.unsqueeze_dim(1), statistics)
            }
            _ => (self.patches(patches), vec![]),
        }
    }

    /// Inserts the batch statistics of a training pass into `buffers` under `name`, for [`Backbone::track`].
    pub fn store(&self, statistics: Vec<BatchStatistics>, name: &str, buffers: &mut Named<Tensor<1>>) {
        match self {
            Self::Keypoints(_) => keypoints::store(statistics, name, buffers),
            _ => super::conv::store(statistics, name, buffers),
        }
    }

    /// Whether training normalises with the statistics of a batch.
    pub fn has_batch_statistics(&self) -> bool {
        matches!(self, Self::Conv(_) | Self::Keypoints(_))
    }

    /// The part of the encoder that is not trained, if there is one, for images with a side of `image` pixels: its features,
    /// `[frames, 1, features]`, may be given in place of images.
    pub fn fixed_part(&self, image: usize) -> Option<KeypointKernels> {
        match self {
            Self::Keypoints(keypoints) => Some(keypoints.kernels(image)),
            _ => None,
        }
    }

    /// Updates the running statistics with batch statistics that [`Backbone::store`] inserted under `name`.
    pub fn track(&mut self, name: &str, buffers: &mut Named<Tensor<1>>) {
        match self {
            Self::Conv(conv) => conv.track(name, buffers),
            Self::Keypoints(keypoints) => keypoints.track(name, buffers),
            _ => {}
        }
    }
}
