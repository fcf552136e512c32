//! [`Description`]: what the bridge says of an environment; [`Form`]: what that makes of a world.

use serde::Deserialize;
use std::collections::BTreeMap;
use std::ops::Range;
use swm_core::{Action, Callable, ColumnSpec, DType, EnvSpec, Error, Factor, Result, Schema, Space, VariationSpace};

/// What an environment is, and where in the buffer everything lies: `Bridge.describe()`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct Description {
    action: Wire,
    action_offset: usize,
    columns: Vec<Column>,
    observation: Vec<(String, Wire)>,
    factors: Vec<WireFactor>,
    factors_offset: usize,
    picture: Option<Place>,
    goal: Option<Place>,
    no_picture: String,
    pixel_art: bool,
    max_episode_steps: usize,
    libraries: BTreeMap<String, String>,
    /// How it takes a state, if its methods tell.
    calls: Vec<Callable>,
    /// Bytes of the buffer.
    pub size: usize,
}

impl Description {
    /// Reads what the bridge says.
    ///
    /// # Errors
    /// When it is of another version.
    pub fn parse(json: &str) -> Result<Self> {
        serde_json::from_str(json).map_err(|error| Error::external("reading what an environment is", error))
    }
}

/// A column and where it lies.
#[derive(Clone, Debug, PartialEq, Deserialize)]
struct Column {
    name: String,
    dtype: String,
    shape: Vec<usize>,
    offset: usize,
}

/// An RGB picture of `[height, width]` and where it lies.
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub(crate) struct Place {
    pub size: [usize; 2],
    pub offset: usize,
}

impl Place {
    pub fn range(&self) -> Range<usize> {
        self.offset..self.offset + self.size[0] * self.size[1] * 3
    }
}

#[derive(Clone, Debug, PartialEq, Deserialize)]
struct WireFactor {
    key: String,
    space: Wire,
    init: Vec<f64>,
}

/// A space; bounds are one number for all, and none where there is no bound.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(tag = "type")]
enum Wire {
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

impl Wire {
    fn space(&self) -> Result<Space> {
        Ok(match self {
            Self::Box { shape, dtype, low, high } => {
                let n = shape.iter().product();
                let all = |bounds: &[Option<f64>], none: f64| -> Vec<f64> {
                    (0..n).map(|i| bounds[if bounds.len() == 1 { 0 } else { i }].unwrap_or(none)).collect()
                };
                let fits = |bounds: &[Option<f64>]| bounds.len() == n || bounds.len() == 1;
                if !fits(low) || !fits(high) {
                    return Err(Error::mismatch("reading a space", format!("{} bounds", low.len()), format!("{n}")));
                }
                Space::Box {
                    shape: shape.clone(),
                    dtype: type_of(dtype)?,
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

/// The type that numpy gives this name.
fn type_of(name: &str) -> Result<DType> {
    const ALL: [DType; 6] = [DType::Bool, DType::U8, DType::Int32, DType::Int64, DType::Float32, DType::Float64];
    let known = || ALL.iter().map(|dtype| dtype.name());
    let found = ALL.iter().find(|dtype| dtype.name() == name);
    found.copied().ok_or_else(|| Error::unknown("type of numbers", name, known(), "columns hold no other"))
}

/// What all environments of one id share: the platform's view of a description.
pub struct Form {
    pub(crate) description: Description,
    pub(crate) spec: EnvSpec,
    /// Where each column lies.
    pub(crate) columns: Vec<Range<usize>>,
    /// Where the action lies.
    pub(crate) action: Range<usize>,
}

/// The head of the buffer: reward, distance to the goal, then three flags.
pub(crate) mod head {
    pub const REWARD: usize = 0;
    pub const DISTANCE: usize = 8;
    pub const TERMINATED: usize = 16;
    pub const TRUNCATED: usize = 17;
    pub const SUCCESS: usize = 18;
    pub const END: usize = 19;
}

impl Form {
    /// The world that environments of this description are, under this id.
    ///
    /// # Errors
    /// When a factor's default is outside its own space, or the description contradicts itself.
    pub fn new(id: &str, description: Description) -> Result<Self> {
        let mut factors = vec![];
        for WireFactor { key, space, init } in &description.factors {
            let factor = Factor::new(key, space.space()?, init.clone());
            factor.space.check(&format!("the default of '{key}' of {id}"), init)?;
            factors.push(factor);
        }
        let mut columns = vec![];
        let mut places = vec![];
        for Column { name, dtype, shape, offset } in &description.columns {
            let column = ColumnSpec::new(name, type_of(dtype)?, shape.clone());
            places.push(*offset..offset + column.row_bytes());
            columns.push(column);
        }
        Schema::new(columns.clone())?;
        let mut observation_space = vec![];
        for (name, space) in &description.observation {
            // Once for each id: the names of a registry are static.
            observation_space.push((crate::choose::interned(name), space.space()?));
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
        let form = Self { columns: places, action, spec, description };
        let pictures = form.picture().into_iter().chain(form.goal()).map(Place::range);
        let all = form.columns.iter().cloned().chain(pictures).chain([form.action.clone(), form.factors()]);
        let end = all.map(|range| range.end).max().unwrap_or(0).max(head::END);
        if end > form.description.size {
            return Err(Error::mismatch(
                "describing an environment",
                format!("{end} bytes"),
                form.description.size.to_string(),
            ));
        }
        Ok(form)
    }

    /// The pictures the environment draws.
    pub(crate) fn picture(&self) -> Option<&Place> {
        self.description.picture.as_ref()
    }

    /// The picture of the goal that its `info` holds.
    pub(crate) fn goal(&self) -> Option<&Place> {
        self.description.goal.as_ref()
    }

    /// The numbers of an action, as they lie in the memory.
    pub(crate) fn bytes<'a>(&self, action: Action<'a>) -> Result<&'a [u8]> {
        let space = &self.spec.action_space;
        Ok(match space {
            Space::Box { .. } => bytemuck::cast_slice(action.continuous(space.len())?),
            _ => bytemuck::cast_slice(action.discrete(space)?),
        })
    }

    /// Why there are no pictures.
    pub(crate) fn no_picture(&self) -> &str {
        &self.description.no_picture
    }

    /// Whether pictures are pixel art.
    pub(crate) fn pixel_art(&self) -> bool {
        self.description.pixel_art
    }

    /// What decides numbers and pictures, with versions.
    pub(crate) fn libraries(&self) -> &BTreeMap<String, String> {
        &self.description.libraries
    }

    /// The methods that put it into a state.
    pub(crate) fn calls(&self) -> &[Callable] {
        &self.description.calls
    }

    /// Where the factors' values lie, as doubles in sampling order.
    pub(crate) fn factors(&self) -> Range<usize> {
        let n: usize = self.spec.variation_space.factors().iter().map(|factor| factor.space.len()).sum();
        self.description.factors_offset..self.description.factors_offset + n * size_of::<f64>()
    }
}
