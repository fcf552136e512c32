//! `swm convert`: a dataset in another format or codec, and what it takes to say that it is the same.

use super::config::CodecArgs;
use super::datasets::bytes;
use super::{Context, Progress, emit, emit_json};
use clap::{Args, ValueEnum};
use std::time::Instant;
use swm::home;
use swm_core::run::{Control, Event};
use swm_data::{ConvertMode, ConvertOptions, Converted, Location};

/// Arguments of `swm convert`.
#[derive(Args)]
pub struct ConvertArgs {
    /// The dataset to read: a path, a URI or a name
    source: String,
    /// The dataset to write: a path, a URI or a name
    target: String,
    #[command(flatten)]
    target_args: TargetArgs,
    /// What to do with a target that is there: go on behind its last episode, refuse, replace it, or add to it
    #[arg(long, value_enum, default_value_t = Mode::Resume)]
    mode: Mode,
    /// Do not read the target again to compare it
    #[arg(long)]
    no_verify: bool,
}

/// How a dataset is written, for commands that write one.
#[derive(Args)]
pub struct TargetArgs {
    /// The format (default: the one the target's name says); `swm formats` lists them
    #[arg(long, value_name = "NAME")]
    pub format: Option<String>,
    #[command(flatten)]
    codec: CodecArgs,
    /// The least signal-to-noise ratio of lossy pictures, in dB; less is an error
    #[arg(long, default_value_t = ConvertOptions::default().least_psnr, value_name = "DB")]
    least_psnr: f64,
}

impl TargetArgs {
    /// What they ask for.
    pub fn options(&self, mode: ConvertMode) -> ConvertOptions {
        ConvertOptions {
            format: self.format.clone(),
            mode,
            codec: self.codec.codec(),
            least_psnr: self.least_psnr,
            ..ConvertOptions::default()
        }
    }
}

#[derive(Clone, Copy, ValueEnum)]
enum Mode {
    Resume,
    Error,
    Overwrite,
    Append,
}

/// Converts.
pub fn convert(args: &ConvertArgs, context: &Context) -> anyhow::Result<()> {
    let mode = match args.mode {
        Mode::Resume => ConvertMode::Resume,
        Mode::Error => ConvertMode::Create,
        Mode::Overwrite => ConvertMode::Overwrite,
        Mode::Append => ConvertMode::Append,
    };
    let options = ConvertOptions { verify: !args.no_verify, ..args.target_args.options(mode) };
    let reader = home::open_dataset(&args.source)?;
    let target = home::target(&args.target, args.target_args.format.as_deref())?;
    let begun = Instant::now();
    let report = swm_data::convert(&reader, &target, &options, &mut control(context))?;
    if context.json {
        return emit_json(&report);
    }
    emit(&words(&report, &target, begun.elapsed().as_secs_f64()));
    Ok(())
}

/// A control that shows the progress of each stage and stops the run on Ctrl-C.
pub fn control(context: &Context) -> Control<'static> {
    let mut bar: Option<Progress> = None;
    Control::new().with_interrupt(context.stop.clone()).with_events(move |event| match event {
        Event::Started(stage) => bar = Some(Progress::new(stage.name, stage.total)),
        Event::Progress(at) => {
            if let Some(bar) = &mut bar {
                bar.at(at.done, "");
            }
        }
        _ => {}
    })
}

/// What became of it, in words.
pub fn words(report: &Converted, target: &Location, seconds: f64) -> String {
    let mut text = format!("{} episodes in {target}", report.episodes);
    if report.kept > 0 {
        text += &format!(", {} of them were there", report.kept);
    }
    text += &format!(" ({} rows written, {seconds:.1} s)\n", report.rows);
    if let Some(size) = target.path().and_then(|path| swm_data::open(path).ok()?.footprint().ok()) {
        text += &format!("on disk: {}\n", bytes(size.iter().map(|(_, size)| size).sum()));
    }
    if report.last_actions > 0 {
        let many = report.last_actions;
        text += &format!("the last action of {many} episodes is left out: no observation follows it\n");
    }
    for column in report.columns.iter().filter(|column| !column.exact) {
        text += &match column.psnr {
            Some(psnr) => {
                format!("'{}' is lossy: {psnr:.1} dB, at most {} of 255 off\n", column.column, column.max_error)
            }
            None => format!("'{}' is rounded to single precision: at most {:e} off\n", column.column, column.max_error),
        };
    }
    match &report.checksum {
        Some(_) if report.columns.iter().all(|column| column.exact) => {
            text += "verified: readers get the same bytes from both\n";
        }
        Some(_) => text += "verified: readers get the same from both, but for what is said above\n",
        None => text += "not verified\n",
    }
    if let Some(checksum) = &report.checksum {
        text += &format!("checksum of the source: {checksum}\n");
    }
    text
}
