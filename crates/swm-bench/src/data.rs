//! How fast clips are loaded and datasets converted, beside the reference where it is installed.
//!
//! One collection of a world is the content of every dataset: ours are written by our writers, the reference's by its
//! own. As in [`bench`](mod@crate::envs), turns alternate and the median of the ratios of neighbouring turns counts. The
//! reference loads in its own process or with worker processes, whichever a first turn of each finds to be faster.

use crate::reference::{Reference, not_compared, reference_python};
use serde::Serialize;
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;
use swm_core::results::Summary;
use swm_core::run::Control;
use swm_core::{EnvChoice, Error, Named as _, RandomPolicy, Result};
use swm_data::{
    CacheConfig, ClipSpec, ConvertMode, ConvertOptions, FORMATS, ImageCodec, Loader, LoaderConfig, Location, Reader,
    WriteOptions, convert, create, open,
};
use swm_eval::{CollectConfig, World, WorldConfig};

/// What to measure.
#[derive(Clone, Debug)]
pub struct DataBenchConfig {
    /// Episodes of the datasets.
    pub episodes: usize,
    /// Steps of an episode.
    pub steps: usize,
    /// The side of the square pictures, in pixels.
    pub size: usize,
    /// The clips that are loaded.
    pub clip: ClipSpec,
    /// Clips in a batch.
    pub batch_size: usize,
    /// Threads of our loader.
    pub threads: usize,
    /// Numbers of worker processes that the reference is tried with.
    pub workers: Vec<usize>,
    /// Pairs of turns, ours and the reference's.
    pub pairs: usize,
    /// Seconds of a turn of loading.
    pub seconds: f64,
    /// Names of the formats to load from; all there are for none.
    pub formats: Vec<String>,
    /// Whether conversions are measured.
    pub convert: bool,
    /// Epochs over which the use of memory is watched; 0 leaves it out.
    pub epochs: usize,
    /// A folder of an object store to load from beside this machine's disk, if there is one.
    pub remote: Option<Location>,
    /// A Python with the reference, if there is one.
    pub python: Option<PathBuf>,
}

impl Default for DataBenchConfig {
    /// The setting of the reference's own figures: clips of 4 frames, 5 steps apart, at 224 pixels, 64 in a batch.
    fn default() -> Self {
        let columns = ["pixels", "action"].map(str::to_owned).to_vec();
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

/// What was measured.
#[derive(Clone, Debug, Serialize)]
pub struct DataBenchReport {
    /// The environment whose pictures are loaded.
    pub env: String,
    /// Episodes and rows of the datasets.
    pub episodes: usize,
    /// Rows of all episodes.
    pub rows: usize,
    /// Frames of a clip, rows between them, clips of a batch.
    pub clip: [usize; 3],
    /// Threads of our loader.
    pub threads: usize,
    /// The reference's version, or why it is not compared.
    pub reference: String,
    /// One entry for everything that was measured.
    pub rates: Vec<DataBenchRow>,
    /// Bytes this process held in memory after every epoch of loading from Lance.
    pub resident: Vec<u64>,
}

/// One thing beside the reference's way of doing it.
#[derive(Clone, Debug, Serialize)]
pub struct DataBenchRow {
    /// What was done: `load` or `convert`.
    pub work: &'static str,
    /// With which format and codec.
    pub what: String,
    /// What the reference did beside it, or why it did nothing.
    pub beside: String,
    /// Clips or conversions a second in each of our turns.
    pub ours: Vec<f64>,
    /// The same in each of the reference's turns; empty without it.
    pub reference: Vec<f64>,
    /// The median of our turns.
    pub rate: f64,
    /// The median ratio of neighbouring turns: how many times faster ours is.
    pub ratio: Option<f64>,
}

/// A dataset of ours to load, and the reference's format beside it.
struct Layout {
    name: &'static str,
    format: &'static str,
    codec: ImageCodec,
    /// The name its folder or file has.
    place: &'static str,
    beside: &'static str,
    their_place: &'static str,
}

const JPEG: ImageCodec = ImageCodec::Jpeg { quality: 95 };

/// Every format that the reference has, and those of ours it has none of beside its Lance. The reference's Lance holds
/// JPEG, whatever ours does.
const LAYOUTS: [Layout; 6] = [
    layout("lance, jpeg", "lance", JPEG, "jpeg.lance", "lance", "theirs.lance"),
    layout("lance, lossless", "lance", LOSSLESS, "lossless.lance", "lance", "theirs.lance"),
    layout("lance-video", "lance-video", LOSSLESS, "ours.lance-video", "lance", "theirs.lance"),
    layout("hdf5", "hdf5", LOSSLESS, "ours.h5", "hdf5", "theirs.h5"),
    layout("video", "video", LOSSLESS, "ours.video", "video", "their-video"),
    layout("folder", "folder", JPEG, "ours.folder", "folder", "their-folder"),
];

/// What pictures are stored as unless somebody asks for something else.
const LOSSLESS: ImageCodec = ImageCodec::Qoi;

const fn layout(
    name: &'static str,
    format: &'static str,
    codec: ImageCodec,
    place: &'static str,
    beside: &'static str,
    their_place: &'static str,
) -> Layout {
    Layout { name, format, codec, place, beside, their_place }
}

/// Measures loading from every format, converting, and what the process holds in memory over some epochs.
///
/// # Errors
/// When a number makes no sense, the world or a writer fails, or the reference stops answering. What the reference cannot
/// do is no error: the row says so.
pub fn bench_data(env: &EnvChoice, config: &DataBenchConfig) -> Result<DataBenchReport> {
    if config.pairs == 0 || !(config.seconds > 0.0 && config.seconds.is_finite()) {
        let given = format!("{} pairs of turns of {} seconds", config.pairs, config.seconds);
        return Err(Error::config("benchmark", given, "ask for at least 1 pair of more than 0 seconds"));
    }
    let folder = tempfile::tempdir().map_err(|e| Error::io("a temporary folder", "making it for datasets", e))?;
    let at = |name: &str| folder.path().join(name);
    // PNG is what both sides read without loss.
    let source = at("source.lance");
    let rows = collect(env, config, &source)?;
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
    let wanted = |layout: &&Layout| {
        let known = FORMATS.rows.iter().any(|format| format.id() == layout.format && format.is_available());
        known && (config.formats.is_empty() || config.formats.iter().any(|name| name == layout.format))
    };
    for layout in LAYOUTS.iter().filter(wanted) {
        let path = at(layout.place);
        write(&source, &path, layout)?;
        let mut theirs = match &mut reference {
            Some(reference) => Theirs::new(reference, config, &source, layout, &at(layout.their_place)),
            None => Err("no reference".to_owned()),
        };
        report.rates.push(load(layout.name, &path, config, CacheConfig::Off, theirs.as_mut())?);
        if layout.name == "lance, jpeg" {
            let decoded = rows * config.size * config.size * 3;
            let kept = [
                ("all kept in memory", CacheConfig::Memory { bytes: 2 * decoded }),
                ("a tenth kept in memory", CacheConfig::Memory { bytes: decoded / 10 }),
                ("all kept on disk", CacheConfig::Disk { folder: at("cache"), bytes: 2 * decoded }),
            ];
            for (what, cache) in kept {
                let what = format!("{}, {what}", layout.name);
                report.rates.push(load(&what, &path, config, cache, theirs.as_mut())?);
            }
            report.rates.extend(remote(&path, config)?);
            for _ in 0..config.epochs {
                epoch(&open(&path)?, config, report.resident.len() as u64)?;
                report.resident.extend(resident());
            }
        }
    }
    if config.convert {
        // Both sides read the same dataset, the reference's own where there is one.
        let jpeg = [at("theirs.lance"), at("jpeg.lance")].into_iter().find(|path| path.exists());
        for layout in LAYOUTS.iter().filter(wanted).filter(|layout| ["hdf5", "video"].contains(&layout.format)) {
            for (what, verify) in [("", false), (", verified", true)] {
                let what = format!("lance to {}{what}", layout.name);
                let source = jpeg.as_deref().unwrap_or(&source);
                let place = at("converted");
                report.rates.push(converting(&what, verify, source, layout, &place, config, reference.as_mut())?);
            }
        }
    }
    Ok(report)
}

/// Collects the content of all datasets: how many rows it has.
fn collect(env: &EnvChoice, config: &DataBenchConfig, path: &Path) -> Result<usize> {
    let image = Some((config.size, config.size));
    let world = WorldConfig { image, max_episode_steps: Some(config.steps), ..WorldConfig::default() };
    let mut world = World::new(env.clone(), world)?;
    let collected =
        CollectConfig { episodes: config.episodes, policy: "random".to_owned(), ..CollectConfig::default() };
    let options = WriteOptions {
        codec: ImageCodec::Png,
        manifest: Some(world.collect_manifest(&collected)),
        ..WriteOptions::default()
    };
    let writer = create(path, &world.collect_schema(false)?, options)?;
    let mut policy = RandomPolicy::new(world.spec(), WorldConfig::default().envs);
    world.collect(&mut policy, writer, &collected, &mut Control::default())?;
    Ok(open(path)?.episodes().iter().map(|episode| episode.length).sum())
}

/// Writes the content in a layout.
fn write(source: &Path, path: &Path, layout: &Layout) -> Result<()> {
    let options = ConvertOptions {
        format: Some(layout.format.to_owned()),
        mode: ConvertMode::Overwrite,
        codec: layout.codec,
        verify: false,
        ..ConvertOptions::default()
    };
    convert(&open(source)?, &Location::from(path), &options, &mut Control::new()).map(|_| ())
}

/// The reference's side of loading.
struct Theirs<'r> {
    reference: &'r mut Reference,
    format: &'static str,
    path: PathBuf,
    workers: usize,
}

impl<'r> Theirs<'r> {
    /// Writes its dataset and finds out how it loads fastest; says why if it cannot.
    fn new(
        reference: &'r mut Reference,
        config: &DataBenchConfig,
        source: &Path,
        layout: &Layout,
        path: &Path,
    ) -> std::result::Result<Self, String> {
        if !path.exists() {
            reference.convert(source, layout.beside, path).map_err(|error| error.to_string())?;
        }
        let mut theirs = Self { reference, format: layout.beside, path: path.to_owned(), workers: 0 };
        let mut best = 0.0;
        for &workers in &config.workers {
            let tried = Self::load(theirs.reference, theirs.format, path, workers, config);
            let rate = tried.map_err(|error| error.to_string())?;
            if rate > best {
                (best, theirs.workers) = (rate, workers);
            }
        }
        Ok(theirs)
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

    fn turn(&mut self, config: &DataBenchConfig) -> Result<f64> {
        Self::load(self.reference, self.format, &self.path, self.workers, config)
    }
}

fn loader(reader: &Arc<dyn Reader>, config: &DataBenchConfig, cache: CacheConfig) -> Result<Loader> {
    let (clip, batch_size, threads) = (config.clip.clone(), config.batch_size, config.threads);
    let config = LoaderConfig { clip, batch_size, threads, drop_last: true, cache, ..LoaderConfig::default() };
    Loader::new(Arc::clone(reader), config)
}

/// Alternates turns of loading.
fn load(
    what: &str,
    path: &Path,
    config: &DataBenchConfig,
    cache: CacheConfig,
    theirs: std::result::Result<&mut Theirs<'_>, &mut String>,
) -> Result<DataBenchRow> {
    let mut endless = Endless { loader: loader(&open(path)?, config, cache)?, epoch: 0 };
    // Once through everything: what can be kept is kept, buffers are there.
    for batch in endless.loader.epoch(0, 0) {
        batch?;
    }
    let beside = match &theirs {
        Ok(theirs) => format!("{}, {} workers", theirs.format, theirs.workers),
        Err(why) => format!("not compared: {why}"),
    };
    let mut theirs = theirs.ok();
    let (mut ours, mut reference) = (vec![], vec![]);
    for _ in 0..config.pairs {
        ours.push(endless.turn(config)?);
        if let Some(theirs) = &mut theirs {
            reference.push(theirs.turn(config)?);
        }
    }
    Ok(DataBenchRow::new("load", what.to_owned(), beside, ours, reference))
}

/// Alternates turns of loading from the object store and from this machine's disk.
fn remote(local: &Path, config: &DataBenchConfig) -> Result<Option<DataBenchRow>> {
    let Some(place) = &config.remote else { return Ok(None) };
    let target = Location::parse(&format!("{}/bench.lance", place.to_string().trim_end_matches('/')))?;
    let options = ConvertOptions { mode: ConvertMode::Overwrite, codec: JPEG, verify: false, ..Default::default() };
    convert(&open(local)?, &target, &options, &mut Control::new())?;
    let mut loaders =
        [loader(&open(&target)?, config, CacheConfig::Off)?, loader(&open(local)?, config, CacheConfig::Off)?]
            .map(|loader| Endless { loader, epoch: 0 });
    let (mut there, mut here) = (vec![], vec![]);
    for _ in 0..=config.pairs {
        there.push(loaders[0].turn(config)?);
        here.push(loaders[1].turn(config)?);
    }
    // The first turn of each warms up.
    let beside = "this machine's disk".to_owned();
    let row =
        DataBenchRow::new("load", format!("lance, jpeg, from {place}"), beside, there.split_off(1), here.split_off(1));
    Ok(Some(row))
}

/// A loader that begins anew where an epoch ends.
struct Endless {
    loader: Loader,
    epoch: u64,
}

impl Endless {
    /// Loads for about so long, after one batch that is not counted: clips a second.
    fn turn(&mut self, config: &DataBenchConfig) -> Result<f64> {
        self.epoch += 1;
        let mut batches = (self.epoch..).flat_map(|epoch| self.loader.epoch(epoch, 0));
        let mut next = || batches.next().unwrap_or_else(|| Err(Error::external("loading", "an epoch has no batch")));
        next()?;
        let (begun, mut clips) = (Instant::now(), 0);
        while begun.elapsed().as_secs_f64() < config.seconds {
            clips += next()?.rows();
        }
        Ok(clips as f64 / begun.elapsed().as_secs_f64())
    }
}

/// One whole epoch.
fn epoch(reader: &Arc<dyn Reader>, config: &DataBenchConfig, epoch: u64) -> Result<()> {
    for batch in loader(reader, config, CacheConfig::Off)?.epoch(epoch, 0) {
        batch?;
    }
    Ok(())
}

/// Bytes of memory this process holds, where the system tells.
fn resident() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"))?;
    line.split_whitespace().next()?.parse::<u64>().ok().map(|kib| kib * 1024)
}

/// Alternates turns of converting.
fn converting(
    what: &str,
    verify: bool,
    source: &Path,
    layout: &Layout,
    place: &Path,
    config: &DataBenchConfig,
    mut reference: Option<&mut Reference>,
) -> Result<DataBenchRow> {
    let (mut ours, mut theirs) = (vec![], vec![]);
    let mut beside = if reference.is_some() { layout.beside.to_owned() } else { "not compared".to_owned() };
    std::fs::create_dir_all(place).map_err(|e| Error::io(place, "making a folder", e))?;
    let (our_place, their_place) = (place.join(layout.place), place.join(layout.their_place));
    for _ in 0..config.pairs {
        let options = ConvertOptions {
            format: Some(layout.format.to_owned()),
            mode: ConvertMode::Overwrite,
            codec: layout.codec,
            verify,
            ..ConvertOptions::default()
        };
        let begun = Instant::now();
        convert(&open(source)?, &Location::from(&our_place), &options, &mut Control::new())?;
        ours.push(1.0 / begun.elapsed().as_secs_f64());
        if let Some(asked) = &mut reference {
            match asked.convert(source, layout.beside, &their_place) {
                Ok(rate) => theirs.push(rate),
                Err(error) => {
                    beside = format!("not compared: {error}");
                    reference = None;
                }
            }
        }
    }
    Ok(DataBenchRow::new("convert", what.to_owned(), beside, ours, theirs))
}

impl DataBenchRow {
    fn new(work: &'static str, what: String, beside: String, ours: Vec<f64>, reference: Vec<f64>) -> Self {
        let ratios: Vec<f64> = ours.iter().zip(&reference).map(|(ours, theirs)| ours / theirs).collect();
        Self {
            work,
            what,
            beside,
            rate: Summary::of(&ours).map_or(0.0, |turns| turns.median),
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
                Some(ratio) => writeln!(f, " {ratio:>6.1} x {} (median of {})", row.beside, row.ours.len())?,
                None => writeln!(f, " {}", row.beside)?,
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
