//! `swm convert`: writes a dataset in another format or codec, and compares the result with the source.

use super::config::CodecArgs;
use super::datasets::bytes;
use super::progress::control;
use super::{Context, emit, emit_json};
use crate::home;
use clap::{Args, ValueEnum};
use std::time::Instant;
use swm_core::Result;
use swm_data::{ConvertMode, ConvertOptions, Converted, Location};

/// Arguments of `swm convert`.
#[derive(Args)]
pub struct ConvertArgs {
    /// The dataset to read: a path, a URI or a name
    pub(super) source: String,
    /// The dataset to write: a path, a URI or a name
    pub(super) target: String,
    #[command(flatten)]
    pub(super) target_args: TargetArgs,
    /// If the target exists: continue after its last episode, fail, replace, append
    #[arg(long, value_enum, default_value_t = Mode::Resume)]
    pub(super) mode: Mode,
    /// Do not compare the target with the source
    #[arg(long)]
    pub(super) no_verify: bool,
}

/// Arguments of commands that write a dataset.
#[derive(Args)]
pub struct TargetArgs {
    /// Dataset format (default: from the suffix); `swm formats` lists them
    #[arg(long, value_name = "NAME")]
    pub format: Option<String>,
    #[command(flatten)]
    pub(super) codec: CodecArgs,
    /// Minimum peak signal-to-noise ratio of lossy frames, in dB (default: 25)
    #[arg(long, value_name = "DB", value_parser = decibels)]
    least_psnr: Option<f64>,
}

impl TargetArgs {
    /// Returns the options of a conversion with these arguments.
    ///
    /// # Errors
    /// When a quality is given for a codec without one.
    pub fn options(&self, mode: ConvertMode) -> Result<ConvertOptions> {
        Ok(ConvertOptions {
            format: self.format.clone(),
            mode,
            codec: self.codec.codec()?,
            least_psnr: self.least_psnr,
            ..ConvertOptions::default()
        })
    }
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(super) enum Mode {
    Resume,
    Error,
    Overwrite,
    Append,
}

/// Runs `swm convert`.
pub fn convert(args: &ConvertArgs, context: &Context) -> anyhow::Result<()> {
    let mode = match args.mode {
        Mode::Resume => ConvertMode::Resume,
        Mode::Error => ConvertMode::Create,
        Mode::Overwrite => ConvertMode::Overwrite,
        Mode::Append => ConvertMode::Append,
    };
    let options = ConvertOptions { verify: !args.no_verify, ..args.target_args.options(mode)? };
    let source = home::find_dataset(&args.source)?;
    let target = home::target(&args.target, args.target_args.format.as_deref())?;
    args.target_args.codec.check_format(&target, args.target_args.format.as_deref())?;
    let reader = swm_data::open(source)?;
    let start = Instant::now();
    let report = swm_data::convert(&reader, &target, &options, &mut control(context))?;
    if context.json {
        return emit_json(&report);
    }
    emit(&describe(&report, &target, start.elapsed().as_secs_f64()));
    Ok(())
}

/// Returns a summary of a conversion for people.
pub fn describe(report: &Converted, target: &Location, seconds: f64) -> String {
    let mut text = format!("{} episodes in {target}", report.episodes);
    if report.existing > 0 {
        text += &format!(", {} of them from an earlier run", report.existing);
    }
    text += &format!(" ({} rows written, {seconds:.1} s)\n", report.rows);
    if let Some(size) = target.path().and_then(|path| swm_data::open(path).ok()?.footprint().ok()) {
        text += &format!("on disk: {}\n", bytes(size.iter().map(|(_, size)| size).sum()));
    }
    if report.last_actions > 0 {
        let episodes = report.last_actions;
        text += &format!("the last action of {episodes} episodes is left out: no observation follows it\n");
    }
    for column in report.columns.iter().filter(|column| !column.exact) {
        text += &match column.psnr {
            Some(psnr) => {
                format!("'{}' is lossy: {psnr:.1} dB, maximum error {} of 255\n", column.column, column.max_error)
            }
            None => {
                format!("'{}' is rounded to single precision: maximum error {:e}\n", column.column, column.max_error)
            }
        };
    }
    if !report.unread.is_empty() {
        let names = report.unread.join(", ");
        text += &format!("left out, because they are neither numbers nor images: {names}\n");
    }
    match &report.checksum {
        Some(_) if report.columns.iter().all(|column| column.exact) && !report.unread.is_empty() => {
            text += "verified: the other columns decode to the same bytes\n";
        }
        Some(_) if report.columns.iter().all(|column| column.exact) => {
            text += "verified: both datasets decode to the same bytes\n";
        }
        Some(_) => text += "verified: both datasets decode to the same values, except for the differences above\n",
        None => text += "not verified\n",
    }
    if let Some(checksum) = &report.checksum {
        text += &format!("checksum of the source: {checksum}\n");
    }
    text
}

/// Parses a signal-to-noise ratio.
fn decibels(given: &str) -> Result<f64, String> {
    let ratio = given.parse::<f64>().ok().filter(|ratio| (0.0..=200.0).contains(ratio));
    ratio.ok_or_else(|| format!("'{given}' is not a ratio from 0 to 200 dB"))
}
