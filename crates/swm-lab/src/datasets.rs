//! Datasets: their list, the table of episodes, the values of an episode's columns, and its frames.

use crate::folders::{Folders, new_dataset};
use crate::sources::Source;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};
use swm_core::run::Control;
use swm_core::{ColumnSpec, Error, Result, columns, files};
use swm_data::doctor::{Diagnosis, examine, open_damaged};
use swm_data::views::subset;
use swm_data::{ConvertMode, ConvertOptions, FORMATS, ImageCodec, Location, PreviewOptions, Reader, StepRange};
use tokio::sync::Semaphore;

/// The largest number of elements of a value that is plotted.
pub const MOST_ELEMENTS: usize = 64;
/// The largest number of rows whose rewards are added for a table of episodes.
const MOST_ROWS: usize = 20_000_000;
/// The largest number of rows of an episode that is plotted.
const MOST_STEPS: usize = 100_000;
/// The largest number of values of a column in an episode that is summarised.
const MOST_OF_EPISODE: usize = 1 << 26;
/// The largest number of values of an episode that is plotted, which a small compressed file can exceed.
const MOST_PLOTTED: usize = 1 << 23;
/// The largest number of values that are read at the same time.
const MOST_VALUES: usize = 1 << 20;
/// The largest number of frames of a video, and of its bytes.
const MOST_FRAMES: usize = 5_000;
const MOST_BYTES: u64 = 256 << 20;
/// The quality of frames in the page.
const QUALITY: u8 = 90;
/// How long a reader is kept, so that a dataset that grows is read again.
const KEPT: Duration = Duration::from_secs(5);
/// The same for one at a URI, where opening takes requests.
const KEPT_AT_URI: Duration = Duration::from_secs(60);
/// The number of readers that are kept, and of those at URIs.
const READERS: usize = 4;

/// Returns whether a path is a dataset of a known format.
pub(crate) fn is_dataset(path: &Path) -> bool {
    let suffix = path.extension().and_then(|suffix| suffix.to_str()).unwrap_or_default();
    let known = FORMATS.rows.iter().any(|format| format.suffixes.contains(&suffix));
    let location = Location::from(path.to_owned());
    (known || path.is_dir()) && FORMATS.rows.iter().any(|format| (format.detect)(&location))
}

/// The table of a dataset's episodes, by column; all lists have one element per episode.
#[derive(Debug, Default, Serialize)]
pub struct Episodes {
    /// The index of each episode.
    pub index: Vec<i64>,
    /// Steps, one less than rows.
    pub length: Vec<usize>,
    /// The sum of rewards; empty if the dataset has none.
    pub returns: Vec<f64>,
    /// Whether the last observation satisfies the goal; empty if the dataset does not say.
    pub success: Vec<bool>,
    /// A hash of the table.
    pub key: String,
}

/// Episodes of a dataset to save as another one.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Chosen {
    /// The index of the dataset's folder.
    pub folder: usize,
    /// The dataset.
    pub name: String,
    /// The plain name of the new dataset.
    pub target: String,
    /// Positions of the episodes.
    pub episodes: Vec<usize>,
    /// The key of the table in which they were chosen; none for a dataset that does not open.
    pub key: Option<String>,
}

/// Readers of datasets in some folders and sources. Sources are numbered after the folders.
pub struct Datasets {
    folders: Folders,
    sources: Vec<Source>,
    open: Mutex<Vec<Open>>,
}

/// Where a dataset is, when it was opened, and its reader.
type Open = (Location, Instant, Arc<dyn Reader>);

impl Datasets {
    /// The datasets in these folders and sources.
    pub fn new(folders: Folders, sources: Vec<Source>) -> Self {
        Self { folders, sources, open: Mutex::new(vec![]) }
    }

    /// The datasets of all folders, and the sources, whose datasets are not read. A dataset that does not open has an `error`.
    pub fn list(&self) -> Value {
        let found = self.folders.list(1, is_dataset).into_iter().map(|found| {
            let mut value = match self.open(&found.path.into()).and_then(|reader| summary(&*reader)) {
                Ok(value) => value,
                Err(error) => json!({"error": error.to_string()}),
            };
            value["folder"] = json!(found.folder);
            value["name"] = json!(found.name);
            value
        });
        let folders: Vec<_> = self.folders.paths().iter().map(|path| path.display().to_string()).collect();
        let sources = self.sources.iter().enumerate().map(|(i, source)| {
            let location = source.location().to_string();
            json!({"folder": folders.len() + i, "location": location, "name": source.name()})
        });
        let sources: Vec<_> = sources.collect();
        json!({"folders": folders, "datasets": found.collect::<Vec<_>>(), "sources": sources})
    }

    /// The names of the datasets of a source.
    ///
    /// # Errors
    /// When there is no such source, or its store does not list them.
    pub fn names(&self, folder: usize) -> Result<Vec<String>> {
        let none = || {
            let fix = "reload the page, which lists the sources of the lab";
            Error::config(format!("source {folder}"), "there is no such source", fix)
        };
        self.source(folder).ok_or_else(none)?.list()
    }

    /// The environment, the columns and the counts of a dataset. It is not kept open, because a page asks for those of all.
    ///
    /// # Errors
    /// When there is no such dataset, or it is damaged.
    pub fn summary(&self, folder: usize, name: &str) -> Result<Value> {
        let location = self.location(folder, name)?;
        summary(&*self.known(&location).map_or_else(|| swm_data::open(location), Ok)?)
    }

    /// The limit of work that reads a source; `None` for a folder.
    pub fn limit(&self, folder: usize) -> Option<&Arc<Semaphore>> {
        self.source(folder).map(Source::limit)
    }

    fn source(&self, folder: usize) -> Option<&Source> {
        self.sources.get(folder.checked_sub(self.folders.paths().len())?)
    }

    /// The location of a dataset.
    fn location(&self, folder: usize, name: &str) -> Result<Location> {
        match self.source(folder) {
            Some(source) => source.find(name),
            None => self.path(folder, name).map(Location::from),
        }
    }

    /// Opens a dataset by name.
    ///
    /// # Errors
    /// When there is no such dataset, or it is damaged.
    pub fn get(&self, folder: usize, name: &str) -> Result<Arc<dyn Reader>> {
        self.open(&self.location(folder, name)?)
    }

    /// The path of a dataset in a folder.
    ///
    /// # Errors
    /// When there is no such dataset.
    pub fn path(&self, folder: usize, name: &str) -> Result<PathBuf> {
        self.folders.find(folder, name, 1, is_dataset)
    }

    /// Examines a dataset; one that does not open is read as far as possible.
    ///
    /// # Errors
    /// When there is no such dataset, no part of it can be opened, or the examination is stopped.
    pub fn examine(&self, folder: usize, name: &str, control: &mut Control<'_>) -> Result<Diagnosis> {
        let (reader, lost) = open_damaged(&self.location(folder, name)?)?;
        let mut diagnosis = examine(&*reader, &[], control)?;
        diagnosis.add_losses(lost);
        Ok(diagnosis)
    }

    /// Writes the chosen episodes of a dataset as a new one, in the first folder; the dataset itself stays as it is.
    ///
    /// # Errors
    /// When an episode does not exist, the name is not a plain one or is taken, or reading or writing fails.
    pub fn save(&self, chosen: Chosen, control: &mut Control<'_>) -> Result<usize> {
        let first = self.folders.paths().first();
        let folder =
            first.ok_or_else(|| Error::config("saving", "the lab has no folder of datasets", "set STABLEWM_HOME"))?;
        let target = Location::from(new_dataset(folder, &chosen.target)?);
        let (reader, lost) = open_damaged(&self.location(chosen.folder, &chosen.name)?)?;
        let key = if lost.is_empty() { Some(episodes(&*reader)?.key) } else { None };
        if key != chosen.key {
            let problem = "it has other episodes than when the page listed them";
            return Err(Error::config(chosen.name, problem, "reload the page, and choose the episodes again"));
        }
        let options = ConvertOptions { mode: ConvertMode::Create, ..ConvertOptions::default() };
        Ok(swm_data::convert(&subset(reader, chosen.episodes)?, &target, &options, control)?.episodes)
    }

    /// The reader of a dataset that is open.
    fn known(&self, location: &Location) -> Option<Arc<dyn Reader>> {
        let mut open = self.open.lock().unwrap_or_else(PoisonError::into_inner);
        open.retain(|(known, since, _)| since.elapsed() < if known.path().is_some() { KEPT } else { KEPT_AT_URI });
        open.iter().find(|(known, ..)| known == location).map(|(.., reader)| Arc::clone(reader))
    }

    fn open(&self, location: &Location) -> Result<Arc<dyn Reader>> {
        if let Some(reader) = self.known(location) {
            return Ok(reader);
        }
        let reader = swm_data::open(location)?;
        let mut open = self.open.lock().unwrap_or_else(PoisonError::into_inner);
        // A list opens every dataset of the folders; those at URIs stay.
        let is_same_kind = |(known, ..): &Open| known.path().is_some() == location.path().is_some();
        if open.iter().filter(|known| is_same_kind(known)).count() >= READERS
            && let Some(oldest) = open.iter().position(is_same_kind)
        {
            open.remove(oldest);
        }
        open.push((location.clone(), Instant::now(), Arc::clone(&reader)));
        Ok(reader)
    }
}

/// The environment, the columns and the counts of a dataset.
fn summary(reader: &dyn Reader) -> Result<Value> {
    let manifest = reader.manifest();
    let columns = reader.schema().columns().iter().map(|column| {
        json!({"name": column.name, "dtype": column.dtype.name(), "shape": column.shape, "image": column.is_image()})
    });
    Ok(json!({
        "env": manifest.as_ref().and_then(|manifest| manifest.config["env"].as_str()),
        "policy": manifest.as_ref().map(|manifest| &manifest.config["policy"]),
        "kind": manifest.as_ref().map(|manifest| &manifest.kind),
        "episodes": reader.episodes().len(),
        "steps": reader.episodes().iter().map(|episode| episode.length).sum::<usize>(),
        "bytes": reader.footprint()?.iter().map(|(_, bytes)| bytes).sum::<u64>(),
        "columns": columns.collect::<Vec<_>>(),
    }))
}

/// Reads the table of all episodes.
///
/// # Errors
/// When the dataset is damaged.
pub fn episodes(reader: &dyn Reader) -> Result<Episodes> {
    let all = reader.episodes();
    let rows: usize = all.iter().map(|episode| episode.length).sum();
    let mut table = Episodes {
        index: all.iter().map(|episode| episode.index).collect(),
        length: all.iter().map(|episode| episode.length.saturating_sub(1)).collect(),
        ..Episodes::default()
    };
    let is_scalar = |name: &str| reader.schema().column(name).is_ok_and(|column| column.len() == 1);
    if is_scalar(columns::REWARD) && rows <= MOST_ROWS {
        let ranges: Vec<_> = all.iter().enumerate().map(|(i, episode)| StepRange::new(i, 0, episode.length)).collect();
        let rewards = reader.read(&[columns::REWARD], &ranges)?.to_f32(columns::REWARD)?;
        let mut rest = &rewards[..];
        for episode in all {
            let (own, others) = rest.split_at(episode.length.min(rest.len()));
            // NaN is no JSON: a reward that is missing counts as zero.
            table.returns.push(own.iter().filter(|reward| reward.is_finite()).map(|&reward| f64::from(reward)).sum());
            rest = others;
        }
    }
    if is_scalar(columns::SUCCESS) {
        let last = |(i, episode): (usize, &swm_data::Episode)| StepRange::new(i, episode.length.saturating_sub(1), 1);
        let ranges: Vec<_> = all.iter().enumerate().map(last).collect();
        let values = reader.read(&[columns::SUCCESS], &ranges)?.to_f32(columns::SUCCESS)?;
        table.success = values.iter().map(|&value| value > 0.0).collect();
    }
    table.key = swm_core::manifest::hash(&serde_json::to_vec(&table).unwrap_or_default());
    Ok(table)
}

/// What an element of a column is in every episode; values that are not finite are left out, and `None` stands for an episode of
/// these alone.
#[derive(Debug, Default, Serialize)]
pub struct Values {
    /// The smallest value.
    pub min: Vec<Option<f64>>,
    /// The largest value.
    pub max: Vec<Option<f64>>,
    /// The mean.
    pub mean: Vec<Option<f64>>,
}

/// Reads what an element of a column is in every episode. A factor of variation is constant, so that its first row is read.
///
/// # Errors
/// When there is no such column or element, the dataset is too large, or it is damaged.
pub fn values(reader: &dyn Reader, column: &str, element: usize) -> Result<Values> {
    let spec = reader.schema().column(column)?;
    let (count, is_factor) = (spec.len(), column.starts_with(&columns::factor("")));
    if spec.is_image() || count > MOST_ELEMENTS || element >= count {
        let problem = format!("it has {count} elements, or holds images");
        return Err(Error::config(
            format!("element {element} of '{column}'"),
            problem,
            "choose another column or element",
        ));
    }
    let all = reader.episodes();
    let length = |episode: &swm_data::Episode| if is_factor { episode.length.min(1) } else { episode.length };
    let rows: usize = all.iter().map(length).sum();
    if rows > MOST_ROWS {
        let problem = format!("the episodes have {rows} rows, more than {MOST_ROWS}");
        return Err(Error::config(format!("column '{column}'"), problem, "read it in a program"));
    }
    if let Some(values) =
        all.iter().map(|episode| length(episode).saturating_mul(count)).find(|&values| values > MOST_OF_EPISODE)
    {
        let problem = format!("an episode has {values} values, more than {MOST_OF_EPISODE}");
        return Err(Error::config(format!("column '{column}'"), problem, "read it in a program"));
    }
    let (mut found, mut ranges, mut waiting) = (Values::default(), vec![], 0);
    for (position, episode) in all.iter().enumerate() {
        ranges.push(StepRange::new(position, 0, length(episode)));
        waiting += length(episode) * count;
        if waiting >= MOST_VALUES || position + 1 == all.len() {
            found.read(reader, column, (element, count), &ranges)?;
            ranges.clear();
            waiting = 0;
        }
    }
    Ok(found)
}

impl Values {
    /// Adds some episodes.
    fn read(
        &mut self,
        reader: &dyn Reader,
        column: &str,
        (element, count): (usize, usize),
        ranges: &[StepRange],
    ) -> Result<()> {
        let values = reader.read(&[column], ranges)?.to_f32(column)?;
        let mut rest = &values[..];
        for range in ranges {
            let (own, others) = rest.split_at((range.length * count).min(rest.len()));
            let own = own.iter().skip(element).step_by(count).filter(|value| value.is_finite()).map(|&v| f64::from(v));
            let (sum, number) = own.clone().fold((0.0, 0_usize), |(sum, number), value| (sum + value, number + 1));
            self.min.push(own.clone().reduce(f64::min));
            self.max.push(own.reduce(f64::max));
            self.mean.push((number > 0).then(|| sum / number as f64));
            rest = others;
        }
        Ok(())
    }
}

/// Makes the video of an episode as `swm preview` does: MP4, with the images of a column, or of all if it is empty. Its files are
/// in a folder inside `scratch` meanwhile.
///
/// # Errors
/// When there is no such episode, it is too long, it has no images, or this build has no FFmpeg.
pub fn video(reader: Arc<dyn Reader>, column: &str, episode: usize, scratch: &Path) -> Result<Vec<u8>> {
    let length = episode_length(&*reader, episode)?;
    if length > MOST_FRAMES {
        let problem = format!("it has {length} rows, more than {MOST_FRAMES}");
        return Err(Error::config(format!("the video of episode {episode}"), problem, "use swm preview"));
    }
    let folder =
        tempfile::tempdir_in(scratch).map_err(|error| Error::external("making a folder for a video", error))?;
    let columns = if column.is_empty() { vec![] } else { vec![column.to_owned()] };
    let options = PreviewOptions { episodes: 1, columns, ..PreviewOptions::default() };
    let written = swm_data::preview(&*subset(reader, vec![episode])?, folder.path(), &options, |_| ())?;
    let video = written.iter().find(|path| path.extension().is_some_and(|end| end == "mp4"));
    let none = || Error::config(format!("episode {episode}"), "it has no frames", "choose another episode");
    files::read(video.ok_or_else(none)?, MOST_BYTES)
}

/// Whether a column is plotted.
fn is_plotted(column: &ColumnSpec) -> bool {
    let hidden = [columns::EPISODE_IDX, columns::STEP_IDX, columns::EPISODE_SEED, columns::SEED];
    !column.is_image() && column.len() <= MOST_ELEMENTS && !column.is_empty() && !hidden.contains(&column.name.as_str())
}

/// Reads the values of the columns of an episode that are plotted, `[rows, elements]` each. Values that are not finite are
/// null.
///
/// # Errors
/// When there is no such episode, it is too long, or the dataset is damaged.
pub fn rows(reader: &dyn Reader, episode: usize) -> Result<Value> {
    let length = episode_length(reader, episode)?;
    if length > MOST_STEPS {
        let problem = format!("it has {length} rows, more than {MOST_STEPS}");
        return Err(Error::config(format!("episode {episode}"), problem, "read it in a program"));
    }
    let names: Vec<&str> = reader
        .schema()
        .columns()
        .iter()
        .filter(|column| is_plotted(column))
        .map(|column| column.name.as_str())
        .collect();
    let elements = |name: &&str| reader.schema().column(name).map(ColumnSpec::len);
    let values = names.iter().map(elements).sum::<Result<usize>>()?.saturating_mul(length);
    if values > MOST_PLOTTED {
        let problem = format!("its columns have {values} values, more than {MOST_PLOTTED}");
        return Err(Error::config(format!("episode {episode}"), problem, "read it in a program"));
    }
    let batch = reader.read(&names, &[StepRange::new(episode, 0, length)])?;
    let columns: Result<Vec<Value>> = names
        .iter()
        .map(|name| {
            let elements = batch.schema().column(name)?.len();
            Ok(json!({"name": name, "elements": elements, "values": batch.to_f32(name)?}))
        })
        .collect();
    Ok(json!({"rows": length, "columns": columns?}))
}

/// The number of rows of an episode.
fn episode_length(reader: &dyn Reader, episode: usize) -> Result<usize> {
    let length = reader.episodes().get(episode).map(|episode| episode.length);
    length.ok_or_else(|| {
        let fix = format!("the dataset has {} episodes", reader.episodes().len());
        Error::config(format!("episode {episode}"), "there is no such episode", fix)
    })
}

/// Reads a frame as JPEG.
///
/// # Errors
/// When there is no such frame, the column holds no images, or the stored frame is damaged.
pub fn frame(reader: &dyn Reader, column: &str, episode: usize, row: usize) -> Result<Vec<u8>> {
    let spec = reader.schema().column(column)?.clone();
    let [height, width, 3] = spec.shape[..] else {
        return Err(Error::config(format!("column '{column}'"), "it holds no images", "choose a column of images"));
    };
    if !spec.is_image() || row >= episode_length(reader, episode)? {
        return Err(Error::config(format!("row {row} of '{column}'"), "there is no such frame", "choose another row"));
    }
    let mut rgb = vec![0; spec.row_bytes()];
    reader.read_column(column, &[StepRange::new(episode, row, 1)], &mut rgb)?;
    let mut jpeg = vec![];
    ImageCodec::Jpeg { quality: QUALITY }.encode(&rgb, height, width, &mut jpeg)?;
    Ok(jpeg)
}
