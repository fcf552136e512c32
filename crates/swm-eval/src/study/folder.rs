//! [`StudyFolder`]: the files of a study.

use super::cell::{Cell, Study};
use super::table::{AnyStudy, TableStudy};
use crate::request::EvalRequest;
use serde::Deserialize;
use std::path::{Path, PathBuf};
use swm_core::files::{self, Lock};
use swm_core::results::Until;
use swm_core::{Error, Result, Results};

/// The folder of a study: `study.json`, the results of each cell in `cells/ID.json`, `image-distances.json`, and in `models` what
/// its cells train.
pub struct StudyFolder {
    pub(super) root: PathBuf,
}

/// The name of the file with all cells.
const STUDY: &str = "study.json";
/// The name of the file with the image distances of all cells.
pub(super) const IMAGE_DISTANCES: &str = "image-distances.json";
/// The largest file of a study, in bytes.
pub(super) const MAX_BYTES: u64 = 256 << 20;

impl StudyFolder {
    /// The folder at a path.
    pub fn new(root: &Path) -> Self {
        Self { root: root.to_owned() }
    }

    /// Creates the folder and writes the study. Results of cells that the study no longer has stay in the folder, and are
    /// used again when it has them again. Keeps other writers away until the lock is dropped.
    ///
    /// # Errors
    /// When another process writes to the folder, it holds other files or another study, or writing fails.
    pub fn create(&self, study: &Study) -> Result<Lock> {
        self.create_with(&study.title, study.until, &json(study)?)
    }

    /// Creates the folder and writes the study with this title, and the rule that ends it.
    pub(super) fn create_with(&self, title: &str, until: Option<Until>, bytes: &[u8]) -> Result<Lock> {
        let (lock, path) = (Lock::folder(&self.root)?, self.root.join(STUDY));
        files::check_own(&path, |_| self.open().is_ok())?;
        files::delete_temporary(&self.root, |name| [STUDY, IMAGE_DISTANCES].contains(&name))?;
        let other = |problem: String| {
            Error::config(self.root.display().to_string(), problem, "give another folder with --output")
        };
        if path.exists() {
            let found = self.open()?;
            if found.title() != title {
                return Err(other(format!("holds the study '{}', not '{title}'", found.title())));
            }
            if let (Some(found), None) = (found.until(), until) {
                let problem = format!("holds a study that ran with --until {found}");
                let fix = "intervals for a fixed number of episodes do not hold for it: give --until again, or another folder \
                           with --output";
                return Err(Error::config(self.root.display().to_string(), problem, fix));
            }
        } else {
            let io = |error| Error::io(&self.root, "reading the folder", error);
            let entries = std::fs::read_dir(&self.root).map_err(io)?;
            let names = entries.map(|entry| Ok(entry.map_err(io)?.file_name())).collect::<Result<Vec<_>>>()?;
            if !names.is_empty() {
                return Err(other("has files and no study.json".to_owned()));
            }
        }
        let cells = self.root.join("cells");
        files::check_no_link(&cells)?;
        files::write(&path, bytes)?;
        std::fs::create_dir_all(&cells).map_err(|error| Error::io(&cells, "creating the folder", error))?;
        files::delete_temporary(&cells, |name| name.ends_with(".json"))?;
        Ok(lock)
    }

    /// Reads the study, which may be of any kind.
    ///
    /// # Errors
    /// When the folder has no study, or it is damaged.
    pub fn open(&self) -> Result<AnyStudy> {
        #[derive(Deserialize)]
        struct Head {
            kind: Option<String>,
        }
        let path = self.root.join(STUDY);
        let fix = "give the folder that `swm study run --output` wrote";
        if self.root.is_dir() && !path.exists() {
            return Err(Error::config(self.root.display().to_string(), format!("has no {STUDY}"), fix));
        }
        let (bytes, no_study) =
            (files::read(&path, MAX_BYTES)?, |error| Error::corrupt(&path, format!("is not a study ({error})"), fix));
        let invalid = |error| Error::corrupt(&path, format!("is not a valid study ({error})"), fix);
        if serde_json::from_slice::<Head>(&bytes).map_err(no_study)?.kind.is_some() {
            let study: TableStudy = serde_json::from_slice(&bytes).map_err(no_study)?;
            study.check().map_err(invalid)?;
            return Ok(AnyStudy::Table(study));
        }
        let study: Study = serde_json::from_slice(&bytes).map_err(no_study)?;
        study.check().map_err(invalid)?;
        Ok(AnyStudy::Evaluations(study))
    }

    /// Reads a study of evaluations.
    ///
    /// # Errors
    /// As [`StudyFolder::open`], and when it is a study of another kind.
    pub fn study(&self) -> Result<Study> {
        match self.open()? {
            AnyStudy::Evaluations(study) => Ok(study),
            AnyStudy::Table(TableStudy { kind, .. }) => {
                let problem = format!("has a study of the kind '{kind}', which evaluates nothing");
                Err(Error::config(
                    self.root.display().to_string(),
                    problem,
                    "give the folder of a study of evaluations",
                ))
            }
        }
    }

    /// Returns the results of a cell, or `None` if it has none. Those of a sequential cell may have any number of episodes.
    ///
    /// # Errors
    /// When the results are damaged, or are those of another request.
    pub fn results(&self, cell: &Cell) -> Result<Option<Results>> {
        let path = self.path(cell)?;
        if !path.exists() {
            return Ok(None);
        }
        let damaged = |problem: String| Error::corrupt(&path, problem, "remove the file and run the study again");
        let results: Results = serde_json::from_slice(&files::read(&path, MAX_BYTES)?)
            .map_err(|error| damaged(format!("is not a results file ({error})")))?;
        results.check().map_err(|problem| damaged(format!("is inconsistent: {problem}")))?;
        if !answers(&results, cell)? {
            return Err(damaged("has the results of another evaluation".to_owned()));
        }
        Ok(Some(results))
    }

    /// Stores the results of a cell, without times.
    ///
    /// # Errors
    /// When the dataset or the weights are no longer those of the cell, or writing fails.
    pub fn store(&self, cell: &Cell, mut results: Results) -> Result<()> {
        cell.check_inputs(&results.manifest.hashes)?;
        for run in &mut results.runs {
            run.timing = Default::default();
        }
        results.sequential = cell.sequential;
        files::write(&self.path(cell)?, &json(&results)?)
    }

    fn path(&self, cell: &Cell) -> Result<PathBuf> {
        Ok(self.cell_path(&cell.id()?))
    }

    /// The folder of a model that the cells of the study train.
    ///
    /// # Errors
    /// When it, or the folder of all models, is a symbolic link.
    pub fn model(&self, name: &str) -> Result<PathBuf> {
        let models = self.root.join("models");
        let model = models.join(name);
        [&models, &model].into_iter().try_for_each(|folder| files::check_no_link(folder))?;
        Ok(model)
    }

    /// The file of a cell.
    pub(super) fn cell_path(&self, id: &str) -> PathBuf {
        self.root.join("cells").join(format!("{id}.json"))
    }
}

/// Whether results are those of the cell's request and inputs.
fn answers(results: &Results, cell: &Cell) -> Result<bool> {
    let (hashes, episodes) = (&results.manifest.hashes, EvalRequest::of(&results.manifest)?.episodes);
    let same_inputs = cell.check_inputs(hashes).is_ok();
    let has_all = if cell.sequential {
        results.runs.iter().all(|run| run.episodes.len() == episodes)
    } else {
        episodes == cell.request.episodes
    };
    Ok(cell.request.is_of(results)? && same_inputs && has_all)
}

pub(super) fn json(value: &impl serde::Serialize) -> Result<Vec<u8>> {
    let mut bytes =
        serde_json::to_vec_pretty(value).map_err(|error| Error::external("writing the files of a study", error))?;
    bytes.push(b'\n');
    Ok(bytes)
}
