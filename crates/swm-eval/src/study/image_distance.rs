//! How much a condition changes what a model sees: the image distance of its first frames.

use super::cell::{Cell, Study};
use super::folder::{IMAGE_DISTANCES, MAX_BYTES, StudyFolder, json};
use super::rows::key;
use crate::request::{Condition, EvalRequest, StartsRequest};
use crate::runner::{Resolver, RunOptions};
use crate::world::World;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use swm_core::columns::PIXELS;
use swm_core::run::Control;
use swm_core::{Error, Result, VariationRequest, files};

/// The largest number of starts whose frames are compared.
const STARTS: usize = 50;
/// Environments whose frames are rendered at a time.
const ENVS: usize = 8;

/// The image distance of a condition.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct ImageDistance {
    /// The mean absolute difference between the values of the first frames, from 0 to 255.
    pub mean: f64,
    /// The number of starts.
    pub starts: usize,
}

/// The image distances of the cells that have one, by their ids.
pub(super) type ImageDistances = BTreeMap<String, ImageDistance>;

impl Study {
    /// Measures the image distances of all shifted cells that have an unshifted one and frames, and stores them. Those that
    /// are stored already are kept.
    ///
    /// # Errors
    /// When an environment or a dataset does not exist or fails, or writing fails.
    pub(super) fn measure_distances(
        &self,
        folder: &StudyFolder,
        resolver: &dyn Resolver,
        options: &RunOptions,
        control: &mut Control<'_>,
    ) -> Result<()> {
        let known = folder.image_distances()?;
        // Cells of several policies have the same frames.
        let (mut frames, mut seen, mut found) = (Frames::default(), BTreeMap::new(), ImageDistances::new());
        for (id, reference, cell) in self.compared()? {
            control.check()?;
            if let Some(distance) = known.get(&id) {
                found.insert(id, *distance);
                continue;
            }
            let [from, to] = [&reference.request, &cell.request].map(scene);
            let pair = format!("{}\n{}", text(&from)?, text(&to)?);
            let distance = match seen.get(&pair) {
                Some(distance) => *distance,
                None => {
                    let frames = frames.of(&from, resolver, options)?;
                    let mean = difference(frames, &first_frames(&to, resolver, options)?);
                    ImageDistance { mean, starts: frames.len() }
                }
            };
            seen.insert(pair, distance);
            found.insert(id, distance);
        }
        folder.store_image_distances(&found, found == known)
    }

    /// The cells that have an image distance: the id of each, the unshifted cell that it is compared with, and itself.
    fn compared(&self) -> Result<Vec<(String, &Cell, &Cell)>> {
        let (variables, unshifted) = (self.common_variables(), self.unshifted());
        let references = self.cells.iter().filter(|cell| cell.condition() == unshifted);
        let references: BTreeMap<String, &Cell> = references.map(|cell| (key(cell, &variables), cell)).collect();
        let shifted = self.cells.iter().filter(|cell| cell.condition() != unshifted && cell.request.image.is_some());
        let pairs = shifted.filter_map(|cell| Some((*references.get(&key(cell, &variables))?, cell)));
        pairs.map(|(reference, cell)| Ok((cell.id()?, reference, cell))).collect()
    }

    /// The cells whose datasets and weights a run still reads: those without all results, and those whose first frames are still to
    /// be compared.
    ///
    /// # Errors
    /// When the folder is damaged.
    pub fn unfinished(&self, folder: &StudyFolder) -> Result<Vec<&Cell>> {
        let mut unfinished = vec![];
        for cell in &self.cells {
            if folder.results(cell)?.is_none_or(|results| results.episodes() < cell.request.episodes) {
                unfinished.push(cell);
            }
        }
        let known = folder.image_distances()?;
        let compared = self.compared()?.into_iter().filter(|(id, ..)| !known.contains_key(id));
        unfinished.extend(compared.flat_map(|(_, reference, cell)| [reference, cell]));
        Ok(unfinished)
    }
}

impl StudyFolder {
    /// Reads the image distances; none if they are not measured yet.
    ///
    /// # Errors
    /// When the file is damaged.
    pub(super) fn image_distances(&self) -> Result<ImageDistances> {
        let path = self.root.join(IMAGE_DISTANCES);
        if !path.exists() {
            return Ok(ImageDistances::new());
        }
        let damaged = |problem: String| Error::corrupt(&path, problem, "remove the file and run the study again");
        let found: ImageDistances = serde_json::from_slice(&files::read(&path, MAX_BYTES)?)
            .map_err(|error| damaged(format!("has no image distances ({error})")))?;
        match found.iter().find(|(_, distance)| !(0.0..=255.0).contains(&distance.mean)) {
            Some((id, distance)) => Err(damaged(format!("the distance of {id} is {}, not 0 to 255", distance.mean))),
            None => Ok(found),
        }
    }

    fn store_image_distances(&self, found: &ImageDistances, is_stored: bool) -> Result<()> {
        if is_stored { Ok(()) } else { files::write(&self.root.join(IMAGE_DISTANCES), &json(found)?) }
    }
}

/// The part of a request that determines the first frames.
fn scene(request: &EvalRequest) -> EvalRequest {
    let conditions = request.conditions.iter().map(|condition| Condition { name: String::new(), ..condition.clone() });
    EvalRequest {
        policies: vec![],
        conditions: conditions.collect(),
        counting: swm_core::results::Counting::default(),
        prediction: None,
        planning_seed: None,
        ..request.clone()
    }
}

fn text(request: &EvalRequest) -> Result<String> {
    serde_json::to_string(request).map_err(|error| Error::external("writing a request", error))
}

/// The mean absolute difference of equally many values.
fn difference(from: &[Vec<u8>], to: &[Vec<u8>]) -> f64 {
    let pairs = || from.iter().flatten().zip(to.iter().flatten());
    let sum: u64 = pairs().map(|(a, b)| u64::from(a.abs_diff(*b))).sum();
    sum as f64 / pairs().count().max(1) as f64
}

/// The frames of the last unshifted scene, which many conditions are compared with.
#[derive(Default)]
struct Frames {
    scene: String,
    frames: Vec<Vec<u8>>,
}

impl Frames {
    /// The first frames of an unshifted scene.
    fn of(&mut self, request: &EvalRequest, resolver: &dyn Resolver, options: &RunOptions) -> Result<&[Vec<u8>]> {
        let text = text(request)?;
        if self.scene != text {
            *self = Self { frames: first_frames(request, resolver, options)?, scene: text };
        }
        Ok(&self.frames)
    }
}

/// The first frames of the first starts of a request.
fn first_frames(request: &EvalRequest, resolver: &dyn Resolver, options: &RunOptions) -> Result<Vec<Vec<u8>>> {
    let n = request.episodes.min(STARTS);
    let mut world: World = request.world(resolver, ENVS.min(n), options)?;
    let dataset = match &request.starts {
        StartsRequest::Episodic => None,
        StartsRequest::Dataset { dataset, .. } => Some(resolver.dataset(dataset)?),
    };
    let variation: VariationRequest =
        request.conditions.first().map(|condition| condition.variation.clone()).unwrap_or_default();
    let starts = request.starts(dataset.as_deref(), world.pool().env(0), variation)?;
    let pixels = world.pool().infos().schema().index(PIXELS)?;
    let (slots, mut frames) = (world.pool().len(), vec![]);
    for first in (0..n).step_by(slots) {
        let starting: Vec<(usize, usize)> = (0..slots.min(n - first)).map(|slot| (slot, first + slot)).collect();
        starts.start(world.pool_mut(), &starting)?;
        let infos = world.pool().infos();
        frames.extend(starting.iter().map(|(slot, _)| infos.row(*slot).bytes(pixels).to_vec()));
    }
    Ok(frames)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn differences_are_means_over_all_values() {
        let frames = |values: [u8; 4]| vec![values[..2].to_vec(), values[2..].to_vec()];
        assert_eq!(difference(&frames([0, 10, 255, 3]), &frames([0, 30, 0, 3])), (20.0 + 255.0) / 4.0);
        assert_eq!(difference(&[], &[]), 0.0);
    }
}
