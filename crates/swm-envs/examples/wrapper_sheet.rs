//! Draws a contact sheet of all wrappers, `docs/wrappers.png`: a row of frames without wrappers, then one row per
//! wrapper. Push-T is on the left and Two-Room on the right, each at steps 0 and 10 of one episode and at step 0 of
//! another episode.
//!
//!     cargo run --release -p swm-envs --example wrapper_sheet [OUT.png]

use std::path::{Path, PathBuf};
use swm_core::{Action, Env, FrameMut, Key, ResetOptions, Result};
use swm_envs::wrappers::{GoalFrame, Stack};
use swm_envs::{push_t, two_room};

/// Side of a frame, in pixels.
const SIDE: usize = 96;
/// Gap between frames, in pixels.
const GAP: usize = 4;
/// Frames per row.
const COLUMNS: usize = 6;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let out = std::env::args().nth(1).map_or_else(|| PathBuf::from("docs/wrappers.png"), PathBuf::from);
    let background = std::env::temp_dir().join("swm-wrapper-sheet.png");
    write_png(&background, 256, 256, &sunset())?;
    let rows = [
        vec![],
        vec![format!("chroma-key,key_color=255/255/255,tolerance=40,media={}", background.display())],
        vec!["noise,std=30".to_owned()],
        vec!["noise,kind=salt-pepper".to_owned()],
        vec!["blur,kernel=9".to_owned()],
        vec!["color-jitter,brightness=0.4,contrast=0.4,saturation=0.8,hue=0.5".to_owned()],
        vec!["grayscale".to_owned()],
        vec!["random-shift,pad=12".to_owned()],
        vec!["cutout,num=3".to_owned()],
        vec!["occlusion,num_patches=2".to_owned()],
        vec!["moving-patch,num_patches=2,color=255/160/0".to_owned()],
        vec!["random-conv".to_owned()],
        vec!["resolution,scale=0.2".to_owned()],
        ["resolution,scale=0.5", "color-jitter,hue=0.3", "noise,std=12"].map(str::to_owned).to_vec(),
    ];
    let (width, height) = (COLUMNS * (SIDE + GAP) - GAP, rows.len() * (SIDE + GAP) - GAP);
    let mut sheet = vec![200; 3 * width * height];
    for (row, texts) in rows.iter().enumerate() {
        let stack = Stack::parse(texts)?;
        for (half, entry) in [push_t::ENTRY, two_room::ENTRY].iter().enumerate() {
            let mut env = stack.wrap(entry.env().expect("creating the environment"), GoalFrame::Clean);
            for (column, (seed, steps)) in [(1, 0), (1, 10), (2, 0)].into_iter().enumerate() {
                play(&mut *env, seed, steps)?;
                let mut rgb = vec![0; 3 * SIDE * SIDE];
                env.render(FrameMut::new(SIDE, SIDE, &mut rgb)).expect("rendering a frame");
                let left = (3 * half + column) * (SIDE + GAP);
                for (y, line) in rgb.chunks_exact(3 * SIDE).enumerate() {
                    let start = 3 * ((row * (SIDE + GAP) + y) * width + left);
                    sheet[start..start + 3 * SIDE].copy_from_slice(line);
                }
            }
        }
    }
    swm_core::files::delete_file(&background)?;
    write_png(&out, width, height, &sheet)
}

/// Resets the environment and takes random actions.
fn play(env: &mut dyn Env, seed: u64, steps: u64) -> Result<()> {
    env.reset(seed, &ResetOptions::default())?;
    let space = env.spec().action_space.clone();
    for step in 0..steps {
        let action = space.sample(&mut Key::new(seed).at(step).rng());
        env.step(Action::Continuous(&action.iter().map(|&v| v as f32).collect::<Vec<_>>()))?;
    }
    Ok(())
}

/// Draws the background: a sun over the sea.
fn sunset() -> Vec<u8> {
    let pixel = |x: usize, y: usize| -> [u8; 3] {
        let (x, y) = (x as f64, y as f64);
        match ((x - 128.0).hypot(y - 110.0) < 42.0, y < 150.0) {
            (true, true) => [255, 214, 90],
            (_, true) => [(120.0 + 0.8 * y) as u8, (60.0 + 0.5 * y) as u8, (150.0 - 0.3 * y) as u8],
            _ => [30, (70.0 + 30.0 * (0.4 * y + 3.0 * (0.1 * x).sin()).sin()) as u8, (240.0 - 0.5 * y) as u8],
        }
    };
    (0..256).flat_map(|y| (0..256).flat_map(move |x| pixel(x, y))).collect()
}

fn write_png(path: &Path, width: usize, height: usize, rgb: &[u8]) -> Result<(), Box<dyn std::error::Error>> {
    let mut encoder = png::Encoder::new(std::fs::File::create(path)?, width as u32, height as u32);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_compression(png::Compression::High);
    encoder.write_header()?.write_image_data(rgb)?;
    Ok(())
}
