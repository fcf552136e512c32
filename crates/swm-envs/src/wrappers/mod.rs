//! Visual wrappers: what is done to the pictures of any environment, without touching its world.
//!
//! A [`VisualWrapper`] changes a picture in place. [`Wrapped`] is an environment whose pictures pass through an
//! ordered stack of them. What a wrapper draws at random is a function of the episode's seed, its place in the
//! stack and the step, never of how often a picture was asked for: drawing twice gives equal bytes, and a restored
//! snapshot continues bit for bit.
//!
//! Wrappers, their parameters, defaults and meanings are those of the Python package `stable-worldmodel` 0.1.1
//! (`wrapper/visual.py`) and of the paper's table of visual wrappers; every file names its deviations.
//! `docs/wrappers.md` shows them.

mod blur;
mod border;
mod chroma_key;
mod color_jitter;
mod cutout;
mod gaussian;
mod grayscale;
mod media;
mod moving_patch;
mod noise;
mod occlusion;
mod patch;
mod random_conv;
mod random_shift;
mod resolution;
mod settings;
mod wrapped;

#[cfg(test)]
mod golden;

pub use settings::{Domain, Formula, Parameter, Schedule, Settings};
pub use wrapped::{GoalPicture, Stack, Wrapped};

use serde_json::{Value, json};
use swm_core::{Error, FrameMut, Key, Named, Registry, Result};

/// Every visual wrapper.
pub static WRAPPERS: Registry<WrapperEntry> = Registry {
    kind: "wrapper",
    hint: "`swm wrappers` lists them",
    rows: &[
        chroma_key::ENTRY,
        noise::ENTRY,
        blur::ENTRY,
        color_jitter::ENTRY,
        grayscale::ENTRY,
        random_shift::ENTRY,
        cutout::ENTRY,
        occlusion::ENTRY,
        moving_patch::ENTRY,
        random_conv::ENTRY,
        resolution::ENTRY,
    ],
};

/// Which picture of an episode a wrapper is shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum View {
    /// The world after that many steps.
    Step(u64),
    /// The goal; what moves stands where it stood at step 0.
    Goal,
}

impl View {
    /// The step whose place and strength things have in this picture.
    pub fn step(self) -> u64 {
        match self {
            Self::Step(step) => step,
            Self::Goal => 0,
        }
    }

    /// Where the randomness of this picture alone comes from.
    #[must_use]
    pub fn key(self, episode: Key) -> Key {
        match self {
            Self::Step(step) => episode.with("step").at(step),
            Self::Goal => episode.with("goal"),
        }
    }
}

/// Something done to pictures.
pub trait VisualWrapper: Send + Sync {
    /// The id of its registry row.
    fn id(&self) -> &'static str;

    /// Begins an episode: what is drawn once for all its pictures, and what is drawn for each of them, comes from
    /// this key. Wrappers without randomness ignore it.
    fn reset(&mut self, episode: Key) {
        let _ = episode;
    }

    /// Changes a picture, of any size, in place.
    fn apply(&mut self, frame: &mut FrameMut<'_>, view: View);

    /// Another one with the same settings, for another environment; what is large (a video) is shared.
    fn fork(&self) -> Box<dyn VisualWrapper>;
}

/// A wrapper that can be made.
pub struct WrapperEntry {
    /// Its id, such as `noise`.
    pub id: &'static str,
    /// What it does to a picture, in a sentence.
    pub summary: &'static str,
    /// What can be set.
    pub parameters: &'static [Parameter],
    /// Makes one from values of all parameters that were found to be allowed.
    build: fn(Value) -> Result<Box<dyn VisualWrapper>>,
}

impl Named for WrapperEntry {
    fn id(&self) -> &'static str {
        self.id
    }
}

impl WrapperEntry {
    /// Makes one; parameters that `settings` does not name have their defaults.
    ///
    /// # Errors
    /// When a parameter is unknown, missing or not allowed, or a file it names cannot be read.
    pub fn make(&self, settings: &Settings) -> Result<Box<dyn VisualWrapper>> {
        (self.build)(settings::complete(self.id, self.parameters, settings)?.into())
    }

    /// Summary and parameters, with what they may be and their defaults (null: must be given), as JSON.
    pub fn describe(&self) -> Value {
        let parameters: Settings = self
            .parameters
            .iter()
            .map(|p| {
                let about =
                    json!({"summary": p.summary, "allowed": p.domain.to_string(), "default": p.default_value()});
                (p.name.to_owned(), about)
            })
            .collect();
        json!({"summary": self.summary, "parameters": parameters})
    }
}

/// Makes a wrapper from its form on the command line: `noise,std=8`, `color-jitter,brightness=0.5/1.5`.
///
/// # Errors
/// When the wrapper or a parameter is unknown, or a value is not allowed.
pub fn parse(text: &str) -> Result<Box<dyn VisualWrapper>> {
    let (entry, settings) = read(text)?;
    entry.make(&settings)
}

/// The wrapper and the settings that its form on the command line names.
///
/// # Errors
/// When the wrapper or a parameter is unknown, or a value is not of the parameter's kind.
pub fn read(text: &str) -> Result<(&'static WrapperEntry, Settings)> {
    let (id, settings) = text.split_once(',').unwrap_or((text, ""));
    let entry = WRAPPERS.get(id)?;
    Ok((entry, settings::read(entry.id, entry.parameters, settings)?))
}

/// The typed settings of a wrapper, from checked values.
fn typed<T: serde::de::DeserializeOwned>(wrapper: &str, settings: Value) -> Result<T> {
    serde_json::from_value(settings).map_err(|error| {
        Error::config(format!("wrapper '{wrapper}'"), error.to_string(), "`swm wrappers` lists what it takes")
    })
}
