//! [`ActionCodec`]: between the numbers of a plan and the actions an environment executes.
//!
//! A model step stands for a block of environment actions that lie one after another. A point of a box is planned in
//! model units ([`ActionScale`]); an integer is planned as a one-hot vector of its options, several integers of one
//! action one after another.

use crate::ActionScale;
use swm_core::{Action, EnvSpec, Error, PlanSpace, Result, Space};

/// How the actions of one environment are planned.
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
    /// One integer or several.
    Discrete {
        /// The options of every choice of a model step.
        choices: Vec<usize>,
        /// The first option of every integer of one action.
        start: Vec<i64>,
    },
}

/// The action that was decoded last; keeps its memory.
#[derive(Default)]
pub(crate) struct Decoded {
    numbers: Vec<f32>,
    integers: Vec<i64>,
}

impl ActionCodec {
    /// The codec of an environment, with `block` actions in a model step.
    ///
    /// # Errors
    /// When the scale does not fit the action space, or nothing can be planned in it.
    pub fn new(spec: &EnvSpec, scale: ActionScale, block: usize) -> Result<Self> {
        scale.check(spec)?;
        let space = &spec.action_space;
        let integers: Vec<(i64, i64)> = match space {
            Space::Box { .. } => {
                let (low, high) = scale.bounds(space, block);
                #[allow(clippy::cast_possible_truncation)]
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
                    "plan in boxes or among integers",
                ));
            }
        };
        let options: Vec<usize> = integers.iter().map(|&(n, _)| usize::try_from(n).unwrap_or(0)).collect();
        let start = integers.into_iter().map(|(_, start)| start).collect();
        Ok(Self::Discrete { choices: options.repeat(block), start })
    }

    /// What a model step of a plan may be.
    pub fn space(&self) -> PlanSpace<'_> {
        match self {
            Self::Continuous { low, high, .. } => PlanSpace::Continuous { low, high },
            Self::Discrete { choices, .. } => PlanSpace::Discrete { choices },
        }
    }

    /// Numbers that stand for one environment action.
    pub fn width(&self) -> usize {
        match self {
            Self::Continuous { bounds, .. } => bounds.len(),
            Self::Discrete { choices, start } => choices[..start.len()].iter().sum(),
        }
    }

    /// The action that [`ActionCodec::width`] numbers stand for: within the action space, or the option with the largest
    /// number, the first of them where several are as large.
    pub fn decode<'a>(&self, planned: &[f32], decoded: &'a mut Decoded) -> Action<'a> {
        match self {
            Self::Continuous { scale, bounds, .. } => {
                let numbers = &mut decoded.numbers;
                numbers.resize(bounds.len(), 0.0);
                scale.to_env(planned, numbers);
                for (number, &[low, high]) in numbers.iter_mut().zip(bounds) {
                    *number = number.clamp(low, high);
                }
                Action::Continuous(numbers)
            }
            Self::Discrete { choices, start } => {
                decoded.integers.clear();
                let mut rest = planned;
                for (&options, &first) in choices.iter().zip(start) {
                    let (weights, behind) = rest.split_at(options);
                    decoded.integers.push(first + largest(weights));
                    rest = behind;
                }
                Action::Discrete(&decoded.integers)
            }
        }
    }

    /// Writes the numbers that stand for an action.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    pub fn encode(&self, action: Action<'_>, planned: &mut [f32]) {
        match (self, action) {
            (Self::Continuous { scale, .. }, Action::Continuous(numbers)) => scale.to_model(numbers, planned),
            (Self::Discrete { choices, start }, Action::Discrete(integers)) => {
                planned.fill(0.0);
                let mut place = 0;
                for ((&options, first), integer) in choices.iter().zip(start).zip(integers) {
                    planned[place + (integer - first) as usize] = 1.0;
                    place += options;
                }
            }
            _ => {}
        }
    }
}

/// The place of the largest number; of the first, where several are as large.
#[allow(clippy::cast_possible_wrap)]
fn largest(weights: &[f32]) -> i64 {
    let best = (0..weights.len()).reduce(|best, i| if weights[i] > weights[best] { i } else { best });
    best.unwrap_or(0) as i64
}
