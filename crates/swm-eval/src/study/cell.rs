//! [`Study`] and [`Cell`]: what a study evaluates.

use crate::request::EvalRequest;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use swm_core::{Error, Result, manifest};

/// A study.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Study {
    /// The title.
    pub title: String,
    /// The question that the study asks.
    pub question: String,
    /// The evaluations.
    pub cells: Vec<Cell>,
}

/// One evaluation of a study: one policy, and the random-policy floor, under one condition.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Cell {
    /// The name of the source of starts.
    pub starts: String,
    /// The values of the variables in the names of the condition and the policy.
    pub variables: BTreeMap<String, String>,
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
