//! [`Study`] and [`Cell`]: what a study evaluates.

use crate::request::EvalRequest;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use swm_core::results::Published;
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
    /// The evaluation.
    pub request: EvalRequest,
    /// The hashes of the dataset and the weights that the request names. With other data or weights of the same name, it
    /// is another cell.
    pub inputs: BTreeMap<String, String>,
}

impl Cell {
    /// The id: the first 16 hexadecimal digits of the hash of the request and its inputs.
    ///
    /// # Errors
    /// When the request cannot be written as JSON.
    pub fn id(&self) -> Result<String> {
        Ok(hash(&(&self.request, &self.inputs))?[..16].to_owned())
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

    /// The hash of all requests and their inputs.
    ///
    /// # Errors
    /// When a request cannot be written as JSON.
    pub fn hash(&self) -> Result<String> {
        hash(&self.cells.iter().map(|cell| (&cell.request, &cell.inputs)).collect::<Vec<_>>())
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
}

fn hash(value: &impl Serialize) -> Result<String> {
    let bytes = serde_json::to_vec(value).map_err(|error| Error::external("writing a study's requests", error))?;
    Ok(manifest::hash(&bytes))
}
