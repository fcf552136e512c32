//! [`PolicyChoice`]: the policies of a collection. [`MixturePolicy`]: the policy that plays them.

use rand::Rng as _;
use serde::{Deserialize, Serialize};
use swm_core::run::Interrupt;
use swm_core::{Batch, EnvPool, Error, Key, Policy, Result};

/// The policies of a collection: one, or a mixture from which every episode draws one.
///
/// A manifest stores one policy as its name, and a mixture as a list of names and weights.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged, try_from = "Stored")]
pub enum PolicyChoice {
    /// One policy, by its name.
    One(String),
    /// At least two policies. A dataset stores the index of an episode's policy in this list.
    Mixture(Vec<WeightedPolicy>),
}

/// A policy of a mixture.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WeightedPolicy {
    /// The name of the policy.
    pub name: String,
    /// The weight: a policy plays a share of the episodes that is its weight divided by the sum of all weights.
    pub weight: f64,
}

/// The form of a choice in JSON, before it is checked.
#[derive(Deserialize)]
#[serde(untagged)]
enum Stored {
    One(String),
    Mixture(Vec<WeightedPolicy>),
}

impl TryFrom<Stored> for PolicyChoice {
    type Error = Error;

    fn try_from(stored: Stored) -> Result<Self> {
        match stored {
            Stored::One(name) => Ok(Self::One(name)),
            Stored::Mixture(policies) => Self::new(policies),
        }
    }
}

impl Default for PolicyChoice {
    fn default() -> Self {
        Self::One(String::new())
    }
}

impl From<&str> for PolicyChoice {
    fn from(name: &str) -> Self {
        Self::One(name.to_owned())
    }
}

impl PolicyChoice {
    /// Makes the choice of these policies.
    ///
    /// # Errors
    /// When there is no policy, or a weight or the sum of all weights is not positive and finite.
    pub fn new(mut policies: Vec<WeightedPolicy>) -> Result<Self> {
        if let Some(WeightedPolicy { name, weight }) =
            policies.iter().find(|policy| !(policy.weight > 0.0 && policy.weight.is_finite()))
        {
            return Err(Error::config(
                format!("the weight of the policy '{name}'"),
                weight.to_string(),
                "give a positive weight, such as expert:0.7",
            ));
        }
        if !policies.iter().map(|policy| policy.weight).sum::<f64>().is_finite() {
            return Err(Error::config("the weights of the policies", "their sum is infinite", "give smaller ones"));
        }
        match policies.len() {
            0 => Err(Error::config("policies", "none is given", "name at least one policy")),
            1 => Ok(Self::One(policies.remove(0).name)),
            _ => Ok(Self::Mixture(policies)),
        }
    }

    /// Parses policies of the form `NAME` or `NAME:WEIGHT`. The weight is 1 if none is given.
    ///
    /// # Errors
    /// As [`PolicyChoice::new`].
    pub fn parse(texts: &[String]) -> Result<Self> {
        let parsed = texts.iter().map(|text| {
            let parts = text.rsplit_once(':').and_then(|(name, weight)| Some((name, weight.parse().ok()?)));
            let (name, weight) = parts.unwrap_or((text, 1.0));
            WeightedPolicy { name: name.to_owned(), weight }
        });
        Self::new(parsed.collect())
    }

    /// The names of the policies.
    pub fn names(&self) -> Vec<&str> {
        match self {
            Self::One(name) => vec![name],
            Self::Mixture(policies) => policies.iter().map(|policy| policy.name.as_str()).collect(),
        }
    }

    /// Whether an episode draws its policy.
    pub fn is_mixture(&self) -> bool {
        matches!(self, Self::Mixture(_))
    }

    /// The index of the policy that plays the episode with this key.
    pub fn draw(&self, key: Key) -> usize {
        let Self::Mixture(policies) = self else { return 0 };
        let total: f64 = policies.iter().map(|policy| policy.weight).sum();
        let mut rest = total * key.with("policy of the episode").rng().random::<f64>();
        let drawn = policies.iter().position(|policy| {
            rest -= policy.weight;
            rest < 0.0
        });
        drawn.unwrap_or(policies.len() - 1)
    }
}

/// Plays every episode with the policy that a [`PolicyChoice`] draws for it.
pub struct MixturePolicy {
    choice: PolicyChoice,
    /// The policies, in the order of the choice.
    policies: Vec<Box<dyn Policy>>,
    /// The index of the policy of every slot.
    drawn: Vec<usize>,
    /// The active slots of one policy.
    slots: Vec<bool>,
}

impl MixturePolicy {
    /// The policy of a choice for `slots` environments; `policies` are in the order of the choice.
    ///
    /// # Panics
    /// When the number of policies differs from that of the choice.
    pub fn new(choice: PolicyChoice, policies: Vec<Box<dyn Policy>>, slots: usize) -> Self {
        assert_eq!(choice.names().len(), policies.len(), "every policy of the choice");
        Self { choice, policies, drawn: vec![0; slots], slots: vec![false; slots] }
    }

    /// Calls every policy that plays active slots, with these slots.
    fn each(&mut self, active: &[bool], mut call: impl FnMut(&mut dyn Policy, &[bool]) -> Result<()>) -> Result<()> {
        for (index, policy) in self.policies.iter_mut().enumerate() {
            let playing = active.iter().zip(&self.drawn).map(|(&active, &drawn)| active && drawn == index);
            self.slots.iter_mut().zip(playing).for_each(|(slot, playing)| *slot = playing);
            if self.slots.contains(&true) {
                call(&mut **policy, &self.slots)?;
            }
        }
        Ok(())
    }
}

impl Policy for MixturePolicy {
    fn begin(&mut self, slot: usize, key: Key) {
        let drawn = self.choice.draw(key);
        self.drawn[slot] = drawn;
        self.policies[drawn].begin(slot, key);
    }

    fn act(&mut self, infos: &Batch, active: &[bool], actions: &mut Batch) -> Result<()> {
        self.each(active, |policy, slots| policy.act(infos, slots, actions))
    }

    fn act_until(
        &mut self,
        infos: &Batch,
        active: &[bool],
        actions: &mut Batch,
        interrupt: &dyn Interrupt,
    ) -> Result<()> {
        self.each(active, |policy, slots| policy.act_until(infos, slots, actions, interrupt))
    }

    fn observe_envs(&mut self, envs: &EnvPool, active: &[bool]) -> Result<()> {
        self.each(active, |policy, slots| policy.observe_envs(envs, slots))
    }

    fn uses_threads(&self) -> bool {
        self.policies.iter().any(|policy| policy.uses_threads())
    }

    fn take_latencies(&mut self) -> Vec<f64> {
        self.policies.iter_mut().flat_map(|policy| policy.take_latencies()).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parsed(texts: &[&str]) -> Result<PolicyChoice> {
        PolicyChoice::parse(&texts.iter().map(|&text| text.to_owned()).collect::<Vec<_>>())
    }

    #[test]
    fn policies_are_parsed_with_their_weights() {
        assert_eq!(parsed(&["expert:0.7"]).expect("one policy"), PolicyChoice::from("expert"));
        let mixture = parsed(&["expert:3", "runs/a:b", "random"]).expect("a mixture");
        assert_eq!(mixture.names(), ["expert", "runs/a:b", "random"]);
        let text = serde_json::to_string(&mixture).expect("writing the mixture");
        assert!(text.starts_with(r#"[{"name":"expert","weight":3.0},{"name":"runs/a:b","weight":1.0}"#), "{text}");
        assert_eq!(serde_json::from_str::<PolicyChoice>(&text).expect("reading the mixture"), mixture);
        for weight in ["0", "-1", "nan", "inf"] {
            let error =
                parsed(&["expert", &format!("random:{weight}")]).expect_err("the weight is invalid").to_string();
            assert!(error.contains("'random'") && error.contains("positive"), "{error}");
        }
        let error = parsed(&["expert:1e308", "random:1e308"]).expect_err("the sum is infinite").to_string();
        assert!(error.contains("sum"), "{error}");
        assert!(parsed(&[]).is_err());
        let one =
            serde_json::from_str::<PolicyChoice>(r#"[{"name":"expert","weight":2}]"#).expect("reading one policy");
        assert_eq!(one, PolicyChoice::from("expert"));
        assert!(serde_json::from_str::<PolicyChoice>(r#"[{"name":"expert","weight":-2}]"#).is_err());
    }

    #[test]
    fn episodes_draw_policies_in_proportion_to_the_weights() {
        let mixture = parsed(&["a:1", "b:2", "c:1"]).expect("a mixture");
        let mut counts = [0; 3];
        (0..4000).for_each(|episode| counts[mixture.draw(Key::new(1).at(episode))] += 1);
        assert!(
            counts.iter().zip([1000, 2000, 1000]).all(|(&n, wanted)| (n as i64 - wanted).abs() < 120),
            "{counts:?}"
        );
    }
}
