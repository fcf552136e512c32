//! Examining a dataset: what is wrong with it, which models it can train, and a new dataset of what is sound.
//!
//! Everything is read the way training reads it, every row of every column, so what passes here is what a loader gives.
//! What only the format can tell (rows that belong to no episode, stored step numbers, files that nothing refers to) it
//! tells through [`Reader::irregularities`].

mod models;

pub use models::{Fitness, fitness};

use crate::dataset::Location;
use crate::dataset::views::subset;
use crate::dataset::{Reader, StepRange};
use crate::formats::{lance, open};
use crate::tools::convert::{ConvertOptions, Converted, Stage, convert};
use serde::Serialize;
use std::collections::{BTreeMap, HashSet};
use std::sync::Arc;
use swm_core::columns::{ACTION, EPISODE_IDX, STEP_IDX};
use swm_core::{Batch, ColumnSpec, DType, Error, Result, Schema};

/// How bad it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Severity {
    /// The data are damaged or contradict themselves.
    Problem,
    /// Worth knowing, and sound.
    Note,
}

/// Something that was found.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Finding {
    /// How bad it is.
    pub severity: Severity,
    /// What it is.
    pub what: String,
    /// The positions of the episodes it was found in; none if it is about the dataset.
    pub episodes: Vec<usize>,
}

/// What is the matter with a dataset.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Diagnosis {
    /// Episodes.
    pub episodes: usize,
    /// Rows of all episodes.
    pub rows: usize,
    /// What was found, problems first.
    pub findings: Vec<Finding>,
    /// The positions of the episodes without a problem.
    pub sound: Vec<usize>,
    /// Which models the sound episodes can train.
    pub models: Vec<Fitness>,
}

impl Diagnosis {
    /// Adds what was lost before anything was read.
    pub fn add_lost(&mut self, lost: Vec<String>) {
        let finding = |what| Finding { severity: Severity::Problem, what, episodes: vec![] };
        self.findings.splice(0..0, lost.into_iter().map(finding));
    }

    /// How many problems there are.
    pub fn problems(&self) -> usize {
        self.findings.iter().filter(|finding| finding.severity == Severity::Problem).count()
    }
}

/// Opens a dataset, or what is left of one that cannot be opened, and says what is lost.
///
/// # Errors
/// When nothing of it can be opened.
pub fn open_what_is_left(location: &Location) -> Result<(Arc<dyn Reader>, Vec<String>)> {
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

/// Reads everything and says what is wrong. `progress` is told the episodes done, and stops the work by saying `false`.
///
/// # Errors
/// When the work is stopped. Damage is no error: it is what is looked for.
pub fn examine(reader: &dyn Reader, progress: &mut dyn FnMut(usize) -> bool) -> Result<Diagnosis> {
    let mut found = Findings::default();
    match reader.irregularities() {
        Ok(irregularities) => irregularities.into_iter().for_each(|it| found.problem(it.episode, it.what)),
        Err(error) => found.problem(None, error.to_string()),
    }
    let episodes = reader.episodes();
    if episodes.is_empty() {
        found.problem(None, "there is no episode".to_owned());
    }
    let data = |name: &str| name != EPISODE_IDX && name != STEP_IDX;
    let columns: Vec<&ColumnSpec> = reader.schema().columns().iter().filter(|column| data(&column.name)).collect();
    if !columns.iter().any(|column| column.name == "reward") {
        found.note(None, "there is no reward".to_owned());
    }
    let mut numbers = HashSet::new();
    let mut sound = vec![];
    for (position, episode) in episodes.iter().enumerate() {
        if !numbers.insert(episode.index) {
            found.problem(Some(position), format!("the number {} stands for another episode, too", episode.index));
        }
        match episode.length {
            0 => found.problem(Some(position), "it has no rows".to_owned()),
            1 => found.note(Some(position), "it has one row, and so no step".to_owned()),
            _ => {}
        }
        if let Err(error) = reader.constants(position) {
            found.problem(Some(position), format!("its constants cannot be read: {error}"));
        }
        for column in std::iter::once(STEP_IDX).chain(columns.iter().map(|column| &column.name[..])) {
            match reader.read(&[column], &[StepRange::new(position, 0, episode.length)]) {
                Ok(batch) => examine_column(&batch, column, position, &mut found)?,
                Err(error) => found.problem(Some(position), format!("'{column}' cannot be read: {error}")),
            }
        }
        if !found.bad.contains(&position) {
            sound.push(position);
        }
        if !progress(position + 1) {
            return Err(Error::Interrupted);
        }
    }
    let lengths: Vec<usize> = sound.iter().map(|&position| episodes[position].length).collect();
    Ok(Diagnosis {
        episodes: episodes.len(),
        rows: episodes.iter().map(|episode| episode.length).sum(),
        models: fitness(reader.schema(), &lengths),
        findings: found.sorted(),
        sound,
    })
}

/// Writes the episodes without a problem to a new dataset.
///
/// # Errors
/// When none is sound, or the target cannot be written.
pub fn repair(
    reader: &Arc<dyn Reader>,
    diagnosis: &Diagnosis,
    target: &Location,
    options: &ConvertOptions,
    progress: &mut dyn FnMut(Stage, usize, usize) -> bool,
) -> Result<Converted> {
    if diagnosis.sound.is_empty() {
        let problem = format!("none of its {} episodes is sound", diagnosis.episodes);
        return Err(Error::config(
            "repair",
            problem,
            "collect the data again, or convert them again from their source",
        ));
    }
    convert(&subset(Arc::clone(reader), diagnosis.sound.clone())?, target, options, progress)
}

/// What was found, episodes with the same gathered.
#[derive(Default)]
struct Findings {
    found: BTreeMap<(Severity, String), Vec<usize>>,
    /// Positions of episodes with a problem.
    bad: HashSet<usize>,
}

impl Findings {
    fn problem(&mut self, episode: Option<usize>, what: String) {
        self.bad.extend(episode);
        self.found.entry((Severity::Problem, what)).or_default().extend(episode);
    }

    fn note(&mut self, episode: Option<usize>, what: String) {
        self.found.entry((Severity::Note, what)).or_default().extend(episode);
    }

    fn sorted(self) -> Vec<Finding> {
        let finding = |((severity, what), episodes)| Finding { severity, what, episodes };
        self.found.into_iter().map(finding).collect()
    }
}

/// Looks at one column of one episode.
fn examine_column(rows: &Batch, column: &str, position: usize, found: &mut Findings) -> Result<()> {
    let (count, spec) = (rows.rows(), &rows.schema().columns()[0]);
    let last = count.saturating_sub(1);
    match column {
        STEP_IDX => {
            let steps = rows.to_f32(STEP_IDX)?;
            if let Some(row) = (0..count.min(1 << 24)).find(|&row| steps[row] != row as f32) {
                found.problem(Some(position), format!("step {} stands in row {row}", steps[row]));
            }
        }
        ACTION if spec.dtype != DType::U8 && spec.dtype != DType::Bool => {
            let float = matches!(spec.dtype, DType::Float32 | DType::Float64);
            let (mut missing, mut broken) = (0, 0);
            for row in 0..count {
                let action = rows.row(row).to_f64(ACTION)?;
                let none = action.iter().all(|&v| if float { v.is_nan() } else { v == -1.0 });
                match row == last {
                    true if !none => {
                        let what = "the last row has an action, from which nothing follows; it is left out of a repaired or \
                                    converted dataset";
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
                found.problem(Some(position), format!("'{column}' has a number that is not finite"));
            }
        }
        "terminated" => {
            let flags = rows.bytes(0);
            if flags.iter().take(last.saturating_sub(1)).any(|&flag| flag != 0) {
                found.note(Some(position), "it goes on after it terminated".to_owned());
            }
        }
        _ => {}
    }
    Ok(())
}

/// Whether a column is there and holds pictures.
fn is_picture(schema: &Schema, name: &str) -> bool {
    schema.column(name).is_ok_and(ColumnSpec::is_image)
}
