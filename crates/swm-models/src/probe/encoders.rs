//! The encoders that can be probed. Those of goal-conditioned models are [`crate::gcrl::Actor`]s.

use super::ImageEncoder;
use crate::checkpoint::Checkpoint;
use crate::dino_wm::DinoWm;
use crate::lewm::{self, Lewm, LewmConfig};
use crate::nn::parameters::IntoF32;
use crate::pixels::{self, ImageNormalization};
use crate::pldm::Pldm;
use burn::tensor::Device;
use swm_core::Result;

fn latents(model: &Lewm, config: &LewmConfig, rgb: &[u8]) -> Result<Vec<f32>> {
    Ok(model.encode(lewm::pixels::patches(config, rgb, &Device::flex())?).into_data().into_f32_vec())
}

impl ImageEncoder for Checkpoint<Lewm> {
    fn image_size(&self) -> usize {
        self.config.model.image
    }

    fn latent_dim(&self) -> usize {
        self.config.model.latent
    }

    fn encode(&self, rgb: &[u8]) -> Result<Vec<f32>> {
        latents(&self.model, &self.config.model, rgb)
    }
}

impl ImageEncoder for Checkpoint<Pldm> {
    fn image_size(&self) -> usize {
        self.config.model.image
    }

    fn latent_dim(&self) -> usize {
        self.config.model.latent
    }

    fn encode(&self, rgb: &[u8]) -> Result<Vec<f32>> {
        latents(&self.model.model, &self.config.model, rgb)
    }
}

impl ImageEncoder for Checkpoint<DinoWm> {
    fn image_size(&self) -> usize {
        self.config.model.image
    }

    fn latent_dim(&self) -> usize {
        self.config.model.patches() * self.config.model.encoder.dim()
    }

    fn encode(&self, rgb: &[u8]) -> Result<Vec<f32>> {
        let config = &self.config.model;
        let pixels = ImageNormalization { side: config.image, mean: config.pixel_mean, std: config.pixel_std };
        let patches = pixels::patches(&pixels, config.encoder.patch(), rgb, &Device::flex())?;
        Ok(self.model.backbone.patches(patches).into_data().into_f32_vec())
    }
}
