//! Pixel noise, sampled for every frame.
//!
//! **Gaussian**: a draw from N(0, `std`²) is added to every channel of every pixel; the sum is clipped to 0 ..= 255 and
//! rounded down. **Salt and pepper**: a share `amount` of the pixels becomes white or black, with equal probability.
//!
//! | parameter | unit | default | range |
//! | --- | --- | --- | --- |
//! | `kind` | | `gaussian` | `gaussian`, `salt-pepper` |
//! | `std` | levels of 255; value or schedule | 10 | 0 to 255 |
//! | `amount` | share of the pixels; value or schedule | 0.05 | 0 to 1 |
//!
//! Source: `NoiseWrapper` of the reference (Gaussian with a schedule); the paper's table adds salt and pepper, for
//! which `amount` is the usual measure. Deviations: a schedule counts the steps of the episode, where the reference
//! counts all steps since the wrapper was made; Gaussian draws are the centres of 8192 intervals of equal probability,
//! so no draw lies beyond 3.85 standard deviations.

use super::settings::{Domain, Parameter, Schedule};
use super::{EpisodeFrame, VisualWrapper, WrapperEntry, gaussian, typed};
use serde::Deserialize;
use std::sync::LazyLock;
use swm_core::{FrameMut, Key};

/// The registry row of this wrapper.
pub const ENTRY: WrapperEntry = WrapperEntry {
    id: "noise",
    summary: "adds Gaussian or salt-and-pepper noise, sampled in every step",
    parameters: &[
        Parameter {
            name: "kind",
            summary: "kind of noise",
            domain: Domain::Choice(&["gaussian", "salt-pepper"]),
            default: Some("gaussian"),
        },
        Parameter {
            name: "std",
            summary: "standard deviation of Gaussian noise, levels of 255",
            domain: Domain::Schedule { low: 0.0, high: 255.0 },
            default: Some("10"),
        },
        Parameter {
            name: "amount",
            summary: "share of the pixels that salt and pepper replaces",
            domain: Domain::Schedule { low: 0.0, high: 1.0 },
            default: Some("0.05"),
        },
    ],
    build: |settings| {
        let settings: Settings = typed(ENTRY.id, settings)?;
        Ok(Box::new(Noise { settings, episode: Key::new(0), table: vec![], table_std: f64::NAN }))
    },
};

#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct Settings {
    kind: Kind,
    std: Schedule,
    amount: Schedule,
}

#[derive(Clone, Copy, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Kind {
    Gaussian,
    SaltPepper,
}

/// The number of intervals of the normal distribution; a power of 2.
const INTERVALS: usize = 8192;

/// The centres of the intervals, scaled to a variance of 1 (the discretisation reduces the variance by 0.02 %).
static STANDARD: LazyLock<Vec<f64>> = LazyLock::new(|| {
    let mut centres: Vec<f64> =
        (0..INTERVALS).map(|i| gaussian::quantile((i as f64 + 0.5) / INTERVALS as f64)).collect();
    let deviation = (centres.iter().map(|z| z * z).sum::<f64>() / INTERVALS as f64).sqrt();
    centres.iter_mut().for_each(|z| *z /= deviation);
    centres
});

#[derive(Clone)]
struct Noise {
    settings: Settings,
    episode: Key,
    /// The change of a channel for each interval of the normal distribution, at the standard deviation `table_std`.
    table: Vec<i16>,
    /// The standard deviation for which `table` was computed.
    table_std: f64,
}

/// The SplitMix64 generator. A frame needs tens of thousands of draws, so the generator must be fast.
struct SplitMix64(u64);

impl SplitMix64 {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }
}

impl Noise {
    /// Adds Gaussian noise. Rounding the noise down before the addition equals rounding the sum down, because channels
    /// are integers.
    fn gaussian(&mut self, rgb: &mut [u8], std: f64, mut random: SplitMix64) {
        if std <= 0.0 {
            return;
        }
        if self.table_std.to_bits() != std.to_bits() {
            self.table.clear();
            self.table.extend(STANDARD.iter().map(|z| (z * std).floor() as i16));
            self.table_std = std;
        }
        // A table of constant length needs no bounds checks.
        let Some(table) = self.table.first_chunk::<INTERVALS>() else { return };
        let mut add = |channels: &mut [u8]| {
            let bits = random.next();
            for (i, channel) in channels.iter_mut().enumerate() {
                let noise = table[(bits >> (16 * i)) as usize % INTERVALS];
                *channel = (i16::from(*channel) + noise).clamp(0, 255) as u8;
            }
        };
        let (fours, rest) = rgb.as_chunks_mut::<4>();
        fours.iter_mut().for_each(|channels| add(channels));
        add(rest);
    }
}

/// Replaces each pixel with probability `amount` by black or white, with equal probability. One uniform draw of 32 bits
/// decides both: below a threshold the pixel is replaced, below half the threshold by black.
fn salt_pepper(rgb: &mut [u8], amount: f64, mut random: SplitMix64) {
    let threshold = (amount * 2f64.powi(32)).round() as u64;
    for pixels in rgb.chunks_mut(6) {
        let mut bits = random.next();
        for pixel in pixels.as_chunks_mut::<3>().0 {
            let draw = bits & 0xffff_ffff;
            if draw < threshold {
                *pixel = [if 2 * draw < threshold { 0 } else { 255 }; 3];
            }
            bits >>= 32;
        }
    }
}

impl VisualWrapper for Noise {
    fn id(&self) -> &'static str {
        ENTRY.id
    }

    fn reset(&mut self, episode: Key) {
        self.episode = episode;
    }

    fn apply(&mut self, frame: &mut FrameMut<'_>, which: EpisodeFrame) {
        let random = SplitMix64(which.key(self.episode).seed());
        match self.settings.kind {
            Kind::Gaussian => self.gaussian(frame.rgb, self.settings.std.at(which.step()), random),
            Kind::SaltPepper => salt_pepper(frame.rgb, self.settings.amount.at(which.step()), random),
        }
    }

    fn fork(&self) -> Box<dyn VisualWrapper> {
        Box::new(self.clone())
    }
}
