//! Colours that an encoder locates, found in the frames of the training data.

use super::config::TrainConfig;
use super::split::episodes;
use super::trainable::Trainable;
use crate::nn::BackboneConfig;
use crate::pixels::ImageNormalization;
use swm_core::{Error, Result};
use swm_data::{Part, Reader, frequent_colours};

/// The configuration with the colours of the training frames, if its encoder asks for some that are to be found. The same dataset
/// gives the same colours, whatever the seed.
///
/// # Errors
/// When the configuration contradicts itself, or the frames have fewer colours, or cannot be read.
pub fn with_colours<M: Trainable>(config: &TrainConfig<M>, reader: &dyn Reader) -> Result<TrainConfig<M>> {
    config.check()?;
    let mut config = config.clone();
    if let Some((encoder, images)) = M::encoder_config(&mut config.model) {
        find(encoder, &images, reader, config.data.hold_out)?;
    }
    Ok(config)
}

/// Whether the encoder's colours are still to be found.
pub(crate) fn are_missing<M: Trainable>(config: &TrainConfig<M>) -> bool {
    let mut model = config.model.clone();
    M::encoder_config(&mut model).is_some_and(|(encoder, _)| encoder.colours_to_find().is_some())
}

/// Finds the colours of an encoder that asks for them, in the training episodes of a dataset.
///
/// # Errors
/// As [`with_colours`].
pub(crate) fn find(
    encoder: &mut BackboneConfig,
    images: &ImageNormalization,
    reader: &dyn Reader,
    hold_out: bool,
) -> Result<()> {
    let Some((count, colours)) = encoder.colours_to_find() else { return Ok(()) };
    let episodes = episodes(hold_out, Part::Train, reader)?;
    let found = frequent_colours(reader, count, episodes.as_deref())?;
    if found.len() < count {
        let problem = format!("the frames of the training data have {} of {count} colours", found.len());
        let fix = match found.len() {
            0 | 1 => "choose another encoder or preset".to_owned(),
            fewer => format!("find {fewer} or fewer"),
        };
        return Err(Error::config("model.encoder.keypoints.find_colours", problem, fix));
    }
    let normalised = |colour: [f32; 3]| [0, 1, 2].map(|i: usize| (colour[i] - images.mean[i]) / images.std[i]);
    *colours = found.into_iter().map(normalised).collect();
    Ok(())
}
