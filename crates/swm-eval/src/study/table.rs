//! [`TableStudy`]: a study whose cells are no evaluations; each fills a row of a table.

use super::cell::{Study, hash};
use super::folder::{MAX_BYTES, StudyFolder, json};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::collections::BTreeSet;
use std::path::PathBuf;
use swm_core::files::{self, Lock};
use swm_core::results::{StudyTable, TableColumn, TableRow, Until};
use swm_core::run::{Control, Event, Progress, Stage};
use swm_core::{Error, Result};

/// The name of the stage.
const STAGE: &str = "study";

/// The most columns of a table.
const MAX_COLUMNS: usize = 100;

/// A study of rows with numbers.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TableStudy {
    /// What its cells are, such as `factors`. An evaluating study has no kind.
    pub kind: String,
    /// The title.
    pub title: String,
    /// The question that the study asks.
    pub question: String,
    /// What a row is about, such as `environment`.
    pub subject: String,
    /// The columns, those with published values last.
    pub columns: Vec<TableColumn>,
    /// Where the published values come from.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub source: String,
    /// The cells.
    pub cells: Vec<TableCell>,
    /// The name of the study and the settings that it was made of, for the command that runs it again.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub arguments: Vec<String>,
}

/// A row before it has values.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TableCell {
    /// The name of the row.
    pub name: String,
    /// The settings that determine the values, apart from the machine.
    pub request: Value,
    /// A value for each column that is published; they are no part of the id.
    pub published: Vec<Option<f64>>,
}

/// A study in a folder.
#[derive(Clone, Debug)]
pub enum AnyStudy {
    /// A study of evaluations.
    Evaluations(Study),
    /// A study of another kind.
    Table(TableStudy),
}

/// What was measured of a cell.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Measured {
    /// A value for each column that is not published.
    pub values: Vec<f64>,
    /// The paths of [`TableRow::paths`].
    pub paths: Vec<Vec<[f64; 2]>>,
}

impl From<Vec<f64>> for Measured {
    fn from(values: Vec<f64>) -> Self {
        Self { values, paths: vec![] }
    }
}

/// Returns what was measured of a cell; `None` if it cannot be measured here.
pub type Measure<'a> = dyn FnMut(&TableCell, &mut Control<'_>) -> Result<Option<Measured>> + 'a;

/// The values of a cell, as stored.
#[derive(Serialize, Deserialize)]
struct Stored {
    request: Value,
    #[serde(default, skip_serializing_if = "String::is_empty")]
    machine: String,
    values: Vec<f64>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    paths: Vec<Vec<[f64; 2]>>,
}

impl TableCell {
    /// The id: the first 16 hexadecimal digits of the hash of the request.
    ///
    /// # Errors
    /// Never for a request that was read from JSON.
    pub fn id(&self) -> Result<String> {
        Ok(hash(&self.request)?[..16].to_owned())
    }
}

impl TableStudy {
    /// Checks the numbers of cells and columns, the published values, and that no two cells are equal.
    ///
    /// # Errors
    /// When one of them is wrong.
    pub fn check(&self) -> Result<()> {
        if !(1..=Study::MAX_CELLS).contains(&self.cells.len()) {
            let problem = format!("it has {} cells", self.cells.len());
            return Err(Error::config("the study", problem, format!("give 1 to {} cells", Study::MAX_CELLS)));
        }
        if self.columns.len() > MAX_COLUMNS {
            let problem = format!("it has {} columns", self.columns.len());
            return Err(Error::config("the study", problem, format!("give at most {MAX_COLUMNS}")));
        }
        let published = self.columns.iter().filter(|column| column.published).count();
        let mut seen = BTreeSet::new();
        for cell in &self.cells {
            let finite = cell.published.iter().flatten().all(|value| value.is_finite());
            if cell.published.len() != published || !finite {
                let problem = format!("has {} published values", cell.published.len());
                return Err(Error::config(cell.name.clone(), problem, format!("give {published} finite numbers")));
            }
            if !seen.insert(cell.id()?) {
                return Err(Error::config(cell.name.clone(), "is a row twice", "remove one of them"));
            }
        }
        Ok(())
    }

    /// Fills the rows that have no values in the folder, in order, and stores each. Returns the number of new rows.
    ///
    /// `measure` returns the values of a cell, without the published ones, or `None` if it cannot be measured here: such a
    /// row stays empty, and is tried again by the next run. `machine` is stored with the values; empty for values that do
    /// not depend on it.
    ///
    /// # Errors
    /// When `measure` fails, a value is missing or is not finite, or storing fails. Rows that are done stay stored.
    pub fn run(
        &self,
        folder: &StudyFolder,
        machine: &str,
        measure: &mut Measure<'_>,
        control: &mut Control<'_>,
    ) -> Result<usize> {
        let mut missing = vec![];
        for cell in &self.cells {
            if folder.stored(cell)?.is_none() {
                missing.push(cell);
            }
        }
        let (total, mut added) = (missing.len(), 0);
        control.emit(Event::Started(Stage { name: STAGE, subject: &[&self.title], total, unit: "rows" }));
        let columns = self.columns.iter().filter(|column| !column.published).count();
        for (done, cell) in missing.into_iter().enumerate() {
            control.check()?;
            if let Some(measured) = measure(cell, control)? {
                let Measured { values, paths } = &measured;
                let mut all = values.iter().chain(paths.iter().flatten().flatten());
                if values.len() != columns || !all.all(|value| value.is_finite()) {
                    let problem = format!("has the values {values:?}");
                    return Err(Error::config(
                        cell.name.clone(),
                        problem,
                        format!("expected {columns} finite numbers"),
                    ));
                }
                folder.store_values(cell, machine, measured)?;
                added += 1;
            }
            control.progress(Progress { stage: STAGE, done: done + 1, total, unit: "rows", metrics: &[] });
        }
        control.emit(Event::Finished { stage: STAGE, metrics: &[("rows", added as f64)] });
        Ok(added)
    }

    /// Returns the table; rows that are not done have no values of ours.
    ///
    /// # Errors
    /// When stored values are damaged.
    pub fn results(&self, folder: &StudyFolder) -> Result<StudyTable> {
        let (mut rows, mut done) = (vec![], 0);
        let columns = self.columns.iter().filter(|column| !column.published).count();
        for cell in &self.cells {
            let stored = folder.stored(cell)?;
            done += usize::from(stored.is_some());
            let (machine, ours, paths) = match stored {
                Some(Stored { machine, values, paths, .. }) => (machine, values.into_iter().map(Some).collect(), paths),
                None => (String::new(), vec![None; columns], vec![]),
            };
            let values = [ours, cell.published.clone()].concat();
            rows.push(TableRow { cell: cell.id()?, name: cell.name.clone(), values, machine, paths });
        }
        Ok(StudyTable {
            title: self.title.clone(),
            question: self.question.clone(),
            hash: hash(&self.cells.iter().map(|cell| &cell.request).collect::<Vec<_>>())?,
            cells: self.cells.len(),
            done,
            subject: self.subject.clone(),
            columns: self.columns.clone(),
            rows,
            source: self.source.clone(),
        })
    }
}

impl AnyStudy {
    /// The title.
    pub fn title(&self) -> &str {
        match self {
            Self::Evaluations(study) => &study.title,
            Self::Table(study) => &study.title,
        }
    }

    /// The rule that ends the study, if there is one.
    pub(super) fn until(&self) -> Option<Until> {
        match self {
            Self::Evaluations(study) => study.until,
            Self::Table(_) => None,
        }
    }
}

impl StudyFolder {
    /// Creates the folder and writes a study of another kind, as [`StudyFolder::create`] does.
    ///
    /// # Errors
    /// As [`StudyFolder::create`].
    pub fn create_table(&self, study: &TableStudy) -> Result<Lock> {
        study.check()?;
        self.create_with(&study.title, None, &json(study)?)
    }

    fn stored(&self, cell: &TableCell) -> Result<Option<Stored>> {
        let path = self.values_path(cell)?;
        if !path.exists() {
            return Ok(None);
        }
        let damaged = |problem: String| Error::corrupt(&path, problem, "remove the file and run the study again");
        let stored: Stored = serde_json::from_slice(&files::read(&path, MAX_BYTES)?)
            .map_err(|error| damaged(format!("is not a row of a study ({error})")))?;
        if stored.request != cell.request {
            return Err(damaged("has the values of another row".to_owned()));
        }
        Ok(Some(stored))
    }

    fn store_values(&self, cell: &TableCell, machine: &str, measured: Measured) -> Result<()> {
        let Measured { values, paths } = measured;
        let stored = Stored { request: cell.request.clone(), machine: machine.to_owned(), values, paths };
        files::write(&self.values_path(cell)?, &json(&stored)?)
    }

    fn values_path(&self, cell: &TableCell) -> Result<PathBuf> {
        Ok(self.cell_path(&cell.id()?))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn study() -> TableStudy {
        let column = |name: &str, published| TableColumn { name: name.to_owned(), unit: "u".to_owned(), published };
        let cell =
            |name: &str| TableCell { name: name.to_owned(), request: json!({"of": name}), published: vec![None] };
        let [kind, title, question, subject] = ["lengths", "Lengths", "How long?", "word"].map(str::to_owned);
        TableStudy {
            kind,
            title,
            question,
            subject,
            columns: vec![column("length", false), column("published", true)],
            source: String::new(),
            cells: vec![cell("a"), cell("bb"), cell("ccc")],
            arguments: vec![],
        }
    }

    #[test]
    fn rows_are_filled_once_and_those_without_values_again() {
        let (root, study) = (tempfile::tempdir().expect("a folder"), study());
        let folder = StudyFolder::new(&root.path().join("out"));
        let lock = folder.create_table(&study).expect("creating the folder");
        let mut asked = vec![];
        let mut run = |possible: bool| {
            let mut measure = |cell: &TableCell, _: &mut Control<'_>| {
                asked.push(cell.name.clone());
                Ok((possible || cell.name != "bb").then(|| vec![cell.name.len() as f64].into()))
            };
            study.run(&folder, "", &mut measure, &mut Control::new()).expect("filling the rows")
        };
        assert_eq!((run(false), run(true), run(true)), (2, 1, 0));
        assert_eq!(asked, ["a", "bb", "ccc", "bb"]);
        let AnyStudy::Table(read) = folder.open().expect("the study") else { panic!("a study of evaluations") };
        let table = read.results(&folder).expect("the table");
        assert_eq!((table.done, table.cells), (3, 3));
        let values: Vec<_> = table.rows.iter().map(|row| row.values.clone()).collect();
        assert_eq!(values, [[Some(1.0), None], [Some(2.0), None], [Some(3.0), None]]);
        assert!(folder.study().expect_err("no evaluations").to_string().contains("lengths"));
        drop(lock);

        let wrong = |values: Vec<f64>| {
            let other = TableStudy {
                cells: vec![TableCell { request: json!(values.len()), ..study.cells[0].clone() }],
                ..study.clone()
            };
            other.run(&folder, "", &mut |_, _| Ok(Some(values.clone().into())), &mut Control::new())
        };
        assert!(wrong(vec![f64::NAN]).is_err() && wrong(vec![1.0, 2.0]).is_err() && wrong(vec![]).is_err());
        let wide = TableStudy { columns: vec![study.columns[0].clone(); 100_000], ..study.clone() };
        assert!(wide.check().expect_err("too many columns").to_string().contains("100000 columns"));
        let twice = TableStudy { cells: vec![study.cells[0].clone(), study.cells[0].clone()], ..study };
        assert!(twice.check().expect_err("a row twice").to_string().contains("twice"));
    }
}
