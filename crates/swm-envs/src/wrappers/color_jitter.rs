//! Changes of brightness, contrast, saturation and hue, sampled once per episode.
//!
//! In this order: every channel is multiplied by a brightness factor; its difference from the mean of the channel over
//! the frame is multiplied by a contrast factor; the result is clipped to 0 ..= 255; in HSV, hue is shifted and
//! saturation multiplied.
//!
//! | parameter | unit | default | range |
//! | --- | --- | --- | --- |
//! | `brightness` | factor: from 1 ± this (at least 0), or between low/high | 0.2 | 0 to 10 |
//! | `contrast` | likewise | 0.2 | 0 to 10 |
//! | `saturation` | likewise | 0.2 | 0 to 10 |
//! | `hue` | turns of the colour circle: from ± this, or between low/high | 0.05 | -0.5 to 0.5 |
//!
//! All four are drawn uniformly. Source: `ColorJitterWrapper` of the reference, with the rounding of OpenCV's 8-bit HSV
//! (hue in 180 steps). Addition: ranges, and with them fixed factors (`brightness=1.3/1.3`).

use super::settings::{Domain, Ends, Parameter};
use super::{EpisodeFrame, VisualWrapper, WrapperEntry, typed};
use rand::Rng as _;
use serde::Deserialize;
use swm_core::{FrameMut, Key};

const FACTOR: Domain = Domain::Spread { around: 1.0, low: 0.0, high: 10.0 };

/// The registry row of this wrapper.
pub const ENTRY: WrapperEntry = WrapperEntry {
    id: "color-jitter",
    summary: "changes brightness, contrast, saturation and hue, by the same amounts throughout an episode",
    parameters: &[
        Parameter { name: "brightness", summary: "factor of all channels", domain: FACTOR, default: Some("0.2") },
        Parameter {
            name: "contrast",
            summary: "factor of distances from the mean",
            domain: FACTOR,
            default: Some("0.2"),
        },
        Parameter { name: "saturation", summary: "factor of saturation", domain: FACTOR, default: Some("0.2") },
        Parameter {
            name: "hue",
            summary: "added to hue, turns of the colour circle",
            domain: Domain::Spread { around: 0.0, low: -0.5, high: 0.5 },
            default: Some("0.05"),
        },
    ],
    build: |settings| {
        let Settings { brightness, contrast, saturation, hue } = typed(ENTRY.id, settings)?;
        let [brightness, contrast, saturation] = [brightness, contrast, saturation].map(|ends| ends.around(1.0, 0.0));
        Ok(Box::new(ColorJitter::new([brightness, contrast, saturation, hue.around(0.0, -0.5)])))
    },
};

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Settings {
    brightness: Ends,
    contrast: Ends,
    saturation: Ends,
    hue: Ends,
}

#[derive(Clone)]
pub(super) struct ColorJitter {
    /// Ranges of brightness, contrast, saturation and hue.
    ranges: [[f64; 2]; 4],
    brightness: f32,
    contrast: f32,
    /// The lookup table for saturation.
    saturation: [u8; 256],
    /// The lookup table for hue, in 180 steps.
    hue: [u8; 180],
}

impl ColorJitter {
    pub fn new(ranges: [[f64; 2]; 4]) -> Self {
        let mut jitter = Self { ranges, brightness: 1.0, contrast: 1.0, saturation: [0; 256], hue: [0; 180] };
        jitter.reset(Key::new(0));
        jitter
    }

    /// Returns a lookup table for each channel that applies brightness and contrast.
    fn channel_tables(&self, pixels: &[[u8; 3]]) -> [[u8; 256]; 3] {
        let mut sums = [0u64; 3];
        for pixel in pixels {
            for (sum, &channel) in sums.iter_mut().zip(pixel) {
                *sum += u64::from(channel);
            }
        }
        sums.map(|sum| {
            let mean = (sum as f64 / pixels.len().max(1) as f64) as f32 * self.brightness;
            std::array::from_fn(|level| ((level as f32 * self.brightness - mean) * self.contrast + mean) as u8)
        })
    }
}

/// Returns `numerator / divisor` for every divisor, in units of 2⁻¹². As in OpenCV, multiplication by these quotients
/// replaces division.
const fn quotients(numerator: u32) -> [u32; 256] {
    let mut quotients = [0; 256];
    let mut divisor = 1;
    while divisor < 256 {
        quotients[divisor as usize] = ((numerator << 13) + divisor) / (2 * divisor);
        divisor += 1;
    }
    quotients
}

/// Quotients for the hue, whose six sectors have 30 steps each.
static HUE: [u32; 256] = quotients(30);
/// Quotients for the saturation.
static SATURATION: [u32; 256] = quotients(255);

/// Converts RGB to hue in 180 steps, saturation and value in 256.
fn to_hsv([r, g, b]: [u8; 3]) -> [u8; 3] {
    let (value, least) = (r.max(g).max(b), r.min(g).min(b));
    let range = value - least;
    let round = |product: i32| (product + (1 << 11)) >> 12;
    let [red, green, blue] = [r, g, b].map(i32::from);
    let offset = if value == r {
        green - blue
    } else if value == g {
        blue - red + 2 * i32::from(range)
    } else {
        red - green + 4 * i32::from(range)
    };
    let hue = round(offset * HUE[range as usize] as i32);
    let saturation = round(i32::from(range) * SATURATION[value as usize] as i32);
    [if hue < 0 { hue + 180 } else { hue } as u8, saturation as u8, value]
}

/// Converts hue in 180 steps, saturation and value in 256 to RGB; rounded down, as in OpenCV.
fn to_rgb([hue, saturation, value]: [u8; 3]) -> [u8; 3] {
    let sector = hue / 30;
    let part = f32::from(hue) * (6.0 / 180.0) - f32::from(sector);
    let [saturation, value] = [saturation, value].map(|level| f32::from(level) * (1.0 / 255.0));
    let level = |share: f32| (value * share * 255.0) as u8;
    let (most, least) = (level(1.0), level(1.0 - saturation));
    let (falling, rising) = (level(1.0 - saturation * part), level(1.0 - saturation * (1.0 - part)));
    match sector {
        0 => [most, rising, least],
        1 => [falling, most, least],
        2 => [least, most, rising],
        3 => [least, falling, most],
        4 => [rising, least, most],
        _ => [most, least, falling],
    }
}

impl VisualWrapper for ColorJitter {
    fn id(&self) -> &'static str {
        ENTRY.id
    }

    fn reset(&mut self, episode: Key) {
        let mut rng = episode.rng();
        let [brightness, contrast, saturation, hue] =
            self.ranges.map(|[low, high]| (low + (high - low) * rng.random::<f64>()) as f32);
        (self.brightness, self.contrast) = (brightness, contrast);
        self.saturation = std::array::from_fn(|level| (level as f32 * saturation) as u8);
        self.hue = std::array::from_fn(|step| (step as f32 + hue * 180.0).rem_euclid(180.0) as u8 % 180);
    }

    fn apply(&mut self, frame: &mut FrameMut<'_>, _which: EpisodeFrame) {
        let pixels = frame.rgb.as_chunks_mut::<3>().0;
        let channels = self.channel_tables(pixels);
        let jitter = |[r, g, b]: [u8; 3]| {
            let [hue, saturation, value] =
                to_hsv([channels[0][r as usize], channels[1][g as usize], channels[2][b as usize]]);
            to_rgb([self.hue[hue as usize], self.saturation[saturation as usize], value])
        };
        // Most pixels of a drawn frame have the colour of their neighbour, so the last result is cached.
        let mut last = ([0; 3], jitter([0; 3]));
        for pixel in pixels {
            if *pixel != last.0 {
                last = (*pixel, jitter(*pixel));
            }
            *pixel = last.1;
        }
    }

    fn fork(&self) -> Box<dyn VisualWrapper> {
        Box::new(self.clone())
    }
}
