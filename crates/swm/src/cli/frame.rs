//! `swm frame`: the first frame of an episode as PNG.

use super::config::{VariationArgs, image_size};
use super::wrappers::WrapperArgs;
use super::{emit, emit_json, output_folder};
use clap::Args;
use serde_json::json;
use std::ffi::OsStr;
use std::path::PathBuf;
use swm_core::{CameraView, Error, Origin, files};
use swm_data::check_png;
use swm_lab::rendering::Rendering;
use swm_lab::still::Still;

/// Arguments of `swm frame`.
#[derive(Args)]
pub struct FrameArgs {
    /// The environment, such as swm/TwoRoom-v1 or swm/OGBCube-v0,env_type=double
    env: String,
    /// Seed of the reset, whose parts a dataset has as episode_seed
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Frame size in pixels: 64 or HEIGHTxWIDTH
    #[arg(long, default_value = "224", value_parser = image_size)]
    image: (usize, usize),
    /// Show the goal instead of the initial state
    #[arg(long)]
    goal: bool,
    /// The camera view: CAMERA, depth, segmentation, or CAMERA:depth
    ///
    /// Depth and segmentation have the colours of `swm preview`; wrappers do not change them.
    #[arg(long, value_name = "VIEW", conflicts_with = "goal")]
    view: Option<String>,
    #[command(flatten)]
    wrappers: WrapperArgs,
    /// The PNG file to write
    #[arg(short, long, value_name = "FILE", default_value = "frame.png")]
    output: PathBuf,
    #[command(flatten)]
    variation: VariationArgs,
}

/// Runs `swm frame`.
pub fn frame(args: &FrameArgs, as_json: bool) -> anyhow::Result<()> {
    let variation = args.variation.request()?;
    let choice = crate::env(&args.env, &Origin::User)?;
    output_folder::check_file(&args.output)?;
    let suffix = args.output.extension().unwrap_or(OsStr::new("png"));
    if !suffix.eq_ignore_ascii_case("png") {
        let fix = format!("name the file {}", args.output.with_extension("png").display());
        return Err(
            Error::config(format!("--output {}", args.output.display()), "frames are written as PNG", fix).into()
        );
    }
    check_png(&args.output)?;
    let view = args.view.as_deref().map_or_else(|| Ok(CameraView::default()), CameraView::parse)?;
    let WrapperArgs { wrappers, wrap_goal } = args.wrappers.clone();
    let rendering = Rendering { view, wrappers, wrap_goal };
    let still = Still { seed: args.seed, variation, goal: args.goal, size: args.image, rendering };
    let (stack, goal) = args.wrappers.stack()?;
    let png = still.png(&mut *stack.wrap(choice.env()?, goal))?;
    files::write(&args.output, &png)?;
    if as_json {
        return emit_json(&json!({"file": args.output.to_string_lossy(), "env": choice.id(), "seed": args.seed}));
    }
    emit(&format!("{}\n", args.output.display()));
    Ok(())
}
