//! [`EvalRequest`]: all settings that determine the results of an evaluation.
//!
//! The request is written to the manifest of the results and read again to reproduce them. It refers to environments,
//! datasets and checkpoints by name; a [`Resolver`](crate::Resolver) loads them.

use serde::{Deserialize, Serialize};
use serde_json::Value;
use swm_core::results::Counting;
use swm_core::{Error, Manifest, Result, VariationRequest, limits};
use swm_data::{Part, Split};

/// An evaluation: policies, environment, starts, and counting.
///
/// Options that do not change a result (threads, parallel environments in strict counting, videos) are in
/// [`RunOptions`](crate::RunOptions).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EvalRequest {
    /// The version of this layout: [`EvalRequest::VERSION`].
    pub version: u32,
    /// The environment's id.
    pub env: String,
    /// The visual wrappers of the environment's frames, in order.
    pub wrappers: Vec<Choice>,
    /// Whether the wrappers apply to the frame of the goal, too.
    #[serde(default)]
    pub wrap_goal: bool,
    /// The `[height, width]` of frames, in pixels; `None` for no frames.
    pub image: Option<[usize; 2]>,
    /// The policies. The random-policy floor is always evaluated, even if it is not listed.
    pub policies: Vec<PolicyRequest>,
    /// The origin of starts and goals.
    pub starts: StartsRequest,
    /// The number of episodes.
    pub episodes: usize,
    /// The seed of starts, goals, factors, and all draws of policies.
    pub seed: u64,
    /// The time limit of an episode, in steps; `None` for the environment's time limit.
    pub budget: Option<usize>,
    /// The episodes that count, and the success criterion.
    pub counting: Counting,
    /// The conditions, one evaluation each.
    pub conditions: Vec<Condition>,
    /// The horizon, in model steps, of prediction errors on the recorded trajectories that the starts are taken from;
    /// `None` to omit prediction errors.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub prediction: Option<usize>,
    /// Repeats the draws of policies with another stream, from the same starts; `None` for the stream of the seed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub planning_seed: Option<u64>,
}

/// The longest side of a frame, in pixels.
pub const MAX_SIDE: usize = limits::IMAGE_SIDE.max;

/// A solver or a wrapper, with settings.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Choice {
    /// The id in the registry.
    pub id: String,
    /// The settings, in the format of the registry entry.
    #[serde(default)]
    pub settings: Value,
}

/// The origin of starts and goals.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum StartsRequest {
    /// The environment draws starts and goals.
    Episodic,
    /// Rows of a dataset.
    Dataset {
        /// The name or path of the dataset.
        dataset: String,
        /// Steps from a start to its goal.
        goal_offset: usize,
        /// The held-out part whose episodes are used; all episodes for `None`.
        held_out: Option<HeldOut>,
        /// Whether no two starts come from one recorded episode, so that their outcomes are independent.
        #[serde(default, skip_serializing_if = "std::ops::Not::not")]
        one_per_episode: bool,
    },
}

/// A part of a dataset split.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HeldOut {
    /// The part.
    pub part: Part,
    /// The split.
    pub split: Split,
}

/// A policy.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PolicyRequest {
    /// The name in results.
    pub name: String,
    /// The kind of policy.
    #[serde(rename = "acts")]
    pub kind: PolicyKind,
}

/// The kind of a policy.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum PolicyKind {
    /// Uniformly random actions: the floor.
    Random,
    /// No action: zero, or the bound nearest to zero.
    NoOp,
    /// The recorded actions that follow the rows of the starts.
    Replay,
    /// The recorded actions that follow the rows nearest to the present and the goal, of other episodes than those of the
    /// starts.
    Nearest,
    /// An expert of the environment.
    Expert {
        /// The id of the expert.
        id: String,
    },
    /// Planning in a model.
    Plan {
        /// The model.
        model: Model,
        /// The solver.
        solver: Choice,
        /// The settings of model-predictive control.
        mpc: Value,
        /// The objective, if it differs from the model's own cost.
        #[serde(default, skip_serializing_if = "Value::is_null")]
        objective: Value,
    },
    /// A trained policy, without planning.
    Direct {
        /// The checkpoint's name or path.
        checkpoint: String,
        /// The settings of the policy.
        #[serde(default, skip_serializing_if = "Value::is_null")]
        settings: Value,
    },
}

/// A model to plan in.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Model {
    /// A trained world model: its name or path.
    Checkpoint(String),
    /// The environment, restored and stepped in place of a model: an upper bound for every model.
    Simulator {
        /// The name of the score of a plan, as the simulator model defines it.
        score: String,
    },
    /// The environment, restored and stepped in place of the dynamics of a trained world model. All else, such as the scale of
    /// actions, is that of the world model.
    TrueDynamics {
        /// The world model: its name or path.
        checkpoint: String,
        /// The cost of a plan.
        cost: EndCost,
    },
    /// A trained world model whose plans are judged by the state that a probe reads from the last latent, instead of by the
    /// distance of latents.
    Probe {
        /// The world model: its name or path.
        checkpoint: String,
        /// The dataset that the probe is fitted on.
        dataset: String,
        /// The columns that it reads.
        columns: Vec<String>,
        /// Whether plans are played in the environment, and the model encodes what they lead to, instead of predicting it.
        true_dynamics: bool,
    },
}

/// The cost of a plan that is simulated in the environment.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EndCost {
    /// The squared distance of the world model's latent of the last observation from that of the goal.
    Latent,
    /// The environment's distance to the goal by its success criterion.
    Success,
}

impl Model {
    /// The name or path of the trained world model; `None` for the environment alone.
    pub fn checkpoint(&self) -> Option<&str> {
        match self {
            Self::Checkpoint(checkpoint) | Self::TrueDynamics { checkpoint, .. } | Self::Probe { checkpoint, .. } => {
                Some(checkpoint)
            }
            Self::Simulator { .. } => None,
        }
    }
}

impl PolicyKind {
    /// The dataset that a probe of the policy is fitted on, if it has one.
    pub fn probe_dataset(&self) -> Option<&str> {
        match self {
            Self::Plan { model: Model::Probe { dataset, .. }, .. } => Some(dataset),
            _ => None,
        }
    }

    /// The name or path of the checkpoint that the policy uses, if it uses one.
    pub fn checkpoint(&self) -> Option<&str> {
        match self {
            Self::Plan { model, .. } => model.checkpoint(),
            Self::Direct { checkpoint, .. } => Some(checkpoint),
            _ => None,
        }
    }
}

/// A named condition.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Condition {
    /// The name in results: `in distribution`, or a description of the shift.
    pub name: String,
    /// The factors that are sampled and pinned.
    pub variation: VariationRequest,
}

impl Condition {
    /// The name of the condition without any shift.
    pub const IN_DISTRIBUTION: &str = "in distribution";
}

impl EvalRequest {
    /// The layout that this version writes and reads.
    pub const VERSION: u32 = 1;

    /// The name of the protocol: `episodic` or `dataset`.
    pub fn protocol(&self) -> &'static str {
        match self.starts {
            StartsRequest::Episodic => "episodic",
            StartsRequest::Dataset { .. } => "dataset",
        }
    }

    /// This request with at most one start from each recorded episode, as evaluations need whose results end them. Starts that the
    /// environment draws stay as they are.
    #[must_use]
    pub fn with_one_start_per_episode(mut self) -> Self {
        if let StartsRequest::Dataset { one_per_episode, .. } = &mut self.starts {
            *one_per_episode = true;
        }
        self
    }

    /// Whether several starts may come from one recorded episode.
    pub(crate) fn may_repeat_episodes(&self) -> bool {
        matches!(self.starts, StartsRequest::Dataset { one_per_episode: false, .. })
    }

    /// Reads the request from the manifest of evaluation results.
    ///
    /// # Errors
    /// When the manifest is not an evaluation's manifest, or contains no request of this layout.
    pub fn of(manifest: &Manifest) -> Result<Self> {
        let again = "evaluate again with this version (`swm eval`)";
        let invalid = |problem: String| Error::config("the results' manifest", problem, again);
        if manifest.kind != "evaluate" {
            return Err(invalid(format!("its kind is '{}', expected 'evaluate'", manifest.kind)));
        }
        match manifest.config.get("version").map(Value::as_u64) {
            Some(Some(version)) if version == u64::from(Self::VERSION) => Self::deserialize(&manifest.config)
                .map_err(|error| invalid(format!("its request is damaged ({error})"))),
            Some(version) => {
                let given = version.map_or("?".to_owned(), |version| version.to_string());
                Err(invalid(format!("its request has layout {given}; this version reads {}", Self::VERSION)))
            }
            None if manifest.config.get("front").and_then(Value::as_str) == Some("python") => Err(Error::config(
                "the results' manifest",
                "a program in Python made them with World.evaluate, whose policies and environments this program cannot play",
                "run that program again, or evaluate with `swm eval`",
            )),
            None => Err(invalid("it contains no request, because an older version wrote it".to_owned())),
        }
    }

    /// Checks the request before anything is loaded.
    ///
    /// # Errors
    /// When there is no condition, two policies or conditions share a name, frames are larger than [`MAX_SIDE`], or
    /// prediction errors are requested without a dataset.
    pub fn check(&self) -> Result<()> {
        limits::EVALUATED_EPISODES.check(self.episodes)?;
        limits::STEPS.check(self.budget.unwrap_or_default())?;
        limits::MODEL_STEPS.check(self.prediction.unwrap_or_default())?;
        if let StartsRequest::Dataset { goal_offset, .. } = self.starts {
            limits::STEPS.check(goal_offset)?;
        }
        if self.conditions.is_empty() {
            return Err(Error::config("conditions of an evaluation", "the list is empty", "name at least one"));
        }
        if self.prediction.is_some() && self.starts == StartsRequest::Episodic {
            return Err(Error::config(
                "prediction errors",
                "they require recorded trajectories, and the environment draws the starts",
                "take starts from a dataset",
            ));
        }
        if let Some([height, width]) =
            self.image.filter(|sides| sides.iter().any(|side| !(1..=MAX_SIDE).contains(side)))
        {
            let problem = format!("{height} x {width} pixels");
            return Err(Error::config("frame size of an evaluation", problem, format!("choose 1 to {MAX_SIDE}")));
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
                "the name is used twice",
                "give each a different name, because results are listed by name",
            ));
        }
        seen.push(name);
    }
    Ok(())
}
