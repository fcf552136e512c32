//! Settings of wrappers: each wrapper has a table of parameters with allowed values and defaults. Command line, JSON,
//! errors and listings all use this table.

use serde::Deserialize;
use serde_json::{Number, Value};
use std::fmt;
use swm_core::{Error, Result};

/// Values by parameter name, such as `{"std": 8}`.
pub type Settings = serde_json::Map<String, Value>;

/// One parameter of a wrapper.
#[derive(Clone, Copy, Debug)]
pub struct Parameter {
    /// The name.
    pub name: &'static str,
    /// A short description with the unit.
    pub summary: &'static str,
    /// The allowed values.
    pub domain: Domain,
    /// The default in command-line form; `None` if the parameter is required.
    pub default: Option<&'static str>,
}

/// The allowed values of a parameter. On the command line the values of a list are joined by `/`, in JSON they are an
/// array.
#[derive(Clone, Copy, Debug)]
pub enum Domain {
    /// An integer.
    Integer {
        /// The lower bound.
        low: u64,
        /// The upper bound.
        high: u64,
    },
    /// A number.
    Number {
        /// The lower bound.
        low: f64,
        /// The upper bound.
        high: f64,
    },
    /// One number, or the two ends of a range to sample from.
    Range {
        /// The lower bound.
        low: f64,
        /// The upper bound.
        high: f64,
    },
    /// The two ends of a range to sample from, or one number: the half-width of a range around `around`.
    Spread {
        /// The value without effect.
        around: f64,
        /// The lower bound.
        low: f64,
        /// The upper bound.
        high: f64,
    },
    /// A number, or a schedule over the steps of the episode ([`Schedule`]).
    Schedule {
        /// The lower bound.
        low: f64,
        /// The upper bound.
        high: f64,
    },
    /// A colour: red, green and blue, or one value for all three.
    Color,
    /// Colours, one after another.
    Colors,
    /// One of several words.
    Choice(&'static [&'static str]),
    /// A file or folder.
    Path,
}

impl Domain {
    /// Reads a value in command-line form, without checking it ([`Domain::contains`]).
    fn read(&self, text: &str) -> Value {
        if matches!(self, Self::Path | Self::Choice(_)) {
            return text.into();
        }
        let word = |word: &str| {
            let whole = word.parse::<i64>().ok().map(Number::from);
            whole.or_else(|| word.parse().ok().and_then(Number::from_f64)).map_or_else(|| word.into(), Value::Number)
        };
        match text.split_once('/') {
            None => word(text),
            Some(_) => text.split('/').map(word).collect(),
        }
    }

    /// Returns whether a value is allowed.
    fn contains(&self, value: &Value) -> bool {
        let within =
            |low: f64, high: f64| move |value: &Value| value.as_f64().is_some_and(|v| (low..=high).contains(&v));
        let byte = |value: &Value| value.as_u64().is_some_and(|v| v < 256);
        let ordered = |pair: &[Value]| pair[0].as_f64() <= pair[1].as_f64();
        match (*self, value) {
            (Self::Integer { low, high }, value) => value.as_u64().is_some_and(|v| (low..=high).contains(&v)),
            (Self::Range { low, high } | Self::Spread { low, high, .. }, Value::Array(ends)) => {
                ends.len() == 2 && ends.iter().all(within(low, high)) && ordered(ends)
            }
            (Self::Number { low, high } | Self::Range { low, high }, value) => within(low, high)(value),
            (Self::Spread { around, low, high }, value) => within(0.0, (high - around).max(around - low))(value),
            (Self::Schedule { low, high }, value) => {
                Schedule::deserialize(value).is_ok_and(|schedule| schedule.stays_within(low, high))
            }
            (Self::Color, Value::Array(color)) => color.len() == 3 && color.iter().all(byte),
            (Self::Color, value) => byte(value),
            (Self::Colors, Value::Array(colors)) => {
                !colors.is_empty() && colors.len() % 3 == 0 && colors.iter().all(byte)
            }
            (Self::Choice(words), value) => value.as_str().is_some_and(|word| words.contains(&word)),
            (Self::Path, value) => value.as_str().is_some_and(|path| !path.is_empty()),
            (Self::Colors, _) => false,
        }
    }
}

impl fmt::Display for Domain {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Integer { low, high } => write!(f, "an integer from {low} to {high}"),
            Self::Number { low, high } => write!(f, "a number from {low} to {high}"),
            Self::Range { low, high } => write!(f, "a number from {low} to {high}, or a range low/high of them"),
            Self::Spread { around, low, high } => {
                let most = (high - around).max(around - low);
                write!(
                    f,
                    "a number from 0 to {most} (half-width around {around}), or a range low/high from {low} to {high}"
                )
            }
            Self::Schedule { low, high } => write!(
                f,
                "a number from {low} to {high}, or linear/START/END/STEPS, cosine/START/END/STEPS, \
                 exponential/START/DECAY/FLOOR or sinusoidal/LOW/HIGH/PERIOD of them, or one value per step, \
                 FIRST/SECOND/…, the last one repeated"
            ),
            Self::Color => write!(f, "red/green/blue from 0 to 255, or one value for all three"),
            Self::Colors => write!(f, "red/green/blue from 0 to 255, repeated for further colours"),
            Self::Choice(words) => write!(f, "{}", words.join(" or ")),
            Self::Path => write!(f, "a path"),
        }
    }
}

/// Formats a value in command-line form.
fn formatted(value: &Value) -> String {
    match value {
        Value::String(word) => word.clone(),
        Value::Array(parts) => parts.iter().map(formatted).collect::<Vec<_>>().join("/"),
        other => other.to_string(),
    }
}

impl Parameter {
    /// Returns the default as JSON; null if the parameter is required.
    pub fn default_value(&self) -> Value {
        self.default.map_or(Value::Null, |text| self.domain.read(text))
    }
}

/// Returns the parameter with a name.
fn find(wrapper: &str, table: &'static [Parameter], name: &str) -> Result<&'static Parameter> {
    table.iter().find(|parameter| parameter.name == name).ok_or_else(|| {
        let names: Vec<&str> = table.iter().map(|parameter| parameter.name).collect();
        let hint = match names[..] {
            [] => format!("the wrapper '{wrapper}' has no parameters"),
            _ => format!("the parameters of the wrapper '{wrapper}' are {}", names.join(", ")),
        };
        Error::unknown("wrapper parameter", name, names, hint)
    })
}

/// Reads the settings `name=value,name=value` of a wrapper.
pub(super) fn read(wrapper: &str, table: &'static [Parameter], text: &str) -> Result<Settings> {
    let mut settings = Settings::new();
    for part in text.split(',').filter(|part| !part.is_empty()) {
        let Some((name, value)) = part.split_once('=') else {
            let problem = format!("'{part}' is not a setting");
            return Err(Error::config(format!("wrapper '{wrapper}'"), problem, "write it as NAME=VALUE"));
        };
        let value = find(wrapper, table, name)?.domain.read(value);
        if let Some(first) = settings.insert(name.to_owned(), value) {
            return Err(Error::twice(format!("wrapper '{wrapper}'"), format!("{name}={}", formatted(&first)), part));
        }
    }
    Ok(settings)
}

/// Returns a value for every parameter of the table: the given value, checked, or the default.
pub(super) fn complete(wrapper: &str, table: &'static [Parameter], given: &Settings) -> Result<Settings> {
    for name in given.keys() {
        find(wrapper, table, name)?;
    }
    let mut settings = Settings::new();
    for parameter in table {
        let value = match (given.get(parameter.name), parameter.default) {
            (Some(value), _) => value.clone(),
            (None, Some(_)) => parameter.default_value(),
            (None, None) => {
                let problem = format!("'{}' is missing", parameter.name);
                let fix = format!("add {}=…, {}: {}", parameter.name, parameter.domain, parameter.summary);
                return Err(Error::config(format!("wrapper '{wrapper}'"), problem, fix));
            }
        };
        if !parameter.domain.contains(&value) {
            return Err(Error::OutOfSpace {
                what: format!("wrapper '{wrapper}': {}", parameter.name),
                given: formatted(&value),
                expected: parameter.domain.to_string(),
            });
        }
        settings.insert(parameter.name.to_owned(), value);
    }
    Ok(settings)
}

/// A value as a function of the step of the episode, which starts at 0.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(untagged)]
pub enum Schedule {
    /// The same value at every step.
    Constant(f64),
    /// A formula with three parameters.
    Formula(Formula, f64, f64, f64),
    /// One value per step; the last one is repeated.
    Steps(Vec<f64>),
}

/// The formula of a [`Schedule`].
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Formula {
    /// `start, end, steps`: linear from start to end, then constant.
    Linear,
    /// `start, end, steps`: half a cosine wave from start to end, then constant.
    Cosine,
    /// `start, decay, floor`: multiplied by `decay` at every step, at least `floor`.
    Exponential,
    /// `low, high, period`: a sine wave between low and high, starting upwards from the mean, with a period in steps.
    Sinusoidal,
}

impl Schedule {
    /// Returns the value at a step.
    pub fn at(&self, step: u64) -> f64 {
        use std::f64::consts::{PI, TAU};
        let index = usize::try_from(step).unwrap_or(usize::MAX);
        let step = step as f64;
        let progress = |steps: f64| (step / steps.max(1.0)).min(1.0);
        match *self {
            Self::Constant(value) => value,
            Self::Steps(ref values) => values.get(index).or(values.last()).copied().unwrap_or_default(),
            Self::Formula(Formula::Linear, start, end, steps) => start + (end - start) * progress(steps),
            Self::Formula(Formula::Cosine, start, end, steps) => {
                end + 0.5 * (start - end) * (1.0 + (PI * progress(steps)).cos())
            }
            Self::Formula(Formula::Exponential, start, decay, floor) => (start * decay.powf(step)).max(floor),
            Self::Formula(Formula::Sinusoidal, low, high, period) => {
                0.5 * (high + low) + 0.5 * (high - low) * (TAU * step / period.max(1.0)).sin()
            }
        }
    }

    /// Returns whether all values lie within these bounds.
    fn stays_within(&self, low: f64, high: f64) -> bool {
        let allowed = |value: f64| (low..=high).contains(&value);
        match *self {
            Self::Constant(value) => allowed(value),
            Self::Steps(ref values) => !values.is_empty() && values.iter().all(|&value| allowed(value)),
            Self::Formula(Formula::Exponential, start, decay, floor) => {
                allowed(start) && allowed(floor) && (0.0..=1.0).contains(&decay)
            }
            Self::Formula(_, a, b, steps) => allowed(a) && allowed(b) && steps > 0.0 && steps.is_finite(),
        }
    }
}

/// The value of a [`Domain::Range`] or [`Domain::Spread`].
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(untagged)]
pub(super) enum Ends {
    One(f64),
    Two([f64; 2]),
}

impl Ends {
    /// Returns the range; a single number is both its ends.
    pub fn range(self) -> [f64; 2] {
        match self {
            Self::One(value) => [value; 2],
            Self::Two(ends) => ends,
        }
    }

    /// Returns the range; a single number is its half-width around `center`, but the range does not go below `low`.
    pub fn around(self, center: f64, low: f64) -> [f64; 2] {
        match self {
            Self::One(value) => [(center - value).max(low), center + value],
            Self::Two(ends) => ends,
        }
    }
}

/// The value of a [`Domain::Color`].
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(untagged)]
pub(super) enum Color {
    Grey(u8),
    Rgb([u8; 3]),
}

impl Color {
    pub fn rgb(self) -> [u8; 3] {
        match self {
            Self::Grey(value) => [value; 3],
            Self::Rgb(color) => color,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn schedules_follow_their_formulas() {
        let at = |json: &str, steps: [u64; 4]| {
            let schedule: Schedule = serde_json::from_str(json).expect("parsing a schedule");
            steps.map(|step| (schedule.at(step) * 1e6).round() / 1e6)
        };
        // Values of the functions of the reference with these names.
        assert_eq!(at("7", [0, 1, 50, 1000]), [7.0; 4]);
        assert_eq!(at(r#"["linear", 2, 12, 10]"#, [0, 5, 10, 99]), [2.0, 7.0, 12.0, 12.0]);
        assert_eq!(at(r#"["cosine", 2, 12, 10]"#, [0, 2, 5, 99]), [2.0, 2.954915, 7.0, 12.0]);
        assert_eq!(at(r#"["exponential", 8, 0.5, 1]"#, [0, 1, 3, 9]), [8.0, 4.0, 1.0, 1.0]);
        assert_eq!(at(r#"["sinusoidal", 2, 12, 8]"#, [0, 1, 2, 6]), [7.0, 10.535534, 12.0, 2.0]);
        assert_eq!(at("[3, 1, 4]", [0, 1, 2, 99]), [3.0, 1.0, 4.0, 4.0]);
    }
}
