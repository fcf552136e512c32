//! Factors of variation: named properties that may differ between two episodes of one environment.
//!
//! A [`VariationSpace`] lists the factors of an environment, each with its space and default. A [`VariationRequest`]
//! names the factors to sample (`"agent.color"`, a group such as `"agent"`, or `"all"`) and the values to pin.
//! [`VariationSpace::resolve`] turns a request and a key into [`FactorValues`], constant over the episode. Every factor
//! draws from its own stream, so varying one factor never changes the sample of another factor.

use crate::{Error, Key, Result, Space};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::sync::Arc;

/// One factor of variation.
#[derive(Clone, Debug, Serialize)]
pub struct Factor {
    /// The factor's key, such as `agent.color`.
    #[serde(skip)]
    pub key: String,
    /// The possible values.
    #[serde(flatten)]
    pub space: Space,
    /// The factor's default: its value unless the factor is sampled or pinned.
    pub init_value: Vec<f64>,
}

impl Factor {
    /// A factor with a key, a space and a default.
    pub fn new(key: &str, space: Space, init_value: impl Into<Vec<f64>>) -> Self {
        Self { key: key.to_owned(), space, init_value: init_value.into() }
    }
}

/// A condition on a factor's value, given the factors sampled before it.
#[derive(Clone)]
struct Constraint {
    factor: usize,
    description: &'static str,
    holds: fn(&FactorValues) -> bool,
}

/// All factors of an environment, in sampling order.
#[derive(Clone)]
pub struct VariationSpace {
    factors: Arc<[Factor]>,
    constraints: Vec<Constraint>,
    /// Keys of the factors sampled by default.
    defaults: Vec<String>,
}

/// The number of rejected samples of a constrained factor after which [`VariationSpace::resolve`] fails.
const TRIES: usize = 10_000;

impl VariationSpace {
    /// A space of these factors, sampled in this order; `defaults` are sampled unless a request names other factors.
    ///
    /// # Panics
    /// When a default value is outside its own space or a default key does not exist, which is a bug of the
    /// environment.
    pub fn new(factors: Vec<Factor>, defaults: &[&str]) -> Self {
        for factor in &factors {
            if let Err(error) = factor.space.check(&factor.key, &factor.init_value) {
                panic!("default value: {error}");
            }
        }
        let space = Self {
            factors: factors.into(),
            constraints: vec![],
            defaults: defaults.iter().map(|&key| key.to_owned()).collect(),
        };
        for key in &space.defaults {
            assert!(space.find(key).is_some(), "default variation '{key}' is not a factor");
        }
        space
    }

    /// Adds a constraint: `factor` is sampled again until `holds` returns true. `holds` may read the value of
    /// `factor`, the values of factors earlier in the sampling order, and pinned values. `description` states the
    /// constraint in errors.
    ///
    /// # Panics
    /// When there is no such factor.
    #[must_use]
    pub fn constrain(mut self, factor: &str, description: &'static str, holds: fn(&FactorValues) -> bool) -> Self {
        let factor = self.find(factor).unwrap_or_else(|| panic!("constraint on '{factor}', which is not a factor"));
        self.constraints.push(Constraint { factor, description, holds });
        self
    }

    /// The factors, in sampling order.
    pub fn factors(&self) -> &[Factor] {
        &self.factors
    }

    /// Keys of the factors sampled by default.
    pub fn defaults(&self) -> &[String] {
        &self.defaults
    }

    /// The index of a factor.
    pub fn find(&self, key: &str) -> Option<usize> {
        self.factors.iter().position(|factor| factor.key == key)
    }

    /// The indices of all factors that a key names: one factor, a group, or all factors.
    ///
    /// # Errors
    /// When the key names no factor.
    pub fn select(&self, key: &str) -> Result<Vec<usize>> {
        let group = format!("{key}.");
        let chosen: Vec<usize> = (0..self.factors.len())
            .filter(|&i| key == "all" || self.factors[i].key == key || self.factors[i].key.starts_with(&group))
            .collect();
        if chosen.is_empty() {
            let mut known: Vec<&str> = vec!["all"];
            for factor in self.factors.iter() {
                known.push(&factor.key);
                if let Some((group, _)) = factor.key.split_once('.')
                    && !known.contains(&group)
                {
                    known.push(group);
                }
            }
            return Err(Error::unknown("factor of variation", key, known, "`swm fovs ENV` lists them"));
        }
        Ok(chosen)
    }

    /// Checks the keys and the pinned values of a request, so that errors are found before any episode is played.
    ///
    /// # Errors
    /// When a key is unknown, or a pinned value is out of bounds. Constraints depend on the episode:
    /// [`VariationSpace::resolve`] checks them.
    pub fn check(&self, request: &VariationRequest) -> Result<()> {
        for name in request.variation.iter().flatten() {
            self.select(name)?;
        }
        request.variation_values.iter().try_for_each(|(name, value)| self.pinned(name, value).map(|_| ()))
    }

    /// Returns the index of a pinned factor whose value is within bounds.
    fn pinned(&self, name: &str, value: &[f64]) -> Result<usize> {
        let Some(i) = self.find(name) else {
            let known = self.factors.iter().map(|f| f.key.as_str());
            return Err(Error::unknown("factor of variation", name, known, "`swm fovs ENV` lists them"));
        };
        self.factors[i].space.check(name, value)?;
        Ok(i)
    }

    /// The factor values of an episode. A pinned factor has its pinned value, a varied factor a sample, any other
    /// factor its default.
    ///
    /// # Errors
    /// When a key is unknown, a pinned value is out of bounds or violates a constraint, or no sample satisfies a
    /// constraint.
    pub fn resolve(&self, request: &VariationRequest, key: Key) -> Result<FactorValues> {
        let mut varied = vec![false; self.factors.len()];
        for name in request.variation.as_ref().unwrap_or(&self.defaults) {
            for i in self.select(name)? {
                varied[i] = true;
            }
        }
        let mut values = FactorValues {
            factors: Arc::clone(&self.factors),
            values: self.factors.iter().map(|factor| factor.init_value.clone()).collect(),
        };
        let mut pinned = vec![false; self.factors.len()];
        for (name, value) in &request.variation_values {
            let i = self.pinned(name, value)?;
            values.values[i] = value.iter().map(|&v| self.factors[i].space.round(v)).collect();
            (pinned[i], varied[i]) = (true, false);
        }
        for (i, factor) in self.factors.iter().enumerate() {
            let constraints = || self.constraints.iter().filter(move |c| c.factor == i);
            if !varied[i] {
                continue;
            }
            let mut rng = key.with("factor").with(&factor.key).rng();
            let mut tries = 0;
            loop {
                values.values[i] = factor.space.sample(&mut rng);
                let Some(broken) = constraints().find(|c| !(c.holds)(&values)) else { break };
                tries += 1;
                if tries == TRIES {
                    return Err(Error::Unsatisfiable {
                        factor: factor.key.clone(),
                        constraint: broken.description.to_owned(),
                        tries,
                    });
                }
            }
        }
        // Pinned values must satisfy their constraints given the final values; defaults are not checked.
        for constraint in &self.constraints {
            if pinned[constraint.factor] && !(constraint.holds)(&values) {
                let factor = &self.factors[constraint.factor];
                return Err(Error::OutOfSpace {
                    what: factor.key.clone(),
                    given: format!("{:?}", values.values[constraint.factor]),
                    expected: format!("a value with which {}", constraint.description),
                });
            }
        }
        Ok(values)
    }
}

/// The factors to sample and to pin at a reset.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct VariationRequest {
    /// Keys to sample: factors, groups, or `all`. `None` means the environment's defaults.
    #[serde(default)]
    pub variation: Option<Vec<String>>,
    /// Values of pinned factors, by key.
    #[serde(default)]
    pub variation_values: BTreeMap<String, Vec<f64>>,
}

/// The value of every factor, constant over an episode.
#[derive(Clone, Debug)]
pub struct FactorValues {
    factors: Arc<[Factor]>,
    values: Vec<Vec<f64>>,
}

impl FactorValues {
    /// The factors, in sampling order.
    pub fn factors(&self) -> &[Factor] {
        &self.factors
    }

    /// The value of a factor.
    ///
    /// # Panics
    /// When the environment did not declare the factor.
    pub fn get(&self, key: &str) -> &[f64] {
        let i = self.factors.iter().position(|factor| factor.key == key);
        &self.values[i.unwrap_or_else(|| panic!("'{key}' is not a factor"))]
    }

    /// The value of a scalar factor.
    ///
    /// # Panics
    /// As [`FactorValues::get`].
    pub fn scalar(&self, key: &str) -> f64 {
        self.get(key)[0]
    }

    /// The value of an integer factor.
    ///
    /// # Panics
    /// As [`FactorValues::get`].
    pub fn integer(&self, key: &str) -> i64 {
        self.scalar(key) as i64
    }

    /// The value of a colour factor.
    ///
    /// # Panics
    /// As [`FactorValues::get`].
    pub fn rgb(&self, key: &str) -> [u8; 3] {
        let value = self.get(key);
        [value[0] as u8, value[1] as u8, value[2] as u8]
    }

    /// Keys and values, in sampling order.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &[f64])> {
        self.factors.iter().map(|f| f.key.as_str()).zip(self.values.iter().map(Vec::as_slice))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::DType;

    fn space() -> VariationSpace {
        VariationSpace::new(
            vec![
                Factor::new("agent.x", Space::uniform_box([], DType::Float32, 0.0, 1.0), [0.25]),
                Factor::new("agent.color", Space::Rgb, [255.0, 0.0, 0.0]),
                Factor::new("target.x", Space::uniform_box([], DType::Float32, 0.0, 1.0), [0.75]),
            ],
            &["agent.x"],
        )
        .constrain("target.x", "target.x > agent.x", |v| v.scalar("target.x") > v.scalar("agent.x"))
    }

    fn request(keys: &[&str]) -> VariationRequest {
        VariationRequest {
            variation: Some(keys.iter().map(|&k| k.to_owned()).collect()),
            ..VariationRequest::default()
        }
    }

    #[test]
    fn varying_one_factor_leaves_other_factors_unchanged() {
        let space = space();
        let key = Key::new(5);
        let none = space.resolve(&request(&[]), key).expect("resolving a request with no varied factor");
        assert_eq!(none.get("agent.color"), [255.0, 0.0, 0.0]);
        let one = space.resolve(&request(&["agent.color"]), key).expect("resolving a request with one varied factor");
        let group = space.resolve(&request(&["agent"]), key).expect("resolving a request with a varied group");
        assert_eq!(one.get("agent.color"), group.get("agent.color"));
        assert_eq!(one.get("agent.x"), [0.25]);
        assert_ne!(group.get("agent.x"), [0.25]);
        for seed in 0..100 {
            let all =
                space.resolve(&request(&["all"]), Key::new(seed)).expect("resolving a request with all factors varied");
            assert!(all.scalar("target.x") > all.scalar("agent.x"));
        }
    }

    #[test]
    fn invalid_variation_requests_are_errors() {
        let space = space();
        let pin = |key: &str, value: &[f64]| VariationRequest {
            variation: None,
            variation_values: [(key.to_owned(), value.to_vec())].into(),
        };
        let message = |r: &VariationRequest| space.resolve(r, Key::new(0)).expect_err("an invalid request").to_string();
        assert!(message(&request(&["agent.colour"])).contains("did you mean agent.color"));
        assert!(message(&pin("agent.x", &[2.0])).contains("0 ..= 1"));
        assert!(message(&pin("agent.y", &[0.5])).contains("agent.x"));
        assert!(message(&pin("target.x", &[0.0])).contains("target.x > agent.x"));
        let impossible = VariationRequest {
            variation: Some(vec!["target.x".to_owned()]),
            variation_values: [("agent.x".to_owned(), vec![1.0])].into(),
        };
        assert!(message(&impossible).contains("in 10000 tries"));
    }
}
