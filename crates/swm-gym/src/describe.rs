//! [`Description`]: the bridge's description of an environment. [`EnvLayout`]: the spec and the memory layout that are
//! derived from the description.

use crate::finite::FiniteCheck;
use serde::Deserialize;
use std::collections::BTreeMap;
use std::ops::Range;
use swm_core::{
    Action, Callable, ColumnSpec, DType, EnvSpec, Error, Factor, Result, Schema, Space, VariationSpace, limits,
};

/// The spaces, columns and factors of an environment, with their offsets in the buffer: `Bridge.describe()`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct Description {
    action: SpaceJson,
    action_offset: usize,
    columns: Vec<ColumnJson>,
    observation: Vec<(String, SpaceJson)>,
    factors: Vec<FactorJson>,
    factors_offset: usize,
    frame: Option<FrameRegion>,
    goal: Option<FrameRegion>,
    no_frame: String,
    pixel_art: bool,
    /// Whether the environment below the wrappers is one of this package, which takes seeds of 64 bits.
    #[serde(default)]
    native: bool,
    /// The time limit, which the user or the environment chose and which may be any value.
    max_episode_steps: serde_json::Value,
    libraries: BTreeMap<String, String>,
    /// The methods that set the state of the environment; empty if it has none.
    #[serde(rename = "calls")]
    callables: Vec<Callable>,
    /// The size of the buffer in bytes.
    pub size: usize,
}

impl Description {
    /// Parses the JSON of `Bridge.describe()`.
    ///
    /// # Errors
    /// When the text is not the JSON of a description, or the buffer exceeds [`MAX_MEMORY`].
    pub fn parse(json: &str) -> Result<Self> {
        const WHAT: &str = "parsing the description of an environment";
        let parsed: Self = serde_json::from_str(json).map_err(|error| Error::external(WHAT, error))?;
        if parsed.size > MAX_MEMORY {
            return Err(Error::mismatch(WHAT, format!("{} bytes", parsed.size), format!("at most {MAX_MEMORY}")));
        }
        Ok(parsed)
    }
}

/// Checks a time limit in steps.
fn time_limit(given: &serde_json::Value) -> Result<usize> {
    let most = limits::STEPS.max;
    let limit = given.as_u64().and_then(|steps| usize::try_from(steps).ok()).filter(|steps| (1..=most).contains(steps));
    limit.ok_or_else(|| {
        Error::config(
            "max_episode_steps",
            format!("{given} is no time limit"),
            format!("choose from 1 to {most} steps"),
        )
    })
}

/// The maximum size of the buffer of an environment, in bytes: one observation, one frame and one goal frame.
const MAX_MEMORY: usize = 4 << 30;

/// A column and its offset in the buffer.
#[derive(Clone, Debug, PartialEq, Deserialize)]
struct ColumnJson {
    name: String,
    dtype: String,
    shape: Vec<usize>,
    offset: usize,
}

/// The size `[height, width]` of an RGB frame and its offset in the buffer.
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub(crate) struct FrameRegion {
    pub size: [usize; 2],
    pub offset: usize,
}

impl FrameRegion {
    pub fn range(&self) -> Range<usize> {
        let bytes = self.size[0].saturating_mul(self.size[1]).saturating_mul(3);
        self.offset..self.offset.saturating_add(bytes)
    }
}

#[derive(Clone, Debug, PartialEq, Deserialize)]
struct FactorJson {
    key: String,
    space: SpaceJson,
    init: Vec<f64>,
}

/// A space; `low` and `high` have one bound for all elements or one for each, and `null` for no bound.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(tag = "type")]
enum SpaceJson {
    Box {
        shape: Vec<usize>,
        dtype: String,
        low: Vec<Option<f64>>,
        high: Vec<Option<f64>>,
    },
    Discrete {
        n: i64,
        start: i64,
    },
    MultiDiscrete {
        nvec: Vec<i64>,
        start: Vec<i64>,
    },
    #[serde(rename = "RGBBox")]
    Rgb,
}

impl SpaceJson {
    /// Returns the space, one value of which has at most `most` elements.
    fn space(&self, most: usize) -> Result<Space> {
        let space = self.unchecked(most)?;
        let holds_values = match &space {
            Space::Box { low, high, .. } => low.iter().zip(high).all(|(low, high)| low <= high),
            Space::Discrete { n, start } => *n > 0 && start.checked_add(*n).is_some(),
            Space::MultiDiscrete { nvec, start } => {
                let mut ranges = nvec.iter().zip(start);
                nvec.len() == start.len() && ranges.all(|(n, start)| *n > 0 && start.checked_add(*n).is_some())
            }
            Space::Rgb => true,
        };
        match holds_values {
            true => Ok(space),
            false => {
                let given = match self {
                    Self::Box { .. } | Self::Rgb => "a Box with a lower bound above its upper bound".to_owned(),
                    Self::Discrete { n, start } => format!("a Discrete of {n} values from {start}"),
                    Self::MultiDiscrete { .. } => {
                        "a MultiDiscrete or a Box of integers with an empty or larger range".to_owned()
                    }
                };
                let expected = "bounds with values between them, and ranges of at most 2^63 - 1 values";
                Err(Error::mismatch("reading a space", given, expected))
            }
        }
    }

    fn unchecked(&self, most: usize) -> Result<Space> {
        Ok(match self {
            Self::Box { shape, dtype, low, high } => {
                let n = elements(shape, most)?;
                let all = |bounds: &[Option<f64>], none: f64| -> Vec<f64> {
                    (0..n).map(|i| bounds[if bounds.len() == 1 { 0 } else { i }].unwrap_or(none)).collect()
                };
                let fits = |bounds: &[Option<f64>]| bounds.len() == n || bounds.len() == 1;
                if !fits(low) || !fits(high) {
                    let given = format!("{} lower and {} upper bounds", low.len(), high.len());
                    return Err(Error::mismatch(
                        "reading a space",
                        given,
                        format!("{n} of each, one for each element"),
                    ));
                }
                Space::Box {
                    shape: shape.clone(),
                    dtype: dtype_of(dtype)?,
                    low: all(low, f64::NEG_INFINITY),
                    high: all(high, f64::INFINITY),
                }
            }
            Self::Discrete { n, start } => Space::Discrete { n: *n, start: *start },
            Self::MultiDiscrete { nvec, start } => Space::MultiDiscrete { nvec: nvec.clone(), start: start.clone() },
            Self::Rgb => Space::Rgb,
        })
    }
}

/// Returns the number of elements of a shape, which is at most `most`.
fn elements(shape: &[usize], most: usize) -> Result<usize> {
    let n = shape.iter().try_fold(1_usize, |n, &side| n.checked_mul(side)).filter(|n| *n <= most);
    n.ok_or_else(|| {
        Error::mismatch(DESCRIBING, format!("shape {shape:?}"), format!("at most {most} elements, the buffer's bytes"))
    })
}

/// The operation in errors.
const DESCRIBING: &str = "describing an environment";

/// Returns the element type that a NumPy name denotes.
fn dtype_of(name: &str) -> Result<DType> {
    const ALL: [DType; 6] = [DType::Bool, DType::U8, DType::Int32, DType::Int64, DType::Float32, DType::Float64];
    let known = || ALL.iter().map(|dtype| dtype.name());
    let found = ALL.iter().find(|dtype| dtype.name() == name);
    found.copied().ok_or_else(|| {
        let hint = format!("columns hold {}", known().collect::<Vec<_>>().join(", "));
        Error::unknown("element type", name, known(), hint)
    })
}

/// Checks that a space is one of those that actions have.
fn action_space(space: &Space) -> Result<Space> {
    match space {
        Space::Box { dtype: DType::Float32, .. } | Space::Discrete { .. } | Space::MultiDiscrete { .. }
            if !space.is_empty() =>
        {
            Ok(space.clone())
        }
        other => Err(Error::mismatch(DESCRIBING, format!("actions: {}", other.describe()), "float32 or integers")),
    }
}

/// The spec and the memory layout of all environments of one id.
pub struct EnvLayout {
    pub(crate) description: Description,
    pub(crate) spec: EnvSpec,
    /// The byte range of each column.
    pub(crate) columns: Vec<Range<usize>>,
    /// The byte range of the action.
    pub(crate) action: Range<usize>,
    /// The warnings of NaN and infinite values.
    pub(crate) finite: FiniteCheck,
}

/// Offsets in bytes in the header of the buffer: reward and goal distance (doubles), then three flags.
pub(crate) mod header {
    pub const REWARD: usize = 0;
    pub const DISTANCE: usize = 8;
    pub const TERMINATED: usize = 16;
    pub const TRUNCATED: usize = 17;
    pub const SUCCESS: usize = 18;
    /// A flag that a process sets that the environment forked and that returned from a call.
    pub const FORKED: usize = 19;
    pub const END: usize = 20;
}

impl EnvLayout {
    /// Derives the layout of the environment `id` from its description.
    ///
    /// # Errors
    /// When a factor's default is outside its own space, or the description contradicts itself.
    pub fn new(id: &str, description: Description) -> Result<Self> {
        let size = description.size;
        let mut factors = vec![];
        for FactorJson { key, space, init } in &description.factors {
            let factor = Factor::new(key, space.space(size)?, init.clone());
            factor.space.check(&format!("the default of '{key}' of {id}"), init)?;
            factors.push(factor);
        }
        let mut columns = vec![];
        let mut ranges = vec![];
        for ColumnJson { name, dtype, shape, offset } in &description.columns {
            elements(shape, size)?;
            let column = ColumnSpec::new(name, dtype_of(dtype)?, shape.clone());
            ranges.push(*offset..offset.saturating_add(column.row_bytes()));
            columns.push(column);
        }
        Schema::new(columns.clone())?;
        let mut observation_space = vec![];
        for (name, space) in &description.observation {
            // Leaks once per name: the names in a spec are static.
            observation_space.push((crate::interned::interned(name), space.space(size)?));
        }
        let spec = EnvSpec {
            id: id.to_owned(),
            action_space: action_space(&description.action.space(size)?)?,
            columns,
            observation_space,
            variation_space: VariationSpace::new(factors, &[]),
            max_episode_steps: time_limit(&description.max_episode_steps)?,
            cameras: vec![],
            angles: vec![],
        };
        let column = spec.action_column();
        let action = description.action_offset..description.action_offset.saturating_add(column.row_bytes());
        let finite = FiniteCheck::new(ranges.len());
        let layout = Self { columns: ranges, action, spec, description, finite };
        let frames = layout.frame().into_iter().chain(layout.goal()).map(FrameRegion::range);
        let all = layout.columns.iter().cloned().chain(frames).chain([layout.action.clone(), layout.factors()]);
        let end = all.map(|range| range.end).max().unwrap_or(0).max(header::END);
        if end > size {
            return Err(Error::mismatch(DESCRIBING, format!("{end} bytes"), size.to_string()));
        }
        if let Some(empty) = layout.frame().into_iter().chain(layout.goal()).find(|frame| frame.size.contains(&0)) {
            return Err(Error::mismatch(DESCRIBING, format!("frames of {:?} pixels", empty.size), "at least 1 x 1"));
        }
        Ok(layout)
    }

    /// The region of the rendered frame, if the environment renders.
    pub(crate) fn frame(&self) -> Option<&FrameRegion> {
        self.description.frame.as_ref()
    }

    /// The region of the goal frame, if `info` has one.
    pub(crate) fn goal(&self) -> Option<&FrameRegion> {
        self.description.goal.as_ref()
    }

    /// Returns the bytes of an action in the layout of the buffer.
    pub(crate) fn bytes<'a>(&self, action: Action<'a>) -> Result<&'a [u8]> {
        let space = &self.spec.action_space;
        Ok(match space {
            Space::Box { .. } => bytemuck::cast_slice(action.continuous(space.len())?),
            _ => bytemuck::cast_slice(action.discrete(space)?),
        })
    }

    /// The reason for which `render` returns no frame; empty if it returns one.
    pub(crate) fn no_frame(&self) -> &str {
        &self.description.no_frame
    }

    /// Whether frames are pixel art.
    pub(crate) fn pixel_art(&self) -> bool {
        self.description.pixel_art
    }

    /// The versions of the libraries that affect values and frames.
    pub(crate) fn libraries(&self) -> &BTreeMap<String, String> {
        &self.description.libraries
    }

    /// Whether the environment below the wrappers is one of this package.
    pub(crate) fn is_native(&self) -> bool {
        self.description.native
    }

    /// The methods that set the state of the environment.
    pub(crate) fn callables(&self) -> &[Callable] {
        &self.description.callables
    }

    /// The byte range of the factor values, doubles in sampling order.
    pub(crate) fn factors(&self) -> Range<usize> {
        let n: usize = self.spec.variation_space.factors().iter().map(|factor| factor.space.len()).sum();
        let (start, bytes) = (self.description.factors_offset, n.saturating_mul(size_of::<f64>()));
        start..start.saturating_add(bytes)
    }
}
