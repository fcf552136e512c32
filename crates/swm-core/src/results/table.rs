//! [`StudyTable`]: the table of a study whose cells are no evaluations, such as the factors of every environment.

use serde::{Deserialize, Serialize};

/// The rows of a study, each with numbers of its own.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct StudyTable {
    /// The title of the study.
    pub title: String,
    /// The question that the study asks.
    pub question: String,
    /// The BLAKE3 hash of the requests of all cells.
    pub hash: String,
    /// The number of cells.
    pub cells: usize,
    /// The number of cells with values.
    pub done: usize,
    /// What a row is about, such as `environment`.
    pub subject: String,
    /// The columns.
    pub columns: Vec<TableColumn>,
    /// The rows, in the order of the cells.
    pub rows: Vec<TableRow>,
    /// Where the published values come from; empty without any.
    pub source: String,
}

/// A column of numbers.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TableColumn {
    /// The name.
    pub name: String,
    /// The unit; columns of one unit share a figure.
    pub unit: String,
    /// Whether a publication states the values.
    #[serde(default)]
    pub published: bool,
}

/// The values of a cell.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TableRow {
    /// The id of the cell.
    pub cell: String,
    /// The name.
    pub name: String,
    /// A value for each column; `None` where nothing was measured, or published.
    pub values: Vec<Option<f64>>,
    /// The machine on which the values were measured; empty for values that do not depend on it.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub machine: String,
    /// Paths in a plane that all rows share, such as the latents of each episode along two principal components; a path of
    /// one point is a dot.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub paths: Vec<Vec<[f64; 2]>>,
}

impl TableColumn {
    /// The name with its unit, which is left out where the name says it.
    pub fn label(&self) -> String {
        if self.unit.is_empty() || self.name.contains(&self.unit) {
            return self.name.clone();
        }
        format!("{}, {}", self.name, self.unit)
    }
}
