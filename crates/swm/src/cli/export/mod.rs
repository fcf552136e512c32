//! `swm export`: episodes of a dataset for another program, here the viewer of Rerun.
//!
//! The Python package `rerun-sdk` writes the recording: its Rust library would add 150 crates to this program. It runs in the
//! Python that also runs third-party environments (`to_rerun.py`), and receives messages on its standard input: a line of JSON,
//! followed by as many bytes as its field `bytes` says. The first message is the file, then come episodes, each followed by its
//! columns, then `end`.

use super::{Context, emit, emit_json, output_folder};
use crate::home::open_dataset;
use clap::Args;
use serde_json::{Value, json};
use std::io::{BufRead as _, BufReader, BufWriter, Read as _, Write as _};
use std::os::unix::fs::PermissionsExt as _;
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Stdio};
use std::sync::atomic::Ordering;
use swm_core::columns::{
    self, DEPTH, EPISODE_IDX, EPISODE_SEED, POLICY_INDEX, REWARD, SEGMENTATION, STEP_IDX, SUCCESS, TERMINATED,
    TRUNCATED,
};
use swm_core::files::{self, Lock};
use swm_core::{Batch, ColumnSpec, DType, Error, Result};
use swm_data::preview::spread_episodes;
use swm_data::{ImageCodec, Reader, StepRange};
use swm_gym::Python;
use tempfile::NamedTempFile;

/// Arguments of `swm export`.
#[derive(Args)]
pub struct ExportArgs {
    /// The dataset: a path, a URI or a name
    dataset: String,
    /// The file to write; its suffix .rrd is that of Rerun's recordings
    #[arg(short, long, value_name = "FILE", default_value = "episodes.rrd")]
    output: PathBuf,
    /// Number of episodes, spread over the dataset
    #[arg(long, default_value_t = 4)]
    episodes: usize,
    /// A column to export; may be repeated (default: all)
    #[arg(long)]
    column: Vec<String>,
}

/// Rows with images that are read at once, which limits the memory.
const ROWS: usize = 32;
/// The most elements of a row that become lines of a plot.
const MAX_LINES: usize = 256;
/// The name of this program in recordings.
const APPLICATION: &[u8] = b"stable-worldmodel";

/// Runs `swm export`.
pub fn export(args: &ExportArgs, context: &Context) -> anyhow::Result<()> {
    if args.output.extension().is_none_or(|suffix| suffix != "rrd") {
        let fix = "end it in .rrd, the suffix of Rerun's recordings; `swm convert` writes datasets";
        return Err(Error::config(args.output.display().to_string(), "is no format that swm export writes", fix).into());
    }
    output_folder::check_local(&args.output)?;
    output_folder::check_file(&args.output)?;
    files::check_own(&args.output, is_own)?;
    let reader = open_dataset(&args.dataset)?;
    let (columns, left_out) = chosen_columns(&*reader, &args.column)?;
    let episodes = spread_episodes(&*reader, args.episodes, "export")?;
    let folder = args.output.parent().filter(|folder| *folder != Path::new("")).unwrap_or_else(|| Path::new("."));
    // The recording replaces an older one when it is complete.
    let unfinished = unfinished_recording(folder, &args.output)?;
    let _lock = Lock::file(unfinished.path())?;
    let mut recording = Recording::start(unfinished.path(), &args.dataset)?;
    let written = episodes.iter().try_for_each(|&episode| {
        if context.interrupt.load(Ordering::SeqCst) {
            return Err(Error::Interrupted);
        }
        recording.add(&*reader, episode, &columns)
    });
    recording.finish(written)?;
    let replaced = unfinished.persist(&args.output);
    replaced.map_err(|error| Error::io(&args.output, "writing the recording", error.error))?;
    if context.json {
        let file = args.output.to_string_lossy();
        return emit_json(&json!({"file": file, "episodes": episodes.len(), "left_out": left_out}));
    }
    let file = args.output.display();
    emit(&format!("{} episodes in {file}; `rerun {file}` shows them\n", episodes.len()));
    if !left_out.is_empty() {
        emit(&format!("left out, because a row has more than {MAX_LINES} values: {}\n", left_out.join(", ")));
    }
    Ok(())
}

/// Creates the file in which a recording is written, and deletes those that kills left of the same recording. The file of an export
/// that still runs is locked, and stays.
fn unfinished_recording(folder: &Path, output: &Path) -> Result<NamedTempFile> {
    let io = |error| Error::io(folder, "writing to the folder", error);
    let start = format!(".{}.", output.file_name().unwrap_or_default().to_string_lossy());
    for entry in std::fs::read_dir(folder).map_err(io)?.flatten() {
        let name = entry.file_name();
        let process = name.to_str().and_then(|name| name.strip_prefix(&start)?.strip_suffix(".tmp"));
        let is_regular = || entry.metadata().is_ok_and(|found| found.is_file());
        if process.is_some_and(|process| process.parse::<u32>().is_ok()) && is_regular() {
            let path = entry.path();
            let is_written = is_own(&path) || entry.metadata().is_ok_and(|found| found.len() == 0);
            if is_written && let Ok(_lock) = Lock::file(&path) {
                files::delete_file(&path)?;
            }
        }
    }
    // The permissions of a file that a user makes.
    let (name, readable) = (format!("{start}{}.tmp", std::process::id()), std::fs::Permissions::from_mode(0o666));
    tempfile::Builder::new().prefix(&name).rand_bytes(0).permissions(readable).tempfile_in(folder).map_err(io)
}

/// Returns whether a file is a recording of this program: its header names the application.
fn is_own(path: &Path) -> bool {
    let mut start = vec![];
    let read = files::open(path).is_ok_and(|file| file.take(1 << 12).read_to_end(&mut start).is_ok());
    read && start.starts_with(b"RRF") && start.windows(APPLICATION.len()).any(|part| part == APPLICATION)
}

/// What a column becomes in a recording.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Kind {
    Images,
    Depth,
    Segmentation,
    /// Lines over the steps.
    Values,
    /// A row of the table about the episode.
    Fact,
}

/// A column, and what it becomes.
type Exported = (ColumnSpec, Kind);

impl Kind {
    /// `None` for a column with too many values.
    fn of(column: &ColumnSpec) -> Option<Self> {
        let name = column.name.as_str();
        let is = |modality: &str| name == modality || name.starts_with(&format!("{modality}."));
        let is_plane = column.shape.len() == 2;
        Some(match column.dtype {
            _ if column.is_image() => Self::Images,
            DType::Float32 if is_plane && is(DEPTH) => Self::Depth,
            DType::Int32 if is_plane && is(SEGMENTATION) => Self::Segmentation,
            _ if column.len() > MAX_LINES => return None,
            _ if [EPISODE_SEED, POLICY_INDEX].contains(&name) || columns::is_flat_factor(&columns::flat(name)) => {
                Self::Fact
            }
            _ => Self::Values,
        })
    }

    fn name(self) -> &'static str {
        match self {
            Self::Images => "images",
            Self::Depth => "depth",
            Self::Segmentation => "segmentation",
            Self::Values | Self::Fact => "values",
        }
    }
}

/// Returns the columns to export, and the names of those that are left out.
fn chosen_columns(reader: &dyn Reader, names: &[String]) -> Result<(Vec<Exported>, Vec<String>)> {
    let schema = reader.schema();
    let all = || schema.columns().iter().filter(|column| ![EPISODE_IDX, STEP_IDX].contains(&column.name.as_str()));
    let wanted: Vec<ColumnSpec> = match names {
        [] => all().cloned().collect(),
        _ => names.iter().map(|name| schema.column(name).cloned()).collect::<Result<_>>()?,
    };
    let (mut chosen, mut left_out) = (vec![], vec![]);
    for column in wanted {
        match Kind::of(&column) {
            Some(kind) => chosen.push((column, kind)),
            None => left_out.push(column.name),
        }
    }
    Ok((chosen, left_out))
}

/// A recording that the Python package writes.
struct Recording {
    child: Child,
    input: BufWriter<ChildStdin>,
    answers: BufReader<ChildStdout>,
}

impl Recording {
    /// Starts the package, which writes to `file`.
    fn start(file: &Path, name: &str) -> Result<Self> {
        let python = Python::find();
        let missing = |problem: &str| {
            let fix = format!("install it (pip install rerun-sdk) in {}, or set $SWM_PYTHON", python.program.display());
            Error::config("swm export", problem, fix)
        };
        let mut command = python.script(include_str!("to_rerun.py"));
        // Ctrl-C is for this program, which then ends the package.
        command.process_group(0).env("PYTHONSAFEPATH", "1").stdin(Stdio::piped()).stdout(Stdio::piped());
        let started = command.spawn().map_err(|error| {
            missing(&format!("{} ({}) does not start: {error}", python.program.display(), python.origin))
        });
        let mut child = started?;
        let (Some(input), Some(output)) = (child.stdin.take(), child.stdout.take()) else {
            return Err(missing("Python has no input or output"));
        };
        let mut recording = Self { child, input: BufWriter::new(input), answers: BufReader::new(output) };
        recording.send(&json!({"kind": "start", "file": file, "name": name}), &[]);
        let sent = recording.input.flush();
        let answer = recording.answer();
        if sent.is_ok() && answer == "ready" {
            return Ok(recording);
        }
        drop(recording.child.wait());
        Err(answer.strip_prefix("missing: ").map_or_else(failed, missing))
    }

    /// The next line that the package answers; empty if it has ended.
    fn answer(&mut self) -> String {
        let mut line = String::new();
        let _ = self.answers.read_line(&mut line);
        line.trim_end().to_owned()
    }

    /// Sends a message. A package that has ended says why in [`Self::finish`].
    fn send(&mut self, fields: &Value, bytes: &[u8]) {
        let mut fields = fields.clone();
        fields["bytes"] = json!(bytes.len());
        let _ = writeln!(self.input, "{fields}").and_then(|()| self.input.write_all(bytes));
    }

    /// Adds an episode, at this position of [`Reader::episodes`].
    fn add(&mut self, reader: &dyn Reader, episode: usize, columns: &[Exported]) -> Result<()> {
        let length = reader.episodes()[episode].length;
        let named =
            |wanted: fn(Kind) -> bool| columns.iter().filter(move |(_, kind)| wanted(*kind)).map(|(column, _)| column);
        let small: Vec<&str> =
            named(|kind| matches!(kind, Kind::Values | Kind::Fact)).map(|column| &*column.name).collect();
        let values = reader.read(&small, &[StepRange::new(episode, 0, length)])?;
        let name = format!("episode_{}", reader.episodes()[episode].index);
        let facts = facts(&values, length, named(|kind| kind == Kind::Fact))?;
        self.send(&json!({"kind": "episode", "name": name, "facts": facts}), &[]);
        for (index, column) in small.iter().enumerate() {
            let spec = &values.schema().columns()[index];
            if named(|kind| kind == Kind::Values).any(|column| column == spec) {
                // No action follows the last observation.
                let rows = if *column == columns::ACTION { length - 1 } else { length };
                let bytes = &values.bytes(index)[..rows * spec.row_bytes()];
                self.send(&message(spec, Kind::Values, 0, rows), bytes);
            }
        }
        for (column, kind) in columns.iter().filter(|(_, kind)| !matches!(kind, Kind::Values | Kind::Fact)) {
            for start in (0..length).step_by(ROWS) {
                let rows = ROWS.min(length - start);
                let batch = reader.read(&[column.name.as_str()], &[StepRange::new(episode, start, rows)])?;
                if *kind != Kind::Images {
                    self.send(&message(column, *kind, start, rows), batch.bytes(0));
                } else if self.add_images(column, start, batch.bytes(0))? {
                    break;
                }
            }
        }
        Ok(())
    }

    /// Adds images. Returns whether the first one stands for the whole episode, as that of a goal does.
    fn add_images(&mut self, column: &ColumnSpec, start: usize, rgb: &[u8]) -> Result<bool> {
        let is_goal = columns::goal_source(&column.name).is_some();
        let (mut encoded, mut lengths) = (vec![], vec![]);
        for image in rgb.chunks_exact(column.row_bytes()).take(if is_goal { 1 } else { usize::MAX }) {
            let begin = encoded.len();
            ImageCodec::Png.encode(image, column.shape[0], column.shape[1], &mut encoded)?;
            lengths.push(encoded.len() - begin);
        }
        let mut fields = message(column, Kind::Images, start, lengths.len());
        fields["lengths"] = json!(lengths);
        fields["constant"] = json!(is_goal);
        self.send(&fields, &encoded);
        Ok(is_goal)
    }

    /// Waits until the package has written the file, or ends it if reading the dataset failed.
    fn finish(mut self, written: Result<()>) -> Result<()> {
        if written.is_err() {
            drop((self.child.kill(), self.child.wait()));
            return written;
        }
        self.send(&json!({"kind": "end"}), &[]);
        let flushed = self.input.flush();
        let answer = self.answer();
        let ended = self.child.wait();
        let is_complete = answer == "done" && flushed.is_ok() && ended.is_ok_and(|status| status.success());
        if is_complete { Ok(()) } else { Err(failed()) }
    }
}

/// Returns the message of some rows of a column.
fn message(column: &ColumnSpec, kind: Kind, start: usize, rows: usize) -> Value {
    let name = column.name.as_str();
    // What seldom changes within an episode is in the recording, without a plot of its own.
    let is_plotted = columns::goal_source(name).is_none() && ![TERMINATED, TRUNCATED].contains(&name);
    json!({
        "kind": kind.name(), "column": name, "dtype": column.dtype.name(), "shape": column.shape,
        "start": start, "rows": rows, "plotted": is_plotted,
    })
}

/// Returns what is known about an episode: its length, its outcome, its seed and its factors.
fn facts<'a>(
    values: &Batch,
    length: usize,
    columns: impl Iterator<Item = &'a ColumnSpec>,
) -> Result<Vec<(String, String)>> {
    let mut facts = vec![("steps".to_owned(), (length - 1).to_string())];
    if values.schema().find(SUCCESS).is_some() {
        let succeeded = values.to_f32(SUCCESS)?.iter().any(|&value| value > 0.0);
        facts.push((SUCCESS.to_owned(), if succeeded { "yes" } else { "no" }.to_owned()));
    }
    if values.schema().find(REWARD).is_some() {
        let sum: f64 = values.to_f32(REWARD)?.iter().copied().filter(|reward| reward.is_finite()).map(f64::from).sum();
        facts.push(("return".to_owned(), format!("{sum:.3}")));
    }
    for column in columns {
        let value = values.row(0).to_f64(&column.name)?;
        let text: Vec<String> = value.iter().map(|value| format!("{}", *value as f32)).collect();
        facts.push((column.name.clone(), text.join(", ")));
    }
    Ok(facts)
}

fn failed() -> Error {
    Error::external("writing the recording", "the package rerun-sdk failed; its message is above")
}
