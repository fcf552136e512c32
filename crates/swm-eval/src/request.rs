//! [`EvalRequest`]: everything that decides what an evaluation finds, as it is written into its manifest and read
//! again to reproduce it. It names things (a world, a dataset, a checkpoint); a [`Resolver`](crate::Resolver) knows them.

use serde::{Deserialize, Serialize};
use serde_json::Value;
use swm_core::results::Counting;
use swm_core::{Error, Manifest, Result, VariationRequest};
use swm_data::{Part, Split};

/// An evaluation: who acts, in which world, from which starts, and how it is counted.
///
/// What does not change a result (threads, environments played side by side in strict counting, videos) is not in it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EvalRequest {
    /// The layout of this request: [`EvalRequest::VERSION`].
    pub version: u32,
    /// The environment's id.
    pub env: String,
    /// What is done to its pictures, in order.
    pub wrappers: Vec<Choice>,
    /// Whether the picture of the goal passes through the wrappers, too.
    #[serde(default)]
    pub wrap_goal: bool,
    /// The `[height, width]` of its pictures, if any are drawn.
    pub image: Option<[usize; 2]>,
    /// Who acts. The random floor is played whether it is among them or not.
    pub policies: Vec<PolicyRequest>,
    /// From where and towards which goals.
    pub starts: StartsRequest,
    /// How many episodes.
    pub episodes: usize,
    /// Decides starts, goals, factors, and everything a policy draws.
    pub seed: u64,
    /// Steps an episode may take; the environment's own number for `None`.
    pub budget: Option<usize>,
    /// Which episodes count, and as what.
    pub counting: Counting,
    /// What is varied, one evaluation each.
    pub conditions: Vec<Condition>,
    /// How many model steps far the models' predictions are compared with the recorded trajectories that the starts were
    /// taken from, if they are.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub prediction: Option<usize>,
}

/// A named thing with settings: a solver, a wrapper.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Choice {
    /// Its id in its registry.
    pub id: String,
    /// Its settings, as the row of the registry reads them.
    #[serde(default)]
    pub settings: Value,
}

/// Where starts and goals come from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum StartsRequest {
    /// The environment draws them.
    Episodic,
    /// Rows of a dataset.
    Dataset {
        /// Its name or path.
        dataset: String,
        /// Steps from a start to its goal.
        goal_offset: usize,
        /// The held-out part whose episodes are used; all of them for `None`.
        held_out: Option<HeldOut>,
    },
}

/// A part of a split.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HeldOut {
    /// The part.
    pub part: Part,
    /// How the dataset is split.
    pub split: Split,
}

/// Who acts.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PolicyRequest {
    /// What results call it.
    pub name: String,
    /// How it acts.
    pub acts: Acts,
}

/// How a policy acts.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Acts {
    /// Uniformly at random: the floor.
    Random,
    /// As one of the environment's experts.
    Expert {
        /// Its id.
        id: String,
    },
    /// By planning in a model.
    Plan {
        /// What predicts.
        model: Model,
        /// What searches.
        solver: Choice,
        /// The settings of the policy that replans.
        mpc: Value,
        /// The objective, where it is not the model's own.
        #[serde(default, skip_serializing_if = "Value::is_null")]
        objective: Value,
    },
    /// As a trained policy says, without planning.
    Direct {
        /// The checkpoint's name or path.
        checkpoint: String,
        /// Its settings.
        #[serde(default, skip_serializing_if = "Value::is_null")]
        settings: Value,
    },
}

/// What predicts.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Model {
    /// A trained world model: its name or path.
    Checkpoint(String),
    /// The world itself, restored and stepped: an upper bound for every model.
    Simulator {
        /// What it judges a plan by, by the name the planner knows it by.
        score: String,
    },
}

/// What is varied, under a name.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Condition {
    /// Its name in results: `in distribution`, or what is shifted.
    pub name: String,
    /// Factors that are sampled and pinned.
    pub variation: VariationRequest,
}

impl EvalRequest {
    /// The layout this version writes and reads.
    pub const VERSION: u32 = 1;

    /// The protocol's name: `episodic` or `dataset`.
    pub fn protocol(&self) -> &'static str {
        match self.starts {
            StartsRequest::Episodic => "episodic",
            StartsRequest::Dataset { .. } => "dataset",
        }
    }

    /// The request behind some results.
    ///
    /// # Errors
    /// When the manifest is of something else, or holds no request of this layout.
    pub fn of(manifest: &Manifest) -> Result<Self> {
        let again = "evaluate again with this version (`swm eval`)";
        let refuse = |problem: String| Error::config("the results' manifest", problem, again);
        if manifest.kind != "evaluate" {
            return Err(refuse(format!("it tells of '{}', not of an evaluation", manifest.kind)));
        }
        match manifest.config.get("version").map(Value::as_u64) {
            Some(Some(version)) if version == u64::from(Self::VERSION) => {
                Self::deserialize(&manifest.config).map_err(|error| refuse(format!("its request is damaged ({error})")))
            }
            Some(version) => {
                let theirs = version.map_or("?".to_owned(), |version| version.to_string());
                Err(refuse(format!("its request has layout {theirs}, this version reads {}", Self::VERSION)))
            }
            None => Err(refuse("it was written before requests were kept, and cannot be run from".to_owned())),
        }
    }

    /// Checks what can be checked before anything is opened.
    ///
    /// # Errors
    /// When there is no condition, two policies or conditions share a name, or predictions are to be compared with nothing.
    pub fn check(&self) -> Result<()> {
        if self.conditions.is_empty() {
            return Err(Error::config("conditions of an evaluation", "there is none", "name at least one"));
        }
        if self.prediction.is_some() && self.starts == StartsRequest::Episodic {
            return Err(Error::config(
                "prediction errors",
                "they are those of recorded trajectories, and the environment draws the starts",
                "take starts from a dataset",
            ));
        }
        unique("policy", self.policies.iter().map(|policy| policy.name.as_str()))?;
        unique("condition", self.conditions.iter().map(|condition| condition.name.as_str()))
    }
}

fn unique<'a>(what: &str, names: impl Iterator<Item = &'a str>) -> Result<()> {
    let mut seen = vec![];
    for name in names {
        if seen.contains(&name) {
            return Err(Error::config(
                format!("{what} '{name}'"),
                "the name stands for two",
                "give each a name of its own, results go by it",
            ));
        }
        seen.push(name);
    }
    Ok(())
}
