//! [`FormatBench`]: what each format of datasets costs: clips loaded per second with and without a cache, the latency of one
//! clip, and the disk space.

use crate::data::{DataBenchConfig, Endless, LAYOUTS, Layout, collect, loader};
use rand::Rng as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;
use swm_core::columns::{ACTION, PIXELS};
use swm_core::results::Summary;
use swm_core::run::Control;
use swm_core::{EnvChoice, Error, Key, Result, limits};
use swm_data::{CacheConfig, ConvertMode, ConvertOptions, Location, Reader, StepRange, convert, open};
use tempfile::TempDir;

/// The number of clips whose latency is measured.
const LATENCIES: usize = 50;

/// One dataset in all formats, in a temporary folder.
pub struct FormatBench {
    folder: TempDir,
    config: DataBenchConfig,
    rows: usize,
}

/// What a format costs.
#[derive(Clone, Copy, Debug)]
pub struct FormatCost {
    /// Clips per second, read and decoded at every use; the median of the measurements.
    pub clips_per_second: f64,
    /// Clips per second when all decoded frames are in a cache in memory.
    pub cached_clips_per_second: f64,
    /// The median time to read and decode one clip from a random start, on one thread without prefetching, in milliseconds.
    pub latency_ms: f64,
    /// The size of the dataset, in megabytes (10^6 bytes).
    pub megabytes: f64,
}

impl FormatBench {
    /// The layouts that can be measured: a format and a codec.
    pub fn layouts() -> impl Iterator<Item = &'static str> {
        LAYOUTS.iter().map(|layout| layout.name)
    }

    /// Collects the content of all datasets. Uses `config` without its formats, conversions, remote and reference.
    ///
    /// # Errors
    /// When a setting is invalid, the environment or the writer fails, or `control` stops the run.
    pub fn new(env: &EnvChoice, config: DataBenchConfig, control: &mut Control<'_>) -> Result<Self> {
        crate::check_measurements(config.pairs, config.seconds)?;
        limits::BENCHMARK_BYTES.check(limits::product([config.episodes, config.steps, config.size, config.size, 3]))?;
        let folder = tempfile::tempdir().map_err(|e| Error::io("a temporary folder", "creating the folder", e))?;
        let rows = collect(env, &config, &folder.path().join("source.lance"), control)?;
        Ok(Self { folder, config, rows })
    }

    /// Measures a layout, on the local disk or in a folder of an object store.
    ///
    /// # Errors
    /// When there is no such layout, its format is not available or not supported by object stores, writing or reading fails,
    /// or `control` stops the run.
    pub fn measure(&self, layout: &str, remote: Option<&Location>, control: &mut Control<'_>) -> Result<FormatCost> {
        let Some(layout) = LAYOUTS.iter().find(|known| known.name == layout) else {
            return Err(Error::unknown("layout", layout, Self::layouts(), "choose one of the measured layouts"));
        };
        let local = self.written(layout, control)?;
        let target = match remote {
            None => Location::from(&local),
            Some(folder) => {
                let folder = folder.to_string();
                let target = Location::parse(&format!("{}/{}", folder.trim_end_matches('/'), layout.file))?;
                let (mode, codec) = (ConvertMode::Overwrite, layout.codec);
                let options = ConvertOptions { mode, codec, verify: false, ..Default::default() };
                convert(&open(&local)?, &target, &options, control)?;
                target
            }
        };
        let reader = open(&target)?;
        let bytes = 2 * self.rows * self.config.size * self.config.size * 3;
        let [clips_per_second, cached_clips_per_second] = [
            self.rate(&reader, CacheConfig::Off, control)?,
            self.rate(&reader, CacheConfig::Memory { bytes }, control)?,
        ];
        let latency_ms = self.latency(&*reader, control)?;
        Ok(FormatCost { clips_per_second, cached_clips_per_second, latency_ms, megabytes: size(&local)? as f64 / 1e6 })
    }

    /// The local dataset of a layout.
    fn written(&self, layout: &Layout, control: &mut Control<'_>) -> Result<PathBuf> {
        let at = |name: &str| self.folder.path().join(name);
        let path = at(layout.file);
        if !path.exists() {
            write(&at("source.lance"), &path, layout, control)?;
        }
        Ok(path)
    }

    /// Clips per second after one epoch, which fills caches.
    fn rate(&self, reader: &Arc<dyn Reader>, cache: CacheConfig, control: &mut Control<'_>) -> Result<f64> {
        let mut endless = Endless { loader: loader(reader, &self.config, cache)?, epoch: 0 };
        for batch in endless.loader.epoch(0, 0) {
            control.check()?;
            batch?;
        }
        let rates =
            (0..self.config.pairs).map(|_| endless.measure(&self.config, control)).collect::<Result<Vec<_>>>()?;
        Ok(Summary::of(&rates).map_or(0.0, |rates| rates.median))
    }

    fn latency(&self, reader: &dyn Reader, control: &mut Control<'_>) -> Result<f64> {
        let clip = &self.config.clip;
        let span = clip.num_steps * clip.frameskip;
        let long: Vec<(usize, usize)> = reader
            .episodes()
            .iter()
            .map(|episode| episode.length)
            .enumerate()
            .filter(|(_, length)| *length > span)
            .collect();
        if long.is_empty() {
            let given = format!("no episode has more than {span} rows");
            return Err(Error::config("the latency of a clip", given, "collect longer episodes"));
        }
        let (mut rng, mut times) = (Key::new(0).with("latency").rng(), Vec::with_capacity(LATENCIES));
        for _ in 0..LATENCIES {
            control.check()?;
            let (episode, length) = long[rng.random_range(0..long.len())];
            let start = rng.random_range(0..length - span);
            let frames: Vec<StepRange> =
                (0..clip.num_steps).map(|i| StepRange::new(episode, start + i * clip.frameskip, 1)).collect();
            let begun = Instant::now();
            reader.read(&[PIXELS], &frames)?;
            reader.read(&[ACTION], &[StepRange::new(episode, start, span)])?;
            times.push(1e3 * begun.elapsed().as_secs_f64());
        }
        Ok(Summary::of(&times).map_or(0.0, |times| times.median))
    }
}

/// Converts the dataset `source` to the format of a layout.
pub(crate) fn write(source: &Path, path: &Path, layout: &Layout, control: &mut Control<'_>) -> Result<()> {
    let options = ConvertOptions {
        format: Some(layout.format.to_owned()),
        mode: ConvertMode::Overwrite,
        codec: layout.codec,
        verify: false,
        ..ConvertOptions::default()
    };
    convert(&open(source)?, &Location::from(path), &options, control).map(|_| ())
}

/// The size of a file, or of all files of a folder, in bytes.
fn size(path: &Path) -> Result<u64> {
    let io = |error| Error::io(path, "measuring the dataset", error);
    let found = std::fs::symlink_metadata(path).map_err(io)?;
    if !found.is_dir() {
        return Ok(found.len());
    }
    let entries = std::fs::read_dir(path).map_err(io)?;
    entries.map(|entry| size(&entry.map_err(io)?.path())).sum()
}
