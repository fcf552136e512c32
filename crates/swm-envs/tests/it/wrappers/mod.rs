//! Tests of the visual wrappers: settings, properties of all wrappers, and the effect of each wrapper.

mod effects;
mod properties;
mod settings;

use std::path::Path;
use std::process::{Command, Stdio};
use swm_core::{FrameMut, Key};
use swm_envs::wrappers::{EpisodeFrame, VisualWrapper, parse};

/// Width and height of most frames in these tests; not square, so that swapped axes are detected.
const SIZE: [usize; 2] = [48, 40];

/// The inputs that change a wrapper's result on one image.
#[derive(Clone, Copy, PartialEq)]
enum Varies {
    /// The result does not change.
    Never,
    /// The result changes with the seed.
    PerEpisode,
    /// The result changes with the seed and with the step.
    PerStep,
    /// The result changes with the step only.
    WithStep,
}

/// Settings of every wrapper: its defaults, the ends of its ranges, and every parameter at least once.
fn variants(folder: &Path) -> Vec<(String, Varies)> {
    use Varies::{Never, PerEpisode, PerStep, WithStep};
    let image = folder.join("image.png");
    let frames = folder.join("frames");
    std::fs::create_dir(&frames).expect("creating a temporary folder");
    write_png(&image, 20, 30, &pattern(20, 30));
    for (i, level) in [10, 200, 60].into_iter().enumerate() {
        write_png(&frames.join(format!("{i}.png")), 5, 4, &[level; 60]);
    }
    let mut all: Vec<(String, Varies)> = [
        ("noise", PerStep),
        ("noise,std=0", Never),
        ("noise,std=255", PerStep),
        ("noise,std=sinusoidal/5/20/10", PerStep),
        ("noise,kind=salt-pepper,amount=0.3", PerStep),
        ("noise,kind=salt-pepper,amount=linear/1/0.1/9", PerStep),
        ("blur", Never),
        ("blur,kernel=1", Never),
        ("blur,kernel=99,sigma=100", Never),
        ("color-jitter", PerEpisode),
        ("color-jitter,brightness=9,contrast=9,saturation=9,hue=0.5", PerEpisode),
        ("color-jitter,brightness=0/0,contrast=10/10,saturation=0/0,hue=-0.5/-0.5", Never),
        ("grayscale", Never),
        ("random-shift,pad=12", PerEpisode),
        ("random-shift,pad=1024,resample=step", PerStep),
        ("random-shift,pad=0", Never),
        ("cutout,num=3", PerStep),
        ("cutout,num=256,size=0/1,color=1/2/3", PerStep),
        ("occlusion,num_patches=2", PerEpisode),
        ("occlusion,num_patches=256,size=0/1,color=9", PerEpisode),
        ("occlusion,size=1", Never),
        ("moving-patch,num_patches=3", PerStep),
        ("moving-patch,num_patches=9,size=0/1,color=3/2/1,speed=1000", PerStep),
        ("random-conv", PerEpisode),
        ("random-conv,kernel_size=15", PerEpisode),
        ("resolution", Never),
        ("resolution,scale=0", Never),
        ("resolution,scale=1", Never),
    ]
    .map(|(text, varies)| (text.to_owned(), varies))
    .into();
    let chroma = |key: &str, media: &Path| format!("chroma-key,key_color={key},media={}", media.display());
    all.push((chroma("0/0/0", &image), Never));
    all.push((chroma("90/90/90/255/0/0,tolerance=442", &frames), WithStep));
    all
}

fn make(text: &str) -> Box<dyn VisualWrapper> {
    parse(text).unwrap_or_else(|error| panic!("{text}: {error}"))
}

/// A test image with many colours and edges.
fn pattern(width: usize, height: usize) -> Vec<u8> {
    let pixel = |x: usize, y: usize| match (x / 9 + y / 7) % 4 {
        0 => [(x * 11) as u8, (y * 7) as u8, 128],
        1 => [0; 3],
        2 => [255, (x * y) as u8, 10],
        _ => [40 + (x * 4) as u8; 3],
    };
    (0..height).flat_map(|y| (0..width).flat_map(move |x| pixel(x, y))).collect()
}

fn write_png(path: &Path, width: u32, height: u32, rgb: &[u8]) {
    let file = std::fs::File::create(path).expect("writing the file");
    let mut encoder = png::Encoder::new(file, width, height);
    encoder.set_color(png::ColorType::Rgb);
    encoder.write_header().expect("writing the header").write_image_data(rgb).expect("writing the image");
}

/// Applies a wrapper to the test image in the episode of a seed.
fn applied(wrapper: &mut dyn VisualWrapper, [width, height]: [usize; 2], seed: u64, which: EpisodeFrame) -> Vec<u8> {
    let mut rgb = pattern(width, height);
    wrapper.reset(Key::new(seed));
    wrapper.apply(&mut FrameMut::new(width, height, &mut rgb), which);
    rgb
}

fn has_ffmpeg() -> bool {
    Command::new("ffmpeg")
        .arg("-version")
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .status()
        .is_ok_and(|s| s.success())
}
