//! Visual wrappers: changes to the frames of any environment that leave its dynamics untouched.
//!
//! A [`VisualWrapper`] changes a frame in place. [`Wrapped`] is an environment whose frames pass through an ordered
//! stack of wrappers. Random draws of a wrapper depend on the episode's seed, its index in the stack and the step,
//! never on how often a frame was drawn: drawing twice gives equal bytes, and a restored snapshot continues bit for
//! bit.
//!
//! Wrappers, their parameters, defaults and meanings are those of the Python package `stable-worldmodel` 0.1.1
//! (`wrapper/visual.py`) and of the paper's table of visual wrappers; the file of every wrapper lists its deviations,
//! and `docs/wrappers.md` has example frames.

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
pub use wrapped::{GoalFrame, Stack, Wrapped};

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

/// The frame of an episode that a wrapper changes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EpisodeFrame {
    /// The frame after this number of steps.
    Step(u64),
    /// The goal frame, in which positions and schedules are those of step 0.
    Goal,
}

impl EpisodeFrame {
    /// Returns the step that decides positions and schedules in this frame.
    pub fn step(self) -> u64 {
        match self {
            Self::Step(step) => step,
            Self::Goal => 0,
        }
    }

    /// Returns the key of random draws for this frame alone.
    #[must_use]
    pub fn key(self, episode: Key) -> Key {
        match self {
            Self::Step(step) => episode.with("step").at(step),
            Self::Goal => episode.with("goal"),
        }
    }
}

/// A change to frames.
pub trait VisualWrapper: Send + Sync {
    /// The id of its registry row.
    fn id(&self) -> &'static str;

    /// Starts an episode. All random draws, per episode and per frame, derive from this key. Wrappers without
    /// randomness ignore it.
    fn reset(&mut self, episode: Key) {
        let _ = episode;
    }

    /// Changes a frame of any size in place.
    fn apply(&mut self, frame: &mut FrameMut<'_>, which: EpisodeFrame);

    /// Makes another wrapper with the same settings, for another environment. Large data, such as a video, is shared.
    fn fork(&self) -> Box<dyn VisualWrapper>;
}

/// A row of the registry of wrappers.
pub struct WrapperEntry {
    /// The id, such as `noise`.
    pub id: &'static str,
    /// A one-sentence description of the effect on a frame.
    pub summary: &'static str,
    /// The parameters.
    pub parameters: &'static [Parameter],
    /// Makes a wrapper from checked values of all parameters.
    build: fn(Value) -> Result<Box<dyn VisualWrapper>>,
}

impl Named for WrapperEntry {
    fn id(&self) -> &'static str {
        self.id
    }
}

impl WrapperEntry {
    /// Makes a wrapper; parameters that `settings` lacks have their defaults.
    ///
    /// # Errors
    /// When a parameter is unknown, missing or not allowed, or a file it names cannot be read.
    pub fn make(&self, settings: &Settings) -> Result<Box<dyn VisualWrapper>> {
        (self.build)(settings::complete(self.id, self.parameters, settings)?.into())
    }

    /// Whether a parameter names a file that the wrapper reads.
    pub fn reads_files(&self) -> bool {
        self.parameters.iter().any(|parameter| matches!(parameter.domain, Domain::Path))
    }

    /// Returns summary and parameters as JSON: allowed values and defaults (null: required).
    pub fn describe(&self) -> Value {
        let parameters: Settings = self
            .parameters
            .iter()
            .map(|p| {
                let description =
                    json!({"summary": p.summary, "allowed": p.domain.to_string(), "default": p.default_value()});
                (p.name.to_owned(), description)
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

/// Reads wrapper and settings in command-line form.
///
/// # Errors
/// When the wrapper or a parameter is unknown, or a setting is malformed.
pub fn read(text: &str) -> Result<(&'static WrapperEntry, Settings)> {
    let (id, settings) = text.split_once(',').unwrap_or((text, ""));
    let entry = WRAPPERS.get(id)?;
    Ok((entry, settings::read(entry.id, entry.parameters, settings)?))
}

/// Converts checked values to the typed settings of a wrapper.
fn typed<T: serde::de::DeserializeOwned>(wrapper: &str, settings: Value) -> Result<T> {
    serde_json::from_value(settings).map_err(|error| {
        Error::config(format!("wrapper '{wrapper}'"), error.to_string(), "`swm wrappers` lists its parameters")
    })
}
