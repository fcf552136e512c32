//! Examines a dataset for defects, and reports the models that the dataset can train. A repair writes the intact
//! episodes to a new dataset.
//!
//! The examination reads every row of every column as training does, so a loader reads an intact dataset without
//! errors. Defects that only the format can detect come from [`Reader::irregularities`].

mod model_fit;

pub use model_fit::ModelFit;

use crate::dataset::views::subset;
use crate::dataset::{Location, Reader, StepRange};
use crate::formats::{lance, open};
use crate::tools::convert::{ConvertOptions, Converted, convert};
use serde::Serialize;
use std::collections::{BTreeMap, HashSet};
use std::sync::Arc;
use swm_core::columns::{ACTION, EPISODE_IDX, REWARD, STEP_IDX, TERMINATED};
use swm_core::requirements::DatasetRequirements;
use swm_core::run::{Control, Event, Progress, Stage};
use swm_core::{Batch, ColumnSpec, DType, Error, Result};

/// The most rows that are examined at a time, and the most bytes of them: a small file can hold an episode of many equal rows.
const PIECE_ROWS: usize = 1 << 20;
const PIECE_BYTES: usize = 64 << 20;

/// Severity of a finding.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Severity {
    /// The data is damaged or inconsistent.
    Problem,
    /// A remark on intact data.
    Note,
}

/// A defect or a remark that the examination reports.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Finding {
    /// The severity of the finding.
    pub severity: Severity,
    /// Human-readable description.
    pub what: String,
    /// Positions of the affected episodes; empty if the whole dataset is affected.
    pub episodes: Vec<usize>,
}

/// The result of an examination.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Diagnosis {
    /// Number of episodes.
    pub episodes: usize,
    /// Number of rows of all episodes.
    pub rows: usize,
    /// Findings, problems first.
    pub findings: Vec<Finding>,
    /// Positions of the episodes without a problem.
    #[serde(rename = "sound")]
    pub intact: Vec<usize>,
    /// For each model, the comparison of the model's requirements with the intact episodes.
    pub models: Vec<ModelFit>,
}

impl Diagnosis {
    /// Adds the losses that [`open_damaged`] reported.
    pub fn add_losses(&mut self, lost: Vec<String>) {
        let finding = |what| Finding { severity: Severity::Problem, what, episodes: vec![] };
        self.findings.splice(0..0, lost.into_iter().map(finding));
    }

    /// Number of problems.
    pub fn problems(&self) -> usize {
        self.findings.iter().filter(|finding| finding.severity == Severity::Problem).count()
    }
}

/// Opens a dataset. Of a damaged dataset, opens the readable part and describes the losses.
///
/// # Errors
/// If no part of the dataset can be opened.
pub fn open_damaged(location: &Location) -> Result<(Arc<dyn Reader>, Vec<String>)> {
    open(location).map(|reader| (reader, vec![])).or_else(|error| {
        if !(lance::ENTRY.detect)(location) {
            return Err(error);
        }
        match lance::salvage(location) {
            Ok((reader, lost)) if !lost.is_empty() => Ok((reader, lost)),
            _ => Err(error),
        }
    })
}

/// Examines a dataset, and compares its intact episodes with the requirements of `models`.
///
/// # Errors
/// If the run is stopped. Damage is not an error but a finding.
pub fn examine(reader: &dyn Reader, models: &[DatasetRequirements], control: &mut Control<'_>) -> Result<Diagnosis> {
    let (stage, total, unit) = ("examine", reader.episodes().len(), "episodes");
    control.emit(Event::Started(Stage { name: stage, subject: &[], total, unit }));
    let mut found = Findings::default();
    match reader.irregularities() {
        Ok(irregularities) => {
            irregularities.into_iter().for_each(|irregularity| found.problem(irregularity.episode, irregularity.what))
        }
        Err(error) => found.problem(None, error.to_string()),
    }
    let episodes = reader.episodes();
    if episodes.is_empty() {
        found.problem(None, "there is no episode".to_owned());
    }
    let data = |name: &str| name != EPISODE_IDX && name != STEP_IDX;
    let columns: Vec<&ColumnSpec> = reader.schema().columns().iter().filter(|column| data(&column.name)).collect();
    if !columns.iter().any(|column| column.name == REWARD) {
        found.note(None, "there is no reward".to_owned());
    }
    let mut indices = HashSet::new();
    let mut intact = vec![];
    for (position, episode) in episodes.iter().enumerate() {
        if !indices.insert(episode.index) {
            found.problem(Some(position), format!("the index {} is also the index of another episode", episode.index));
        }
        match episode.length {
            0 => found.problem(Some(position), "it has no rows".to_owned()),
            1 => found.note(Some(position), "it has one row and therefore no step".to_owned()),
            _ => {}
        }
        if let Err(error) = reader.constants(position) {
            found.problem(Some(position), format!("its constants cannot be read: {error}"));
        }
        for column in std::iter::once(STEP_IDX).chain(columns.iter().map(|column| &column.name[..])) {
            examine_column(reader, column, position, &mut found, control)?;
        }
        if !found.bad.contains(&position) {
            intact.push(position);
        }
        control.progress(Progress { stage, done: position + 1, total, unit, metrics: &[] });
        control.check()?;
    }
    control.emit(Event::Finished { stage, metrics: &[] });
    let lengths: Vec<usize> = intact.iter().map(|&position| episodes[position].length).collect();
    Ok(Diagnosis {
        episodes: episodes.len(),
        rows: episodes.iter().map(|episode| episode.length).sum(),
        models: models.iter().map(|required| ModelFit::new(required, reader.schema(), &lengths)).collect(),
        findings: found.sorted(),
        intact,
    })
}

/// Writes the episodes without a problem to a new dataset.
///
/// # Errors
/// If no episode is intact, or the target cannot be written.
pub fn repair(
    reader: &Arc<dyn Reader>,
    diagnosis: &Diagnosis,
    target: &Location,
    options: &ConvertOptions,
    control: &mut Control<'_>,
) -> Result<Converted> {
    if diagnosis.intact.is_empty() {
        let problem = format!("none of the dataset's {} episodes is intact", diagnosis.episodes);
        return Err(Error::config(
            "repair",
            problem,
            "collect the data again, or convert them again from their source",
        ));
    }
    convert(&subset(Arc::clone(reader), diagnosis.intact.clone())?, target, options, control)
}

/// Findings, each with all affected episodes.
#[derive(Default)]
struct Findings {
    found: BTreeMap<(Severity, String), Vec<usize>>,
    /// Positions of the episodes with a problem.
    bad: HashSet<usize>,
}

impl Findings {
    fn problem(&mut self, episode: Option<usize>, what: String) {
        self.bad.extend(episode);
        self.add(Severity::Problem, episode, what);
    }

    fn note(&mut self, episode: Option<usize>, what: String) {
        self.add(Severity::Note, episode, what);
    }

    /// Adds a finding, once for an episode.
    fn add(&mut self, severity: Severity, episode: Option<usize>, what: String) {
        let episodes = self.found.entry((severity, what)).or_default();
        episodes.extend(episode.filter(|episode| episodes.last() != Some(episode)));
    }

    fn sorted(self) -> Vec<Finding> {
        let finding = |((severity, what), episodes)| Finding { severity, what, episodes };
        self.found.into_iter().map(finding).collect()
    }
}

/// Examines one column of one episode, in pieces.
///
/// # Errors
/// If the run is stopped.
fn examine_column(
    reader: &dyn Reader,
    column: &str,
    position: usize,
    found: &mut Findings,
    control: &mut Control<'_>,
) -> Result<()> {
    let length = reader.episodes()[position].length;
    let row_bytes = reader.schema().column(column).map_or(1, ColumnSpec::row_bytes);
    let piece = (PIECE_BYTES / row_bytes.max(1)).clamp(1, PIECE_ROWS);
    let mut first = 0;
    loop {
        let count = piece.min(length - first);
        match reader.read(&[column], &[StepRange::new(position, first, count)]) {
            Ok(batch) if examine_rows(&batch, column, position, first, length, found)? => {}
            Ok(_) => return Ok(()),
            Err(error) => {
                found.problem(Some(position), format!("'{column}' cannot be read: {error}"));
                return Ok(());
            }
        }
        first += count;
        if first >= length {
            return Ok(());
        }
        control.check()?;
    }
}

/// Examines rows of one column of one episode of `length` rows, from row `first` on. Returns whether the next rows are to be
/// examined.
fn examine_rows(
    rows: &Batch,
    column: &str,
    position: usize,
    first: usize,
    length: usize,
    found: &mut Findings,
) -> Result<bool> {
    let (count, spec) = (rows.rows(), &rows.schema().columns()[0]);
    let last = length.saturating_sub(1);
    match column {
        STEP_IDX => {
            let steps = rows.to_f32(STEP_IDX)?;
            let exact = count.min((1_usize << 24).saturating_sub(first));
            if let Some(row) = (0..exact).find(|&row| steps[row] != (first + row) as f32) {
                let (step, row) = (steps[row], first + row);
                found.problem(Some(position), format!("row {row} holds step {step} instead of step {row}"));
                return Ok(false);
            }
        }
        ACTION if spec.dtype != DType::U8 && spec.dtype != DType::Bool => {
            let float = matches!(spec.dtype, DType::Float32 | DType::Float64);
            let (mut missing, mut broken) = (0, 0);
            for row in 0..count {
                let action = rows.row(row).to_f64(ACTION)?;
                let none = action.iter().all(|&v| if float { v.is_nan() } else { v == -1.0 });
                match first + row == last {
                    true if !none => {
                        let what = "the last row has an action, but no observation follows it; a repaired or converted \
                                    dataset omits it";
                        found.note(Some(position), what.to_owned());
                    }
                    false if none => missing += 1,
                    false if action.iter().any(|v| !v.is_finite()) => broken += 1,
                    _ => {}
                }
            }
            if missing > 0 {
                found.problem(Some(position), "there is no action in a row that is not the last".to_owned());
            }
            if broken > 0 {
                found.problem(Some(position), "an action is not finite".to_owned());
            }
        }
        _ if matches!(spec.dtype, DType::Float32 | DType::Float64) => {
            let finite = match spec.dtype {
                DType::Float32 => rows.get::<f32>(column)?.iter().all(|v| v.is_finite()),
                _ => rows.get::<f64>(column)?.iter().all(|v| v.is_finite()),
            };
            if !finite {
                found.problem(Some(position), format!("'{column}' has a value that is not finite"));
            }
        }
        TERMINATED => {
            let flags = rows.bytes(0);
            if flags.iter().take(last.saturating_sub(1 + first)).any(|&flag| flag != 0) {
                found.note(Some(position), "it continues after it terminated".to_owned());
            }
        }
        _ => {}
    }
    Ok(true)
}
