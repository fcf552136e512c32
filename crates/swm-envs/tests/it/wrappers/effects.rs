//! Tests of the effect of each wrapper: moments of noise, positions of rectangles, colours, backgrounds.

use super::{has_ffmpeg, make, write_png};
use std::collections::BTreeSet;
use std::process::{Command, Stdio};
use swm_core::{FrameMut, Key};
use swm_envs::wrappers::EpisodeFrame;

/// Applies a wrapper to a grey image at some steps.
fn applied_to_grey(text: &str, level: u8, size: [usize; 2], steps: std::ops::Range<u64>) -> Vec<Vec<u8>> {
    let mut wrapper = make(text);
    wrapper.reset(Key::new(7));
    steps
        .map(|step| {
            let mut rgb = vec![level; 3 * size[0] * size[1]];
            wrapper.apply(&mut FrameMut::new(size[0], size[1], &mut rgb), EpisodeFrame::Step(step));
            rgb
        })
        .collect()
}

fn mean(values: impl Iterator<Item = f64> + Clone) -> f64 {
    values.clone().sum::<f64>() / values.count() as f64
}

/// Returns the bounding box of the non-zero pixels as x, y, width, height.
fn bounds(rgb: &[u8], width: usize) -> Option<[usize; 4]> {
    let at: Vec<[usize; 2]> = rgb
        .as_chunks::<3>()
        .0
        .iter()
        .enumerate()
        .filter(|(_, p)| **p != [0; 3])
        .map(|(i, _)| [i % width, i / width])
        .collect();
    let side = |axis: usize| Some((at.iter().map(|p| p[axis]).min()?, at.iter().map(|p| p[axis]).max()? + 1));
    let ((x0, x1), (y0, y1)) = (side(0)?, side(1)?);
    assert_eq!(at.len(), (x1 - x0) * (y1 - y0), "the non-zero pixels fill their bounding box");
    Some([x0, y0, x1 - x0, y1 - y0])
}

#[test]
fn chroma_key_replaces_key_colours_by_the_background_frame_of_the_step() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let levels = [250, 10, 130, 70];
    for (i, level) in levels.into_iter().enumerate() {
        write_png(&folder.path().join(format!("{i}.png")), 16, 16, &[level; 768]);
    }
    let mut backgrounds = vec![folder.path().to_owned()];
    if has_ffmpeg() {
        // A GIF whose frames have different durations, and a lossless video.
        for (name, filter) in
            [("a.gif", "setpts=N*(N+1)/TB/10,split[a][b];[a]palettegen[c];[b][c]paletteuse"), ("a.mkv", "null")]
        {
            let path = folder.path().join(name);
            let mut command = Command::new("ffmpeg");
            command.args(["-loglevel", "error", "-framerate", "7", "-i"]).arg(folder.path().join("%d.png"));
            command.args(["-vf", filter]);
            command.args(if name == "a.mkv" { &["-c:v", "png"][..] } else { &[] });
            let made = command.arg(&path).stdin(Stdio::null()).status().expect("running ffmpeg").success();
            assert!(made, "ffmpeg makes {name}");
            backgrounds.push(path);
        }
    }
    for media in backgrounds {
        let text = format!("chroma-key,key_color=1/2/3/9/9/9,tolerance=2,media={}", media.display());
        let mut wrapper = make(&text);
        let mut level_at = |step| {
            // The first key colour, a colour at distance 2, a colour just beyond, a colour near the second key colour,
            // and an unrelated colour.
            let mut rgb = [[1, 2, 3], [1, 4, 3], [2, 4, 3], [9, 9, 8], [200, 0, 0]].concat();
            wrapper.apply(&mut FrameMut::new(5, 1, &mut rgb), EpisodeFrame::Step(step));
            assert_eq!((&rgb[6..9], &rgb[12..]), (&[2, 4, 3][..], &[200, 0, 0][..]), "{text}: other colours change");
            assert!(rgb[..6].iter().chain(&rgb[9..12]).all(|&v| v == rgb[0]), "{text}: {rgb:?}");
            rgb[0]
        };
        for (step, level) in (0..).zip(levels.iter().cycle().take(10)) {
            assert!(level_at(step).abs_diff(*level) <= 2, "{text}: step {step} shows {}, not {level}", level_at(step));
        }
    }
}

#[test]
fn gaussian_noise_has_the_moments_and_tails_of_a_normal_distribution() {
    for std in [1.0, 10.0, 30.0] {
        let bytes = applied_to_grey(&format!("noise,std={std}"), 128, [224, 224], 0..7).concat();
        let n = bytes.len() as f64;
        // Rounding down moves the mean by half a level and adds 1/12 to the variance.
        let noise = bytes.iter().map(|&v| f64::from(v) - 127.5);
        let variance = mean(noise.clone().map(|v| v * v));
        assert!(mean(noise.clone()).abs() < 5.0 * std / n.sqrt(), "std {std}: the mean is {}", mean(noise));
        let expected = std * std + 1.0 / 12.0;
        assert!((variance / expected - 1.0).abs() < 0.01, "std {std}: the variance is {variance}, not {expected}");
        if std > 5.0 {
            let fourth = mean(noise.clone().map(|v| v.powi(4))) / variance.powi(2);
            assert!((fourth - 3.0).abs() < 0.05, "std {std}: the kurtosis is {fourth}");
            for (z, expected) in [(1.0, 0.317_31), (2.0, 0.045_50), (3.0, 0.002_700), (3.5, 0.000_465)] {
                // A level represents an interval of half a level on both sides.
                let beyond = mean(noise.clone().map(|v| f64::from(u8::from(v.abs() > z * std))));
                let slack = 4.0 * (expected / n).sqrt() + expected * z * z * 0.5 / std;
                assert!(
                    (beyond - expected).abs() < slack,
                    "std {std}: {beyond} lie beyond {z} deviations, not {expected}"
                );
            }
        }
        // Neighbours, channels, rows and steps are uncorrelated.
        for lag in [1, 3, 4, 3 * 224, 3 * 224 * 224] {
            let pairs = bytes.iter().zip(&bytes[lag..]);
            let correlation = mean(pairs.map(|(&a, &b)| (f64::from(a) - 127.5) * (f64::from(b) - 127.5))) / variance;
            assert!(correlation.abs() < 5.0 / n.sqrt(), "std {std}: correlation {correlation} over {lag}");
        }
    }
    let white = applied_to_grey("noise,std=40", 255, [224, 224], 0..1).concat();
    let untouched = mean(white.iter().map(|&v| f64::from(u8::from(v == 255))));
    assert!((untouched - 0.5).abs() < 0.01, "half of the noise is clipped, not {untouched}");
    let schedule = applied_to_grey("noise,std=linear/0/20/2", 128, [64, 64], 0..4);
    let spread = |frame: &[u8]| mean(frame.iter().map(|&v| (f64::from(v) - 127.5).powi(2))).sqrt();
    assert!(schedule[0].iter().all(|&v| v == 128), "a standard deviation of 0 changes nothing");
    for (frame, std) in schedule.iter().zip([0.5, 10.0, 20.0, 20.0]) {
        assert!((spread(frame) - std).abs() < 0.5, "{} is not {std}", spread(frame));
    }
}

#[test]
fn salt_and_pepper_replace_whole_pixels_with_equal_probability() {
    for amount in [0.0, 0.05, 0.5, 1.0] {
        let bytes = applied_to_grey(&format!("noise,kind=salt-pepper,amount={amount}"), 128, [201, 224], 0..3).concat();
        let pixels = bytes.as_chunks::<3>().0;
        let share = |level: u8| mean(pixels.iter().map(|&pixel| f64::from(u8::from(pixel == [level; 3]))));
        let slack = 5.0 * (0.25 / pixels.len() as f64).sqrt();
        for (level, expected) in [(0, amount / 2.0), (255, amount / 2.0), (128, 1.0 - amount)] {
            assert!((share(level) - expected).abs() < slack, "amount {amount}: {} show {level}", share(level));
        }
        assert!((share(0) + share(255) + share(128) - 1.0).abs() < 1e-9, "every pixel is black, white or unchanged");
    }
}

#[test]
fn shifts_are_uniform_and_repeat_the_edge() {
    let mut wrapper = make("random-shift,pad=3,resample=step");
    let mut counts = [[0u32; 7]; 2];
    for step in 0..1400 {
        // Every pixel contains its own coordinates.
        let mut rgb: Vec<u8> = (0..20).flat_map(|y| (0..30).flat_map(move |x| [x, y, 0])).collect();
        wrapper.apply(&mut FrameMut::new(30, 20, &mut rgb), EpisodeFrame::Step(step));
        let pixels = rgb.as_chunks::<3>().0;
        let offset = [0, 1].map(|axis| i32::from(pixels[10 * 30 + 15][axis]) - [15, 10][axis]);
        for (i, pixel) in (0..).zip(pixels) {
            let expected = [(i % 30 + offset[0]).clamp(0, 29), (i / 30 + offset[1]).clamp(0, 19)];
            assert_eq!([0, 1].map(|axis| i32::from(pixel[axis])), expected, "step {step}, pixel {i}");
        }
        for (counts, offset) in counts.iter_mut().zip(offset) {
            counts[usize::try_from(offset + 3).expect("an offset of at least -pad")] += 1;
        }
    }
    for count in counts.as_flattened() {
        assert!((130..270).contains(count), "offsets are uniform: {counts:?}");
    }
}

#[test]
fn rectangles_have_the_requested_size_and_uniform_positions() {
    for text in ["cutout,size=0.2/0.5,color=7", "occlusion,size=0.2/0.5,color=7", "moving-patch,size=0.2/0.5,color=7"] {
        let mut wrapper = make(text);
        let found: Vec<[usize; 4]> = (0..600)
            .map(|seed| {
                let mut rgb = vec![0; 3 * 100 * 60];
                wrapper.reset(Key::new(seed));
                wrapper.apply(&mut FrameMut::new(100, 60, &mut rgb), EpisodeFrame::Step(seed % 50));
                bounds(&rgb, 100).expect("the wrapper draws a rectangle")
            })
            .collect();
        for &[x, y, width, height] in &found {
            assert!((20..=50).contains(&width) && (12..=30).contains(&height), "{text}: {width} x {height}");
            assert!(x + width <= 100 && y + height <= 60, "{text}: the rectangle extends beyond the frame");
        }
        for (axis, side, low, high) in [(2, 100.0, 20.0, 50.0), (3, 60.0, 12.0, 30.0)] {
            let center = mean(found.iter().map(|f| f[axis - 2] as f64 + f[axis] as f64 / 2.0));
            assert!((center / side - 0.5).abs() < 0.04, "{text}: the centre lies at {center} of {side}");
            let size = mean(found.iter().map(|f| f[axis] as f64));
            assert!((size - (low + high) / 2.0).abs() < 0.05 * side, "{text}: the mean side is {size}");
        }
    }
}

#[test]
fn moving_patches_keep_their_size_and_move_at_most_their_speed() {
    let mut wrapper = make("moving-patch,size=0.2,color=7,speed=3");
    for seed in 0..20 {
        wrapper.reset(Key::new(seed));
        let rectangles: Vec<[usize; 4]> = (0..200)
            .map(|step| {
                let mut rgb = vec![0; 3 * 100 * 60];
                wrapper.apply(&mut FrameMut::new(100, 60, &mut rgb), EpisodeFrame::Step(step));
                bounds(&rgb, 100).expect("the wrapper draws a rectangle")
            })
            .collect();
        assert!(rectangles.iter().all(|rectangle| rectangle[2..] == [20, 12]), "the size does not change");
        for pair in rectangles.windows(2) {
            let away = [0, 1].map(|axis| pair[1][axis] as f64 - pair[0][axis] as f64);
            assert!(away[0].hypot(away[1]) < 3.0 + 1.5, "seed {seed}: from {:?} to {:?}", pair[0], pair[1]);
        }
        let moved: BTreeSet<_> = rectangles.iter().collect();
        assert!(moved.len() > 50, "seed {seed}: the patch moves");
    }
}

#[test]
fn color_jitter_samples_within_its_ranges() {
    // Contrast, saturation and hue do not change a uniform grey, so only the brightness acts.
    let levels = |text: &str| -> Vec<f64> {
        let mut wrapper = make(text);
        let level = |seed| {
            let mut rgb = vec![100; 12];
            wrapper.reset(Key::new(seed));
            wrapper.apply(&mut FrameMut::new(2, 2, &mut rgb), EpisodeFrame::Step(0));
            assert!(rgb.iter().all(|v| *v == rgb[0]), "grey stays grey");
            f64::from(rgb[0])
        };
        (0..400).map(level).collect()
    };
    for (text, low, high) in [
        ("color-jitter,brightness=0.3", 70.0, 130.0),
        ("color-jitter,brightness=1.5/2", 150.0, 200.0),
        ("color-jitter,brightness=3", 0.0, 255.0),
    ] {
        let levels = levels(text);
        let (least, most) = (levels.iter().copied().fold(255.0, f64::min), levels.iter().copied().fold(0.0, f64::max));
        assert!(least >= low - 1.0 && most <= high, "{text}: from {least} to {most}");
        assert!(least < low + 0.1 * (high - low) && most > high - 0.1 * (high - low), "{text}: {least} to {most}");
    }
    // A hue shift by a third turns red into green.
    let mut rgb = vec![255, 0, 0];
    let fixed = "color-jitter,brightness=1/1,contrast=1/1,saturation=1/1,hue=0.3333/0.3334";
    make(fixed).apply(&mut FrameMut::new(1, 1, &mut rgb), EpisodeFrame::Step(0));
    assert!(rgb[1] == 255 && rgb[0] < 10 && rgb[2] < 10, "{rgb:?}");
}

#[test]
fn random_convolutions_have_weights_of_the_documented_variance() {
    for side in [1, 3, 5] {
        let mut wrapper = make(&format!("random-conv,kernel_size={side}"));
        let (n, deviation) = (21, 80.0 / f64::from(3 * side * side).sqrt());
        let mut responses = vec![];
        for seed in 0..400 {
            // The response to a single dim pixel consists of the positive weights.
            let mut rgb = vec![0; 3 * n * n];
            rgb[3 * (n * (n / 2) + n / 2)] = 80;
            wrapper.reset(Key::new(seed));
            wrapper.apply(&mut FrameMut::new(n, n, &mut rgb), EpisodeFrame::Step(0));
            let radius = (side / 2) as usize;
            for y in n / 2 - radius..=n / 2 + radius {
                responses.extend_from_slice(&rgb[3 * (n * y + n / 2 - radius)..][..3 * side as usize]);
            }
            let touched = rgb.iter().filter(|v| **v > 0).count();
            assert!(touched <= responses.len() / (seed as usize + 1), "pixels outside the window change");
        }
        // Rounding down lowers a positive response by half a level on average.
        let square = mean(responses.iter().filter(|v| **v > 0).map(|&v| (f64::from(v) + 0.5).powi(2)));
        let positive = mean(responses.iter().map(|&v| f64::from(u8::from(v > 0))));
        // Positive responses below 1 are rounded down to level 0.
        let hidden = 0.4 / deviation;
        assert!((positive + hidden - 0.5).abs() < 0.03, "side {side}: {positive} of the weights are positive");
        let found = (square * positive / 0.5).sqrt();
        assert!((found / deviation - 1.0).abs() < 0.06, "side {side}: {found} is not {deviation}");
    }
}
