//! [`Study`] and [`Cell`]: what a study evaluates.

use crate::request::{EvalRequest, StartsRequest};
use crate::until::{ONE_START, SEVERAL_STARTS};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use swm_core::results::{Counting, Published, Ray, Until};
use swm_core::{Error, Result, manifest};

/// A study.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Study {
    /// The title.
    pub title: String,
    /// The question that the study asks.
    pub question: String,
    /// What the comparisons of a family have in common: their verdicts are corrected for their number.
    #[serde(default = "Common::by_default")]
    pub families: Vec<Common>,
    /// The evaluations.
    pub cells: Vec<Cell>,
    /// The rule that ends the study, if its results decide how many of the episodes of each request are played.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub until: Option<Until>,
    /// The factor that the conditions change along a ray, if they do. It is no part of the hash.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ray: Option<Ray>,
    /// Success rates that a publication states for conditions of this study. They are no part of its hash.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub published: Vec<Published>,
    /// The name of the study and the settings that it was made of, for the command that runs it again. They are no part of
    /// its hash.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub arguments: Vec<String>,
}

/// What the comparisons of a family may have in common.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Common {
    /// The policy.
    Policy,
    /// The source of starts.
    Starts,
    /// The rule for counting episodes.
    Counting,
    /// The seed.
    Seed,
}

impl Common {
    /// All values, and their names in the file of a study.
    pub const ALL: [(&str, Self); 4] =
        [("policy", Self::Policy), ("starts", Self::Starts), ("counting", Self::Counting), ("seed", Self::Seed)];

    /// The families of a study that declares none: one for each policy, rule for counting and seed.
    pub fn by_default() -> Vec<Self> {
        vec![Self::Policy, Self::Counting, Self::Seed]
    }
}

/// One evaluation of a study: one policy, and the random-policy floor, under one condition.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Cell {
    /// The name of the source of starts.
    pub starts: String,
    /// The values of the variables in the names of the condition and the policy.
    pub variables: BTreeMap<String, String>,
    /// The name of the policy with `*` for its training seed, if it has the variable
    /// [`TRAINING_SEED`](swm_core::results::TRAINING_SEED).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub any_seed: Option<String>,
    /// Whether the policy was trained on episodes that the starts come from; `None` where this is not known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub trained_on_starts: Option<bool>,
    /// The evaluation.
    pub request: EvalRequest,
    /// The hashes of the dataset and the weights that the request names. With other data or weights of the same name, it
    /// is another cell.
    pub inputs: BTreeMap<String, String>,
    /// Whether the results of the study decide how many episodes are played; those of the request are the most.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub sequential: bool,
}

impl Cell {
    /// The id: the first 16 hexadecimal digits of the hash of the request and its inputs. If the results decide the number
    /// of episodes, it is no part of the id, so that a cell with more episodes continues one with fewer.
    ///
    /// # Errors
    /// When the request cannot be written as JSON.
    pub fn id(&self) -> Result<String> {
        let of = |request: &EvalRequest| -> Result<String> { Ok(hash(&(request, &self.inputs))?[..16].to_owned()) };
        if self.sequential { of(&EvalRequest { episodes: 0, ..self.request.clone() }) } else { of(&self.request) }
    }

    /// Checks that the hashes of what the names of the request mean now are those of [`Cell::inputs`].
    ///
    /// # Errors
    /// When a dataset or a checkpoint has other content.
    pub fn check_inputs(&self, found: &BTreeMap<String, String>) -> Result<()> {
        let differs = |(input, hash): &(&String, &String)| found.get(*input) != Some(*hash);
        let Some((input, hash)) = self.inputs.iter().find(differs) else { return Ok(()) };
        let what = format!("the {input} of '{}' of '{}'", self.condition(), self.policy());
        let now = found.get(input).map_or("no hash", String::as_str);
        let fix = "resume it where it was started, with that dataset and those weights; or `swm study run` its file again, which \
                   evaluates what changed";
        Err(Error::config(what, format!("is another one ({now}) than that of the study ({hash})"), fix))
    }

    /// The name of the condition.
    pub fn condition(&self) -> &str {
        self.request.conditions.first().map_or("", |condition| &condition.name)
    }

    /// The name of the family of the cell's comparison: what it has in common with the others.
    pub fn family(&self, families: &[Common]) -> String {
        let part = |common: &Common| match common {
            Common::Policy => self.policy().to_owned(),
            Common::Starts => self.starts.clone(),
            Common::Counting => self.request.counting.to_string(),
            Common::Seed => format!("seed {}", self.request.seed),
        };
        families.iter().map(part).collect::<Vec<_>>().join(" · ")
    }

    /// The name of the policy.
    pub fn policy(&self) -> &str {
        self.request.policies.first().map_or("", |policy| &policy.name)
    }
}

impl Study {
    /// The largest number of cells.
    pub const MAX_CELLS: usize = 10_000;

    /// The hash of all requests and their inputs, and of the rule that ends the study, if there is one.
    ///
    /// # Errors
    /// When a request cannot be written as JSON.
    pub fn hash(&self) -> Result<String> {
        let cells: Vec<_> = self.cells.iter().map(|cell| (&cell.request, &cell.inputs)).collect();
        self.until.map_or_else(|| hash(&cells), |until| hash(&(&cells, until)))
    }

    /// This study with a rule that ends it: its results decide how many of the episodes of each request are played. From each
    /// recorded episode, one start is taken.
    #[must_use]
    pub fn until(mut self, until: Until) -> Self {
        self.until = Some(until);
        let sequential =
            |cell: Cell| Cell { request: cell.request.with_one_start_per_episode(), sequential: true, ..cell };
        self.cells = self.cells.into_iter().map(sequential).collect();
        self
    }

    /// Checks every request, and that no two cells are equal.
    ///
    /// # Errors
    /// When there is no cell, there are more than [`Study::MAX_CELLS`], a request is invalid, or a cell occurs twice.
    pub fn check(&self) -> Result<()> {
        if !(1..=Self::MAX_CELLS).contains(&self.cells.len()) {
            let problem = format!("it has {} cells", self.cells.len());
            return Err(Error::config("the study", problem, format!("give 1 to {} cells", Self::MAX_CELLS)));
        }
        if let Some(value) = self.published.iter().find(|value| !(0.0..=1.0).contains(&value.rate)) {
            let what = format!("the published rate of '{}' under '{}'", value.policy, value.condition);
            return Err(Error::config(what, format!("is {}", value.rate), "give a share from 0 to 1"));
        }
        self.check_rule()?;
        if let Some(ray) = self.ray.as_ref().filter(|ray| !(0.0..=1.0).contains(&ray.below)) {
            return Err(Error::config("the bound of the ray", format!("is {}", ray.below), "give a share from 0 to 1"));
        }
        let mut seen = BTreeMap::new();
        for cell in &self.cells {
            cell.request.check()?;
            if let Some(first) = seen.insert(cell.id()?, cell) {
                let problem = format!(
                    "the conditions '{}' and '{}' of {} are the same evaluation",
                    first.condition(),
                    cell.condition(),
                    cell.policy()
                );
                return Err(Error::config("the study", problem, "remove one of them"));
            }
        }
        Ok(())
    }

    /// Checks that no two cells of a new study have the same names: results are listed, and compared, by name.
    ///
    /// # Errors
    /// When starts, condition, policy, variables, seeds and counting of two cells are equal.
    pub fn check_names(&self) -> Result<()> {
        let variables: BTreeSet<&str> =
            self.cells.iter().flat_map(|cell| cell.variables.keys().map(String::as_str)).collect();
        let mut seen = BTreeSet::new();
        for cell in &self.cells {
            let named = (cell.condition(), super::rows::key(cell, &variables));
            if !seen.insert(named) {
                let what = format!("'{}' of {}", cell.condition(), cell.policy());
                let problem = "two cells have this name: their starts, condition, policy, variables and seed are equal";
                return Err(Error::config(what, problem, "give conditions, policies and starts different names"));
            }
        }
        Ok(())
    }

    /// Checks that the cells can be evaluated until the rule is met.
    fn check_rule(&self) -> Result<()> {
        let invalid = |problem: &str, fix: &str| Err(Error::config("--until", problem, fix));
        if self.cells.iter().any(|cell| cell.sequential != self.until.is_some()) {
            return invalid("some cells have a fixed number of episodes and some do not", "run the study again");
        }
        let is_parallel = |cell: &Cell| {
            matches!(cell.request.counting, Counting::Compat { .. }) && cell.request.starts == StartsRequest::Episodic
        };
        match self.until {
            Some(_) if self.cells.iter().any(is_parallel) => invalid(
                "compat counting of drawn starts counts the episodes that finish first, so none of them can follow later",
                "use protocol=strict, or take starts from a dataset",
            ),
            Some(_) if self.cells.iter().any(|cell| cell.request.may_repeat_episodes()) => {
                invalid(SEVERAL_STARTS, ONE_START)
            }
            Some(Until::Decided(_)) if self.cells.iter().all(|cell| cell.condition() == self.unshifted()) => {
                invalid("the study has one condition, so no gap to decide", "give --until ci=5, or a second condition")
            }
            _ => Ok(()),
        }
    }
}

pub(super) fn hash(value: &impl Serialize) -> Result<String> {
    let bytes = serde_json::to_vec(value).map_err(|error| Error::external("writing a study's requests", error))?;
    Ok(manifest::hash(&bytes))
}
