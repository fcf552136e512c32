//! Gaussian blur: a separable window of `kernel` pixels, mirrored at the edges of the frame.
//!
//! | parameter | unit | default | range |
//! | --- | --- | --- | --- |
//! | `kernel` | pixels; even values mean the next odd one | 5 | 1 to 99 |
//! | `sigma` | pixels; 0: `0.3 (kernel - 1) / 2 + 0.5` | 0 | 0 to 100 |
//!
//! Source: `BlurWrapper` of the reference, which calls OpenCV. The result is equal bit for bit: the window is in units
//! of 2⁻⁸, and for kernels up to 7 pixels without a `sigma` it is OpenCV's fixed window.

use super::border::mirror;
use super::settings::{Domain, Parameter};
use super::{EpisodeFrame, VisualWrapper, WrapperEntry, typed};
use serde::Deserialize;
use swm_core::FrameMut;

/// The registry row of this wrapper.
pub const ENTRY: WrapperEntry = WrapperEntry {
    id: "blur",
    summary: "blurs with a Gaussian window",
    parameters: &[
        Parameter {
            name: "kernel",
            summary: "side of the window, pixels; even values mean the next odd one",
            domain: Domain::Integer { low: 1, high: 99 },
            default: Some("5"),
        },
        Parameter {
            name: "sigma",
            summary: "standard deviation, pixels; 0 follows from the kernel",
            domain: Domain::Number { low: 0.0, high: 100.0 },
            default: Some("0"),
        },
    ],
    build: |settings| {
        let Settings { kernel, sigma } = typed(ENTRY.id, settings)?;
        Ok(Box::new(Blur { weights: window(kernel | 1, sigma), ..Blur::default() }))
    },
};

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Settings {
    kernel: usize,
    sigma: f64,
}

/// Returns weights with the sum 256, `[kernel]`. The rounding error of a weight is added to its inner neighbour.
fn window(kernel: usize, sigma: f64) -> Vec<u16> {
    match (kernel, sigma > 0.0) {
        (1, _) => return vec![256],
        (3, false) => return vec![64, 128, 64],
        (5, false) => return vec![16, 64, 96, 64, 16],
        (7, false) => return vec![8, 28, 56, 72, 56, 28, 8],
        _ => {}
    }
    let radius = kernel / 2;
    let sigma = if sigma > 0.0 { sigma } else { 0.3 * (radius as f64 - 1.0) + 0.8 };
    let exact: Vec<f64> = (0..kernel).map(|i| (-0.5 * ((i as f64 - radius as f64) / sigma).powi(2)).exp()).collect();
    let total: f64 = exact.iter().sum();
    let mut weights = vec![0; kernel];
    let mut lost = 0.0;
    for i in 0..radius {
        let wanted = 256.0 * exact[i] / total + lost;
        let weight = wanted.round_ties_even();
        lost = wanted - weight;
        (weights[i], weights[kernel - 1 - i]) = (weight as u16, weight as u16);
    }
    weights[radius] = 256 - weights.iter().sum::<u16>();
    weights
}

#[derive(Clone, Default)]
struct Blur {
    weights: Vec<u16>,
    /// A row of the frame with its mirrored surroundings.
    line: Vec<u8>,
    /// The frame blurred along its rows, in units of 2⁻⁸.
    across: Vec<u16>,
    /// One row of the result, in units of 2⁻¹⁶.
    sum: Vec<u32>,
}

impl VisualWrapper for Blur {
    fn id(&self) -> &'static str {
        ENTRY.id
    }

    fn apply(&mut self, frame: &mut FrameMut<'_>, _which: EpisodeFrame) {
        let (width, height, radius) = (frame.width, frame.height, self.weights.len() / 2);
        if frame.rgb.is_empty() || radius == 0 {
            return;
        }
        let stride = 3 * width;
        self.line.resize(stride + 6 * radius, 0);
        self.across.resize(stride * height, 0);
        self.sum.resize(stride, 0);
        for (row, across) in frame.rgb.chunks_exact(stride).zip(self.across.chunks_exact_mut(stride)) {
            self.line[3 * radius..][..stride].copy_from_slice(row);
            let (row, line) = (row.as_chunks::<3>().0, self.line.as_chunks_mut::<3>().0);
            for i in 0..radius {
                line[i] = row[mirror(i as isize - radius as isize, width)];
                line[radius + width + i] = row[mirror((width + i) as isize, width)];
            }
            across.fill(0);
            for (tap, &weight) in self.weights.iter().enumerate() {
                for (sum, &channel) in across.iter_mut().zip(&self.line[3 * tap..]) {
                    *sum += weight * u16::from(channel);
                }
            }
        }
        for (y, row) in frame.rgb.chunks_exact_mut(stride).enumerate() {
            self.sum.fill(1 << 15);
            for (tap, &weight) in self.weights.iter().enumerate() {
                let from = mirror((y + tap) as isize - radius as isize, height);
                for (sum, &channel) in self.sum.iter_mut().zip(&self.across[stride * from..][..stride]) {
                    *sum += u32::from(weight) * u32::from(channel);
                }
            }
            for (channel, sum) in row.iter_mut().zip(&self.sum) {
                *channel = (sum >> 16) as u8;
            }
        }
    }

    fn fork(&self) -> Box<dyn VisualWrapper> {
        Box::new(self.clone())
    }
}
