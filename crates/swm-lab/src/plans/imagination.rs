//! [`Imagination`]: what a world model predicts of candidates, beside what happens: latents of predicted steps, and of the
//! frames of the steps that the environment takes; both as frames where a decoder was fitted.

use super::FrameDecoder;
use super::projection::Pca;
use super::scratch::{self, Codec, Scratch};
use super::watch::Candidate;
use serde_json::{Value, json};
use std::rc::Rc;
use swm_core::columns::PIXELS;
use swm_core::{Batch, ColumnSpec, Predictor, Result, Schema, Snapshot};

/// The largest number of frames that are encoded for one search.
const MOST_FRAMES: usize = 256;
/// The largest number of steps of a candidate that are shown as frames.
const MOST_SHOWN: usize = 8;

/// A world model whose latents are those of frames.
pub struct Imagination {
    model: Box<dyn Predictor>,
    side: usize,
    frames: Batch,
    /// Decodes latents to frames.
    pub decoder: Option<Rc<FrameDecoder>>,
    cheapest: Option<Path>,
}

/// The cheapest candidate of the last search.
struct Path {
    /// The frames of the start and of the steps, then that of the goal, `[steps + 2, side, side, 3]`.
    frames: Vec<u8>,
    /// The latents of these frames, `[steps + 2, dim]`.
    latents: Vec<f32>,
    /// The predicted latents of the steps, `[steps, dim]`.
    imagined: Vec<f32>,
    /// Environment steps in a model step.
    block: usize,
}

impl Imagination {
    /// A model that reads frames of this side; `None` if it reads something else as well.
    ///
    /// # Errors
    /// When the frames are too large.
    pub fn new(model: Box<dyn Predictor>, side: usize) -> Result<Option<Self>> {
        if model.columns() != [PIXELS] {
            return Ok(None);
        }
        let frames = Batch::zeros(&Schema::new([ColumnSpec::image(PIXELS, side, side)])?, 0);
        Ok(Some(Self { model, side, frames, decoder: None, cheapest: None }))
    }

    /// The model, and the side of the frames that it reads.
    pub fn model(&mut self) -> (&mut dyn Predictor, usize) {
        (&mut *self.model, self.side)
    }

    /// Compares what the model predicts of candidates with what they lead to. The cheapest is the first.
    ///
    /// # Errors
    /// When the model or the environment fails.
    pub fn compare(
        &mut self,
        candidates: &[&Candidate],
        (scratch, start, codec): (&mut Scratch, &Snapshot, &Codec),
    ) -> Result<Value> {
        let (block, dim) = (self.model.frameskip(), self.model.latent_dim());
        let steps = candidates.first().map_or(0, |one| one.actions.len() / (block * codec.width()).max(1));
        let most = ((MOST_FRAMES - 1) / (steps + 1)).min(candidates.len());
        self.cheapest = None;
        if steps == 0 || most == 0 {
            return Ok(Value::Null);
        }
        // The goal, then the start and the steps of each candidate.
        self.frames.resize(1 + most * (steps + 1));
        scratch.pixels(start, true, self.side, self.frames.row_mut(0).at::<u8>(0))?;
        let mut actions = vec![];
        for (i, candidate) in candidates[..most].iter().enumerate() {
            let first = 1 + i * (steps + 1);
            scratch.pixels(start, false, self.side, self.frames.row_mut(first).at::<u8>(0))?;
            for (step, planned) in candidate.actions.chunks_exact(block * codec.width()).enumerate() {
                scratch.go_on(codec, planned)?;
                scratch.pixels_now(self.side, self.frames.row_mut(first + 1 + step).at::<u8>(0))?;
                actions.extend(codec.scaled(planned));
            }
        }
        let mut latents = vec![0.0; self.frames.rows() * dim];
        self.model.encode(&self.frames, &mut latents)?;
        let (goal, true_) = latents.split_at(dim);
        let starts = true_.chunks_exact((steps + 1) * dim).flat_map(|path| path[..dim].iter().copied());
        let mut imagined = vec![0.0; most * steps * dim];
        self.model.rollout(&starts.collect::<Vec<_>>(), &actions, steps, &mut imagined)?;
        let rgb = self.frames.get::<u8>(PIXELS)?;
        let bytes = rgb.len() / self.frames.rows();
        self.cheapest = Some(Path {
            frames: [&rgb[bytes..(steps + 2) * bytes], &rgb[..bytes]].concat(),
            latents: [&true_[..(steps + 1) * dim], goal].concat(),
            imagined: imagined[..steps * dim].to_vec(),
            block,
        });
        let mut shown = described(goal, true_, &imagined, (steps, dim, block));
        if !shown.is_null() {
            shown["frames"] = self.decoded()?;
        }
        Ok(shown)
    }

    /// The cheapest candidate of the last search as frames: what happens, the same through the decoder, and what the model
    /// predicts; `null` without a decoder or a search.
    ///
    /// # Errors
    /// When a frame cannot be encoded.
    pub fn decoded(&self) -> Result<Value> {
        let (Some(decoder), Some(path)) = (&self.decoder, &self.cheapest) else { return Ok(Value::Null) };
        let dim = self.model.latent_dim();
        let steps = path.imagined.len() / dim;
        let decoded = (decoder.decode)(&path.latents);
        let predicted = (decoder.decode)(&[&path.latents[..dim], &path.imagined].concat());
        let bytes = self.side * self.side * 3;
        let jpeg = |frames: &[u8], at: usize| scratch::jpeg(&frames[at * bytes..(at + 1) * bytes], self.side);
        let shown = steps.min(MOST_SHOWN - 1);
        let shown: Vec<usize> = (0..=shown).map(|i| i * steps / shown).collect();
        let of = |frames: &[u8]| shown.iter().map(|&at| jpeg(frames, at)).collect::<Result<Vec<_>>>();
        Ok(json!({
            "steps": shown.iter().map(|at| at * path.block).collect::<Vec<_>>(),
            "true": of(&path.frames)?,
            "decoded": of(&decoded)?,
            "imagined": of(&predicted)?,
            "goal": [jpeg(&path.frames, steps + 1)?, jpeg(&decoded, steps + 1)?],
        }))
    }
}

/// What the page shows of latents: `true_` is `[n, steps + 1, dim]`, `imagined` is `[n, steps, dim]`.
fn described(goal: &[f32], true_: &[f32], imagined: &[f32], (steps, dim, block): (usize, usize, usize)) -> Value {
    let wide = |values: &[f32]| -> Vec<Vec<f64>> {
        values.chunks_exact(dim).map(|latent| latent.iter().copied().map(f64::from).collect()).collect()
    };
    let (goal, true_, imagined) = (&wide(goal)[0], wide(true_), wide(imagined));
    let all = true_.iter().chain(&imagined).chain([goal]).map(Vec::as_slice);
    let Some(pca) = Pca::of(all) else { return Value::Null };
    let points = |path: &[Vec<f64>]| path.iter().map(|latent| pca.point(latent)).collect::<Vec<_>>();
    let paths = true_.chunks_exact(steps + 1).zip(imagined.chunks_exact(steps));
    let lines: Vec<Value> = paths
        .clone()
        .map(|(happened, predicted)| {
            let from_start = [&happened[..1], predicted].concat();
            json!({"true": points(happened), "imagined": points(&from_start)})
        })
        .collect();
    let count = (true_.len() / (steps + 1)) as f64;
    let error = (0..steps).map(|step| {
        paths.clone().map(|(happened, predicted)| distance(&happened[step + 1], &predicted[step])).sum::<f64>() / count
    });
    let to_goal = |path: &[Vec<f64>]| path.iter().map(|latent| distance(latent, goal)).collect::<Vec<_>>();
    let moved = |step: usize| paths.clone().map(|(happened, _)| distance(&happened[step], &happened[0])).sum::<f64>();
    json!({
        "block": block,
        "lines": lines,
        "goal": pca.point(goal),
        "explained": pca.explained,
        "error": std::iter::once(0.0).chain(error).collect::<Vec<_>>(),
        "moved": (0..=steps).map(|step| moved(step) / count).collect::<Vec<_>>(),
        "true_to_goal": to_goal(&true_[..=steps]),
        "imagined_to_goal": to_goal(&[&true_[..1], &imagined[..steps]].concat()),
    })
}

fn distance(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_and_distances_are_those_of_latents() {
        // One candidate of two steps in a latent of two dimensions; the model is off by 1 at the second step.
        let (goal, true_, imagined) = ([3.0, 4.0], [0.0, 0.0, 1.0, 0.0, 2.0, 0.0], [1.0, 0.0, 2.0, 1.0]);
        let shown = described(&goal, &true_, &imagined, (2, 2, 5));
        assert_eq!((&shown["error"], &shown["moved"]), (&json!([0.0, 0.0, 1.0]), &json!([0.0, 1.0, 2.0])));
        assert_eq!(shown["true_to_goal"][0], 5.0);
        assert_eq!(shown["lines"][0]["true"].as_array().map(Vec::len), Some(3));
        assert_eq!(shown["lines"][0]["imagined"][0], shown["lines"][0]["true"][0], "both begin at the start");
    }
}
