//! [`Recorded`]: where a dataset says that an episode starts, and how a world that does not know states by itself is told.

use crate::batch::RowRef;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::collections::BTreeMap;

/// A start and a goal out of a dataset: two rows, their columns under [`flat`] names.
#[derive(Clone, Copy)]
pub struct Recorded<'a> {
    /// Where the episode starts.
    pub start: RowRef<'a>,
    /// What it is to reach.
    pub goal: RowRef<'a>,
    /// How the world is put there, if somebody said so; worlds of ours know by themselves.
    pub calls: &'a [Call],
}

/// A method of an environment's own, called by name after a reset: the Python package `stable-worldmodel` 0.1.1 names such
/// in the argument `callables` of its `World.evaluate`, in this layout.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Call {
    /// The method.
    pub method: String,
    /// What it is given, by keyword.
    #[serde(default)]
    pub args: BTreeMap<String, Argument>,
}

/// An argument of a [`Call`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Argument {
    /// A column's name: as it is for the start's row, with `goal_` before it for the goal's, `goal` for the goal's picture.
    /// Or the value itself.
    #[serde(default)]
    pub value: Value,
    /// Whether it is a column's name.
    #[serde(default = "yes")]
    pub in_dataset: bool,
}

fn yes() -> bool {
    true
}

/// A column's name as formats without dots store it.
pub fn flat(name: &str) -> String {
    name.replace('.', "_")
}
