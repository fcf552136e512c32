//! [`Description`]: the bridge's description of an environment. [`EnvLayout`]: the spec and the memory layout that are
//! derived from the description.

use serde::Deserialize;
use std::collections::BTreeMap;
use std::ops::Range;
use swm_core::{Action, Callable, ColumnSpec, DType, EnvSpec, Error, Factor, Result, Schema, Space, VariationSpace};

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
    max_episode_steps: usize,
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
    /// When the text is not the JSON of a description.
    pub fn parse(json: &str) -> Result<Self> {
        serde_json::from_str(json).map_err(|error| Error::external("parsing the description of an environment", error))
    }
}

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
        self.offset..self.offset + self.size[0] * self.size[1] * 3
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
    fn space(&self) -> Result<Space> {
        Ok(match self {
            Self::Box { shape, dtype, low, high } => {
                let n = shape.iter().product();
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

/// The spec and the memory layout of all environments of one id.
pub struct EnvLayout {
    pub(crate) description: Description,
    pub(crate) spec: EnvSpec,
    /// The byte range of each column.
    pub(crate) columns: Vec<Range<usize>>,
    /// The byte range of the action.
    pub(crate) action: Range<usize>,
}

/// Offsets in bytes in the header of the buffer: reward and goal distance (doubles), then three flags.
pub(crate) mod header {
    pub const REWARD: usize = 0;
    pub const DISTANCE: usize = 8;
    pub const TERMINATED: usize = 16;
    pub const TRUNCATED: usize = 17;
    pub const SUCCESS: usize = 18;
    pub const END: usize = 19;
}

impl EnvLayout {
    /// Derives the layout of the environment `id` from its description.
    ///
    /// # Errors
    /// When a factor's default is outside its own space, or the description contradicts itself.
    pub fn new(id: &str, description: Description) -> Result<Self> {
        let mut factors = vec![];
        for FactorJson { key, space, init } in &description.factors {
            let factor = Factor::new(key, space.space()?, init.clone());
            factor.space.check(&format!("the default of '{key}' of {id}"), init)?;
            factors.push(factor);
        }
        let mut columns = vec![];
        let mut ranges = vec![];
        for ColumnJson { name, dtype, shape, offset } in &description.columns {
            let column = ColumnSpec::new(name, dtype_of(dtype)?, shape.clone());
            ranges.push(*offset..offset + column.row_bytes());
            columns.push(column);
        }
        Schema::new(columns.clone())?;
        let mut observation_space = vec![];
        for (name, space) in &description.observation {
            // Leaks once per name: the names in a spec are static.
            observation_space.push((crate::interned::interned(name), space.space()?));
        }
        let spec = EnvSpec {
            id: id.to_owned(),
            action_space: description.action.space()?,
            columns,
            observation_space,
            variation_space: VariationSpace::new(factors, &[]),
            max_episode_steps: description.max_episode_steps,
            cameras: vec![],
        };
        let column = spec.action_column();
        let action = description.action_offset..description.action_offset + column.row_bytes();
        let layout = Self { columns: ranges, action, spec, description };
        let frames = layout.frame().into_iter().chain(layout.goal()).map(FrameRegion::range);
        let all = layout.columns.iter().cloned().chain(frames).chain([layout.action.clone(), layout.factors()]);
        let end = all.map(|range| range.end).max().unwrap_or(0).max(header::END);
        if end > layout.description.size {
            return Err(Error::mismatch(
                "describing an environment",
                format!("{end} bytes"),
                layout.description.size.to_string(),
            ));
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

    /// The methods that set the state of the environment.
    pub(crate) fn callables(&self) -> &[Callable] {
        &self.description.callables
    }

    /// The byte range of the factor values, doubles in sampling order.
    pub(crate) fn factors(&self) -> Range<usize> {
        let n: usize = self.spec.variation_space.factors().iter().map(|factor| factor.space.len()).sum();
        self.description.factors_offset..self.description.factors_offset + n * size_of::<f64>()
    }
}
