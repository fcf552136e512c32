//! Measures frames per second of every wrapper on one core, with frames of Push-T, for the table of `docs/wrappers.md`.
//!
//!     cargo run --release -p swm-envs --example wrapper_speed

use std::hint::black_box;
use std::io::Write as _;
use std::time::{Duration, Instant};
use swm_core::{FrameMut, Key, ResetOptions, Result};
use swm_envs::push_t;
use swm_envs::wrappers::{EpisodeFrame, VisualWrapper, WRAPPERS, parse};

/// The number of timed frames per measurement; the result is the median.
const FRAMES: u64 = 101;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let background = std::env::temp_dir().join("swm-wrapper-speed.png");
    let mut png = png::Encoder::new(std::fs::File::create(&background)?, 256, 256);
    png.set_color(png::ColorType::Rgb);
    png.write_header()?.write_image_data(&vec![90; 3 * 256 * 256])?;
    let mut texts: Vec<String> = WRAPPERS.rows.iter().map(|entry| entry.id.to_owned()).collect();
    texts[0].push_str(&format!(",key_color=255/255/255,media={}", background.display()));
    texts.insert(2, "noise,kind=salt-pepper".to_owned());
    let mut out = std::io::stdout();
    writeln!(out, "| wrapper | 64 px, frames/s | 224 px, frames/s | 224 px, after noise |")?;
    writeln!(out, "| --- | --- | --- | --- |")?;
    for text in texts {
        let mut wrapper = parse(&text)?;
        let mut rate = |side, noisy| rate(&mut *wrapper, side, noisy);
        let [small, large, noisy] = [rate(64, false)?, rate(224, false)?, rate(224, true)?];
        let name = text.split(",key_color").next().unwrap_or_default();
        writeln!(out, "| `{name}` | {small:.0} | {large:.0} | {noisy:.0} |")?;
    }
    swm_core::files::delete_file(&background)?;
    Ok(())
}

/// Returns frames per second, without the time to draw and copy them.
fn rate(wrapper: &mut dyn VisualWrapper, side: usize, noisy: bool) -> Result<f64> {
    let mut env = push_t::ENTRY.env().expect("creating the environment");
    env.reset(0, &ResetOptions::default())?;
    let mut original = vec![0; 3 * side * side];
    env.render(FrameMut::new(side, side, &mut original)).expect("rendering a frame");
    if noisy {
        parse("noise")?.apply(&mut FrameMut::new(side, side, &mut original), EpisodeFrame::Step(0));
    }
    let mut rgb = original.clone();
    wrapper.reset(Key::new(0));
    let mut times: Vec<Duration> = (0..FRAMES)
        .map(|step| {
            rgb.copy_from_slice(&original);
            let start = Instant::now();
            wrapper.apply(&mut FrameMut::new(side, side, black_box(&mut rgb)), EpisodeFrame::Step(step));
            start.elapsed()
        })
        .collect();
    times.sort();
    Ok(times[times.len() / 2].as_secs_f64().recip())
}
