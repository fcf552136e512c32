//! `bench data`: clips loaded per second and datasets converted per second.
//!
//! All datasets have the same content, which the benchmark collects once. This implementation and the reference convert
//! the content to files of their own. The reference loads in one process or with worker processes, depending on which
//! was faster in a first measurement.

use crate::formats::write;
use crate::reference::{Reference, not_compared, reference_python};
use serde::Serialize;
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;
use swm_core::columns::{ACTION, PIXELS};
use swm_core::results::Summary;
use swm_core::run::Control;
use swm_core::{EnvChoice, Error, Named as _, RandomPolicy, Result, limits};
use swm_data::{
    CacheConfig, ClipSpec, ConvertMode, ConvertOptions, FORMATS, ImageCodec, Loader, LoaderConfig, Location, Reader,
    WriteOptions, convert, create, open,
};
use swm_eval::{CollectConfig, World, WorldConfig};

/// Settings of the benchmark.
#[derive(Clone, Debug)]
pub struct DataBenchConfig {
    /// The number of episodes of the datasets.
    pub episodes: usize,
    /// The number of steps of an episode.
    pub steps: usize,
    /// The side length of the square frames, in pixels.
    pub size: usize,
    /// The length, frameskip and columns of the loaded clips.
    pub clip: ClipSpec,
    /// The number of clips in a batch.
    pub batch_size: usize,
    /// The number of threads of this implementation's loader.
    pub threads: usize,
    /// Worker counts of the reference's loader; the fastest count is used.
    pub workers: Vec<usize>,
    /// The number of measurement pairs. A pair is one measurement of this implementation and one of the reference.
    pub pairs: usize,
    /// The duration of a measurement of loading, in seconds.
    pub seconds: f64,
    /// The names of the formats to load from; empty for all formats.
    pub formats: Vec<String>,
    /// Whether conversions are measured.
    pub convert: bool,
    /// The number of epochs over which memory use is measured; 0 skips this measurement.
    pub epochs: usize,
    /// A folder of an object store to compare with the local disk, if any.
    pub remote: Option<Location>,
    /// The Python interpreter of the reference implementation, if any.
    pub python: Option<PathBuf>,
}

impl Default for DataBenchConfig {
    /// The settings of the reference's published rates: clips of 4 frames, 5 steps apart, at 224 pixels, 64 in a batch.
    fn default() -> Self {
        let columns = [PIXELS, ACTION].map(str::to_owned).to_vec();
        Self {
            episodes: 40,
            steps: 100,
            size: 224,
            clip: ClipSpec { num_steps: 4, frameskip: 5, columns },
            batch_size: 64,
            threads: LoaderConfig::default().threads,
            workers: vec![0, 2],
            pairs: 5,
            seconds: 2.0,
            formats: vec![],
            convert: true,
            epochs: 10,
            remote: None,
            python: reference_python(),
        }
    }
}

/// The result of the benchmark.
#[derive(Clone, Debug, Serialize)]
pub struct DataBenchReport {
    /// The environment whose frames are loaded.
    pub env: String,
    /// The number of episodes of the datasets.
    pub episodes: usize,
    /// The number of rows of all episodes.
    pub rows: usize,
    /// The number of frames in a clip, the frameskip, and the number of clips in a batch.
    pub clip: [usize; 3],
    /// The number of threads of this implementation's loader.
    pub threads: usize,
    /// The version of the reference, or the reason why it is not compared.
    pub reference: String,
    /// One entry for each kind of work, format and codec.
    pub rates: Vec<DataBenchRow>,
    /// Memory of this process after every epoch of loading from Lance, in bytes.
    pub resident: Vec<u64>,
}

/// The rates of one kind of work with one format and codec.
#[derive(Clone, Debug, Serialize)]
pub struct DataBenchRow {
    /// The kind of work: `load` or `convert`.
    pub work: &'static str,
    /// The format and codec.
    pub what: String,
    /// The setup of the reference (format, worker count), or the reason why it is not compared.
    #[serde(rename = "beside")]
    pub reference_setup: String,
    /// Clips or conversions per second in each measurement of this implementation.
    pub ours: Vec<f64>,
    /// Clips or conversions per second in each measurement of the reference; empty without a reference.
    pub reference: Vec<f64>,
    /// The median of `ours`.
    pub rate: f64,
    /// The median over measurement pairs of the rate of this implementation divided by the reference's rate.
    pub ratio: Option<f64>,
}

/// A dataset layout to load, and the reference's format to compare with.
pub(crate) struct Layout {
    pub name: &'static str,
    pub format: &'static str,
    pub codec: ImageCodec,
    /// The name of the dataset's folder or file.
    pub file: &'static str,
    /// The format of the reference.
    reference_format: &'static str,
    /// The name of the folder or file of the reference's dataset.
    reference_file: &'static str,
}

const JPEG: ImageCodec = ImageCodec::Jpeg { quality: 95 };

/// Every format. Formats that the reference lacks are compared with the reference's Lance format, which always stores
/// JPEG.
pub(crate) const LAYOUTS: [Layout; 6] = [
    layout("lance, jpeg", "lance", JPEG, "jpeg.lance", "lance", "theirs.lance"),
    layout("lance, lossless", "lance", LOSSLESS, "lossless.lance", "lance", "theirs.lance"),
    layout("lance-video", "lance-video", LOSSLESS, "ours.lance-video", "lance", "theirs.lance"),
    layout("hdf5", "hdf5", LOSSLESS, "ours.h5", "hdf5", "theirs.h5"),
    layout("video", "video", LOSSLESS, "ours.video", "video", "their-video"),
    layout("folder", "folder", JPEG, "ours.folder", "folder", "their-folder"),
];

/// The default codec of frames.
const LOSSLESS: ImageCodec = ImageCodec::Qoi;

const fn layout(
    name: &'static str,
    format: &'static str,
    codec: ImageCodec,
    file: &'static str,
    reference_format: &'static str,
    reference_file: &'static str,
) -> Layout {
    Layout { name, format, codec, file, reference_format, reference_file }
}

/// Measures loading from every format, converting, and memory use over several epochs.
///
/// # Errors
/// When a setting is invalid, an environment or a writer fails, `control` stops the run, or the reference stops
/// answering. Work that the reference cannot do is not an error: the row contains the reason.
#[allow(clippy::too_many_lines, reason = "the list of all measurements, in order")]
pub fn bench_data(env: &EnvChoice, config: &DataBenchConfig, control: &mut Control<'_>) -> Result<DataBenchReport> {
    crate::check_measurements(config.pairs, config.seconds)?;
    limits::BENCHMARK_BYTES.check(limits::product([config.episodes, config.steps, config.size, config.size, 3]))?;
    let folder = tempfile::tempdir().map_err(|e| Error::io("a temporary folder", "creating the folder", e))?;
    let at = |name: &str| folder.path().join(name);
    // The source stores PNG, which is lossless and readable for this implementation and for the reference.
    let source = at("source.lance");
    let rows = collect(env, config, &source, control)?;
    let mut report = DataBenchReport {
        env: env.id(),
        episodes: config.episodes,
        rows,
        clip: [config.clip.num_steps, config.clip.frameskip, config.batch_size],
        threads: config.threads,
        reference: not_compared(),
        rates: vec![],
        resident: vec![],
    };
    let mut reference = None;
    if let Some(python) = &config.python {
        match Reference::start_data(python) {
            Ok(started) => {
                report.reference.clone_from(&started.version);
                reference = Some(started);
            }
            Err(error) => report.reference = format!("not compared: {error}"),
        }
    }
    let selected = |layout: &&Layout| {
        let known = FORMATS.rows.iter().any(|format| format.id() == layout.format && format.is_available());
        known && (config.formats.is_empty() || config.formats.iter().any(|name| name == layout.format))
    };
    for layout in LAYOUTS.iter().filter(selected) {
        let path = at(layout.file);
        write(&source, &path, layout, control)?;
        let mut reference_side = match &mut reference {
            Some(reference) => ReferenceDataset::new(reference, config, &source, layout, &at(layout.reference_file)),
            None => Err("no reference".to_owned()),
        };
        report.rates.push(load(layout.name, &path, config, CacheConfig::Off, reference_side.as_mut(), control)?);
        if layout.name == "lance, jpeg" {
            let decoded = rows * config.size * config.size * 3;
            // The JSON report contains these labels.
            let caches = [
                ("all cached in memory", CacheConfig::Memory { bytes: 2 * decoded }),
                ("a tenth cached in memory", CacheConfig::Memory { bytes: decoded / 10 }),
                ("all cached on disk", CacheConfig::Disk { folder: at("cache"), bytes: 2 * decoded }),
            ];
            for (what, cache) in caches {
                let what = format!("{}, {what}", layout.name);
                report.rates.push(load(&what, &path, config, cache, reference_side.as_mut(), control)?);
            }
            report.rates.extend(remote(&path, config, control)?);
            for _ in 0..config.epochs {
                epoch(&open(&path)?, config, report.resident.len() as u64, control)?;
                report.resident.extend(resident());
            }
        }
    }
    if config.convert {
        // This implementation and the reference convert the same dataset: the Lance dataset of the reference, if it
        // exists.
        let jpeg = [at("theirs.lance"), at("jpeg.lance")].into_iter().find(|path| path.exists());
        for layout in LAYOUTS.iter().filter(selected).filter(|layout| ["hdf5", "video"].contains(&layout.format)) {
            for (what, verify) in [("", false), (", verified", true)] {
                let what = format!("lance to {}{what}", layout.name);
                let source = jpeg.as_deref().unwrap_or(&source);
                let folder = at("converted");
                let reference = reference.as_mut();
                report.rates.push(conversion(&what, verify, source, layout, &folder, config, reference, control)?);
            }
        }
    }
    Ok(report)
}

/// Collects the content of all datasets; returns the number of rows.
pub(crate) fn collect(
    env: &EnvChoice,
    config: &DataBenchConfig,
    path: &Path,
    control: &mut Control<'_>,
) -> Result<usize> {
    let image = Some((config.size, config.size));
    let world = WorldConfig { image, max_episode_steps: Some(config.steps), ..WorldConfig::default() };
    let mut world = World::new(env.clone(), world)?;
    let collected = CollectConfig { episodes: config.episodes, policy: "random".into(), ..CollectConfig::default() };
    let options = WriteOptions {
        codec: ImageCodec::Png,
        manifest: Some(world.collect_manifest(&collected)),
        ..WriteOptions::default()
    };
    let writer = create(path, &world.collect_schema(&collected)?, options)?;
    let mut policy = RandomPolicy::new(world.spec(), WorldConfig::default().envs);
    world.collect(&mut policy, writer, &collected, control)?;
    Ok(open(path)?.episodes().iter().map(|episode| episode.length).sum())
}

/// A dataset that the reference loads.
struct ReferenceDataset<'r> {
    reference: &'r mut Reference,
    format: &'static str,
    path: PathBuf,
    workers: usize,
}

impl<'r> ReferenceDataset<'r> {
    /// Writes the dataset and finds the fastest number of workers; returns the error message of the reference on
    /// failure.
    fn new(
        reference: &'r mut Reference,
        config: &DataBenchConfig,
        source: &Path,
        layout: &Layout,
        path: &Path,
    ) -> std::result::Result<Self, String> {
        if !path.exists() {
            reference.convert(source, layout.reference_format, path).map_err(|error| error.to_string())?;
        }
        let mut dataset = Self { reference, format: layout.reference_format, path: path.to_owned(), workers: 0 };
        let mut best = 0.0;
        for &workers in &config.workers {
            let tried = Self::load(dataset.reference, dataset.format, path, workers, config);
            let rate = tried.map_err(|error| error.to_string())?;
            if rate > best {
                (best, dataset.workers) = (rate, workers);
            }
        }
        Ok(dataset)
    }

    fn load(
        reference: &mut Reference,
        format: &str,
        path: &Path,
        workers: usize,
        config: &DataBenchConfig,
    ) -> Result<f64> {
        reference.load(format, path, workers, &config.clip, config.batch_size, config.seconds)
    }

    fn measure(&mut self, config: &DataBenchConfig) -> Result<f64> {
        Self::load(self.reference, self.format, &self.path, self.workers, config)
    }
}

pub(crate) fn loader(reader: &Arc<dyn Reader>, config: &DataBenchConfig, cache: CacheConfig) -> Result<Loader> {
    let (clip, batch_size, threads) = (config.clip.clone(), config.batch_size, config.threads);
    let config = LoaderConfig { clip, batch_size, threads, drop_last: true, cache, ..LoaderConfig::default() };
    Loader::new(Arc::clone(reader), config)
}

/// Measures loading, alternately by this implementation and by the reference.
fn load(
    what: &str,
    path: &Path,
    config: &DataBenchConfig,
    cache: CacheConfig,
    dataset: std::result::Result<&mut ReferenceDataset<'_>, &mut String>,
    control: &mut Control<'_>,
) -> Result<DataBenchRow> {
    let mut endless = Endless { loader: loader(&open(path)?, config, cache)?, epoch: 0 };
    // The first epoch is a warm-up, which fills caches and buffers.
    for batch in endless.loader.epoch(0, 0) {
        control.check()?;
        batch?;
    }
    let reference_setup = match &dataset {
        Ok(dataset) => format!("{}, {} workers", dataset.format, dataset.workers),
        Err(why) => format!("not compared: {why}"),
    };
    let mut dataset = dataset.ok();
    let (mut ours, mut reference) = (vec![], vec![]);
    for _ in 0..config.pairs {
        ours.push(endless.measure(config, control)?);
        if let Some(dataset) = &mut dataset {
            reference.push(dataset.measure(config)?);
        }
    }
    Ok(DataBenchRow::new("load", what.to_owned(), reference_setup, ours, reference))
}

/// Measures loading, alternately from the object store and from the local disk.
fn remote(local: &Path, config: &DataBenchConfig, control: &mut Control<'_>) -> Result<Option<DataBenchRow>> {
    let Some(folder) = &config.remote else { return Ok(None) };
    let target = Location::parse(&format!("{}/bench.lance", folder.to_string().trim_end_matches('/')))?;
    let options = ConvertOptions { mode: ConvertMode::Overwrite, codec: JPEG, verify: false, ..Default::default() };
    convert(&open(local)?, &target, &options, control)?;
    let mut loaders =
        [loader(&open(&target)?, config, CacheConfig::Off)?, loader(&open(local)?, config, CacheConfig::Off)?]
            .map(|loader| Endless { loader, epoch: 0 });
    let (mut remote, mut local) = (vec![], vec![]);
    for _ in 0..=config.pairs {
        remote.push(loaders[0].measure(config, control)?);
        local.push(loaders[1].measure(config, control)?);
    }
    // The first measurement of each loader is a warm-up.
    let reference_setup = "the local disk".to_owned();
    let row = DataBenchRow::new(
        "load",
        format!("lance, jpeg, from {folder}"),
        reference_setup,
        remote.split_off(1),
        local.split_off(1),
    );
    Ok(Some(row))
}

/// A loader that repeats epochs.
pub(crate) struct Endless {
    pub loader: Loader,
    pub epoch: u64,
}

impl Endless {
    /// Loads for about `config.seconds`, after one batch that is not counted; returns clips per second.
    pub fn measure(&mut self, config: &DataBenchConfig, control: &mut Control<'_>) -> Result<f64> {
        self.epoch += 1;
        let mut batches = (self.epoch..).flat_map(|epoch| self.loader.epoch(epoch, 0));
        let mut next =
            || batches.next().unwrap_or_else(|| Err(Error::external("loading batches", "the epoch has no batch")));
        next()?;
        let (begun, mut clips) = (Instant::now(), 0);
        while begun.elapsed().as_secs_f64() < config.seconds {
            control.check()?;
            clips += next()?.rows();
        }
        Ok(clips as f64 / begun.elapsed().as_secs_f64())
    }
}

/// Loads one epoch.
fn epoch(reader: &Arc<dyn Reader>, config: &DataBenchConfig, epoch: u64, control: &mut Control<'_>) -> Result<()> {
    for batch in loader(reader, config, CacheConfig::Off)?.epoch(epoch, 0) {
        control.check()?;
        batch?;
    }
    Ok(())
}

/// The resident memory of this process in bytes, on systems that report it.
fn resident() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"))?;
    line.split_whitespace().next()?.parse::<u64>().ok().map(|kib| kib * 1024)
}

/// Measures conversions, alternately by this implementation and by the reference.
#[allow(clippy::too_many_arguments, reason = "a part of `bench_data` that uses its state")]
fn conversion(
    what: &str,
    verify: bool,
    source: &Path,
    layout: &Layout,
    folder: &Path,
    config: &DataBenchConfig,
    mut reference: Option<&mut Reference>,
    control: &mut Control<'_>,
) -> Result<DataBenchRow> {
    let (mut ours, mut theirs) = (vec![], vec![]);
    let mut reference_setup =
        if reference.is_some() { layout.reference_format.to_owned() } else { "not compared".to_owned() };
    std::fs::create_dir_all(folder).map_err(|e| Error::io(folder, "creating a folder", e))?;
    let (our_path, reference_path) = (folder.join(layout.file), folder.join(layout.reference_file));
    for _ in 0..config.pairs {
        let options = ConvertOptions {
            format: Some(layout.format.to_owned()),
            mode: ConvertMode::Overwrite,
            codec: layout.codec,
            verify,
            ..ConvertOptions::default()
        };
        let begun = Instant::now();
        convert(&open(source)?, &Location::from(&our_path), &options, control)?;
        ours.push(1.0 / begun.elapsed().as_secs_f64());
        if let Some(process) = &mut reference {
            match process.convert(source, layout.reference_format, &reference_path) {
                Ok(rate) => theirs.push(rate),
                Err(error) => {
                    reference_setup = format!("not compared: {error}");
                    reference = None;
                }
            }
        }
    }
    Ok(DataBenchRow::new("convert", what.to_owned(), reference_setup, ours, theirs))
}

impl DataBenchRow {
    fn new(work: &'static str, what: String, reference_setup: String, ours: Vec<f64>, reference: Vec<f64>) -> Self {
        let ratios: Vec<f64> = ours.iter().zip(&reference).map(|(ours, theirs)| ours / theirs).collect();
        Self {
            work,
            what,
            reference_setup,
            rate: Summary::of(&ours).map_or(0.0, |summary| summary.median),
            ratio: Summary::of(&ratios).map(|ratios| ratios.median),
            ours,
            reference,
        }
    }
}

impl fmt::Display for DataBenchReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [steps, skip, batch] = self.clip;
        writeln!(
            f,
            "{}: {} episodes, {} rows; clips of {steps} frames with frameskip {skip}, {batch} a batch, {} threads; reference: {}",
            self.env, self.episodes, self.rows, self.threads, self.reference
        )?;
        for row in &self.rates {
            let unit = if row.work == "load" { "clips/s" } else { "a second" };
            write!(f, "{:<8} {:<36} {:>9.2} {unit:<9}", row.work, row.what, row.rate)?;
            match row.ratio {
                Some(ratio) => writeln!(f, " {ratio:>6.1} x {} (median of {})", row.reference_setup, row.ours.len())?,
                None => writeln!(f, " {}", row.reference_setup)?,
            }
        }
        if let [first, .., last] = self.resident[..] {
            let mib = |bytes: u64| bytes >> 20;
            let epochs = self.resident.len();
            writeln!(f, "memory: {} MiB after the first epoch, {} MiB after {epochs}", mib(first), mib(last))?;
        }
        Ok(())
    }
}
