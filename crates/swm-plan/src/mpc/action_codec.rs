//! [`ActionCodec`]: converts between the values of a plan and the actions an environment executes.
//!
//! A model step holds a block of consecutive environment actions. A point of a box is planned in model units
//! ([`ActionScale`]); an integer is planned as a one-hot vector over its options, and the integers of one action are
//! concatenated.

use super::action_scale::ActionScale;
use swm_core::{Action, EnvSpec, Error, PlanSpace, Result, Space};

/// The encoding of one environment's actions in plans.
pub(crate) enum ActionCodec {
    /// Points of a box.
    Continuous {
        scale: ActionScale,
        /// Bounds of one action, in environment units.
        bounds: Vec<[f32; 2]>,
        /// Bounds of a model step, in model units.
        low: Vec<f32>,
        high: Vec<f32>,
    },
    /// One or several integers.
    Discrete {
        /// The number of options of every choice of a model step.
        choices: Vec<usize>,
        /// The first option of every integer of one action.
        start: Vec<i64>,
    },
}

/// The memory of a decoded action, reused between calls.
#[derive(Default)]
pub(crate) struct Decoded {
    values: Vec<f32>,
    integers: Vec<i64>,
}

impl ActionCodec {
    /// Creates the codec of an environment, with `block` actions in a model step.
    ///
    /// # Errors
    /// When the scale does not fit the action space, or actions of this space cannot be planned.
    pub fn new(spec: &EnvSpec, scale: ActionScale, block: usize) -> Result<Self> {
        scale.check(spec)?;
        let space = &spec.action_space;
        let integers: Vec<(i64, i64)> = match space {
            Space::Box { .. } => {
                let (low, high) = scale.bounds(space, block);
                let bounds = (0..space.len()).map(|i| <[f64; 2]>::from(space.bounds(i)).map(|v| v as f32)).collect();
                return Ok(Self::Continuous { scale, bounds, low, high });
            }
            Space::Discrete { n, start } => vec![(*n, *start)],
            Space::MultiDiscrete { nvec, start } => nvec.iter().copied().zip(start.iter().copied()).collect(),
            Space::Rgb => {
                let given = format!("its action space is {}", space.describe());
                return Err(Error::config(
                    format!("planning in {}", spec.id),
                    given,
                    "choose an environment whose action space is a box or consists of integers",
                ));
            }
        };
        let options: Vec<usize> = integers.iter().map(|&(n, _)| usize::try_from(n).unwrap_or(0)).collect();
        let start = integers.into_iter().map(|(_, start)| start).collect();
        Ok(Self::Discrete { choices: options.repeat(block), start })
    }

    /// Returns the space of one model step of a plan.
    pub fn space(&self) -> PlanSpace<'_> {
        match self {
            Self::Continuous { low, high, .. } => PlanSpace::Continuous { low, high },
            Self::Discrete { choices, .. } => PlanSpace::Discrete { choices },
        }
    }

    /// The number of plan values that encode one environment action.
    pub fn width(&self) -> usize {
        match self {
            Self::Continuous { bounds, .. } => bounds.len(),
            Self::Discrete { choices, start } => choices[..start.len()].iter().sum(),
        }
    }

    /// Decodes one action from `planned`, `[width]`. A point is clipped to its box. An integer is the option with the
    /// largest value; of several such options, the first.
    pub fn decode<'a>(&self, planned: &[f32], decoded: &'a mut Decoded) -> Action<'a> {
        match self {
            Self::Continuous { scale, bounds, .. } => {
                let values = &mut decoded.values;
                values.resize(bounds.len(), 0.0);
                scale.to_env(planned, values);
                for (value, &[low, high]) in values.iter_mut().zip(bounds) {
                    *value = value.clamp(low, high);
                }
                Action::Continuous(values)
            }
            Self::Discrete { choices, start } => {
                decoded.integers.clear();
                let mut rest = planned;
                for (&options, &first) in choices.iter().zip(start) {
                    let (weights, tail) = rest.split_at(options);
                    decoded.integers.push(first + largest(weights) as i64);
                    rest = tail;
                }
                Action::Discrete(&decoded.integers)
            }
        }
    }

    /// Encodes an action into `planned`, `[width]`.
    pub fn encode(&self, action: Action<'_>, planned: &mut [f32]) {
        match (self, action) {
            (Self::Continuous { scale, .. }, Action::Continuous(values)) => scale.to_model(values, planned),
            (Self::Discrete { choices, start }, Action::Discrete(integers)) => {
                planned.fill(0.0);
                let mut offset = 0;
                for ((&options, first), integer) in choices.iter().zip(start).zip(integers) {
                    planned[offset + (integer - first) as usize] = 1.0;
                    offset += options;
                }
            }
            _ => {}
        }
    }
}

/// Returns the index of the first of the largest weights.
fn largest(weights: &[f32]) -> usize {
    let best = (0..weights.len()).reduce(|best, i| if weights[i] > weights[best] { i } else { best });
    best.unwrap_or(0)
}
