//! [`LewmPredictor`]: predictions of a LeWM for comparison with recorded trajectories.

use super::host_encoder::HostEncoder;
use super::{Lewm, LewmConfig, Rollout, pixels};
use crate::device::is_cpu;
use crate::nn::parameters::{IntoF32, host};
use rayon::prelude::*;
use swm_core::columns::PIXELS;
use swm_core::{Batch, Error, Predictor, Result};
use swm_plan::ActionScale;

/// A predictor of latents that encodes rows and predicts trajectories one at a time, so that a latent depends on its
/// own row or trajectory only.
pub struct LewmPredictor {
    model: Lewm,
    /// The encoder laid out for the CPU kernels; `None` if there are no kernels for it, or the model is on
    /// another device.
    encoder: Option<HostEncoder>,
    config: LewmConfig,
    rollout: Rollout,
    scale: ActionScale,
    frameskip: usize,
}

impl LewmPredictor {
    /// Creates the predictor of a trained model whose model step is `frameskip` environment steps.
    pub fn new(model: &Lewm, config: &LewmConfig, scale: ActionScale, frameskip: usize) -> Self {
        let encoder = is_cpu(&model.device()).then(|| HostEncoder::new(model, config)).flatten();
        Self { rollout: Rollout::new(model), model: model.clone(), encoder, config: config.clone(), scale, frameskip }
    }
}

impl Predictor for LewmPredictor {
    fn frameskip(&self) -> usize {
        self.frameskip
    }

    fn columns(&self) -> Vec<String> {
        vec![PIXELS.to_owned()]
    }

    fn latent_dim(&self) -> usize {
        self.config.latent
    }

    fn encode(&mut self, rows: &Batch, latents: &mut [f32]) -> Result<()> {
        let (config, model, encoder) = (&self.config, &self.model, &self.encoder);
        let device = model.device();
        pixels::check(config, rows.schema(), PIXELS)?;
        let bytes = config.image * config.image * 3;
        let work = latents.par_chunks_exact_mut(config.latent).zip(rows.get::<u8>(PIXELS)?.par_chunks_exact(bytes));
        work.try_for_each(|(latent, rgb)| {
            let patches = pixels::patches(config, rgb, &device)?;
            latent.copy_from_slice(&match encoder {
                Some(encoder) => encoder.encode(&patches.into_data().into_f32_vec()),
                None => host(model.encode(patches)),
            });
            Ok(())
        })
    }

    fn rollout(&mut self, start: &[f32], actions: &[f32], horizon: usize, latents: &mut [f32]) -> Result<()> {
        let (latent, scale) = (self.config.latent, &self.scale);
        let action_dim = self.frameskip() * scale.dim();
        let n = start.len() / latent;
        if actions.len() != n * horizon * action_dim {
            return Err(Error::mismatch(
                "the actions of predicted trajectories",
                format!("{} elements", actions.len()),
                format!("{n} trajectories x {horizon} model steps x {action_dim}, as the model was trained"),
            ));
        }
        let work = latents.par_chunks_exact_mut(horizon * latent).zip(start.par_chunks_exact(latent));
        work.zip(actions.par_chunks_exact(horizon * action_dim)).for_each(|((latents, start), actions)| {
            let mut scaled = vec![0.0; actions.len()];
            for (to, from) in scaled.chunks_exact_mut(scale.dim()).zip(actions.chunks_exact(scale.dim())) {
                scale.to_model(from, to);
            }
            let predicted = self.rollout.run(start, &scaled, 1, horizon);
            for (to, from) in latents.chunks_exact_mut(latent).zip(&predicted[1..]) {
                to.copy_from_slice(from);
            }
        });
        Ok(())
    }
}
