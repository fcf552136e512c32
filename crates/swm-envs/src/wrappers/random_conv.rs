//! A random convolution from three channels to three, sampled once per episode.
//!
//! Every channel of the result is the sum, over a window of `kernel_size`² pixels and the three channels, of the frame
//! times weights from N(0, 1 / (3 kernel_size²)), clipped to 0 ..= 255 and rounded down; edges are mirrored.
//!
//! | parameter | unit | default | range |
//! | --- | --- | --- | --- |
//! | `kernel_size` | pixels; even values mean the next odd one | 3 | 1 to 15 |
//!
//! Source: `RandomConvWrapper` of the reference (Lee et al. 2020, "Network Randomization"). The result is not
//! normalised, so about half of the channels are clipped to 0 in some areas, as in the reference.

use super::border::mirror;
use super::settings::{Domain, Parameter};
use super::{EpisodeFrame, VisualWrapper, WrapperEntry, gaussian, typed};
use rand::Rng as _;
use serde::Deserialize;
use swm_core::{FrameMut, Key};

/// The registry row of this wrapper.
pub const ENTRY: WrapperEntry = WrapperEntry {
    id: "random-conv",
    summary: "applies a random convolution, sampled once per episode",
    parameters: &[Parameter {
        name: "kernel_size",
        summary: "side of the window, pixels; even values mean the next odd one",
        domain: Domain::Integer { low: 1, high: 15 },
        default: Some("3"),
    }],
    build: |settings| {
        let Settings { kernel_size } = typed(ENTRY.id, settings)?;
        Ok(Box::new(RandomConv::new(kernel_size | 1)))
    },
};

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Settings {
    kernel_size: usize,
}

/// The number of pixels that are computed together.
const BLOCK: usize = 8;

#[derive(Clone)]
pub(super) struct RandomConv {
    side: usize,
    /// The weights of the three output channels, `[row, channel, column]`.
    weights: Vec<[f32; 3]>,
    /// The frame as `[height, channel, stride]`, each row with its mirrored surroundings.
    planes: Vec<f32>,
    /// One row of the output, in blocks of pixels.
    sums: Vec<[[f32; BLOCK]; 3]>,
}

impl RandomConv {
    pub fn new(side: usize) -> Self {
        let mut conv = Self { side, weights: vec![[0.0; 3]; 3 * side * side], planes: vec![], sums: vec![] };
        conv.reset(Key::new(0));
        conv
    }

    /// Sets the weights from a sequence in the order `[result, row, column, channel]`.
    pub fn set(&mut self, weights: impl Iterator<Item = f32>) {
        let side = self.side;
        for (i, weight) in weights.enumerate() {
            let [result, row, column, channel] = [i / (3 * side * side), i / (3 * side) % side, i / 3 % side, i % 3];
            self.weights[(row * 3 + channel) * side + column][result] = weight;
        }
    }
}

impl VisualWrapper for RandomConv {
    fn id(&self) -> &'static str {
        ENTRY.id
    }

    fn reset(&mut self, episode: Key) {
        let mut rng = episode.rng();
        let n = 3 * self.side * self.side;
        let deviation = (1.0 / n as f64).sqrt();
        self.set((0..3 * n).map(|_| (deviation * gaussian::quantile(rng.sample(rand::distr::Open01))) as f32));
    }

    fn apply(&mut self, frame: &mut FrameMut<'_>, _which: EpisodeFrame) {
        let (width, height, side) = (frame.width, frame.height, self.side);
        if frame.rgb.is_empty() {
            return;
        }
        let radius = side / 2;
        let stride = width.next_multiple_of(BLOCK) + 2 * radius;
        self.planes.resize(3 * stride * height, 0.0);
        let rows = frame.rgb.as_chunks::<3>().0.chunks_exact(width);
        for (row, planes) in rows.zip(self.planes.chunks_exact_mut(3 * stride)) {
            for (channel, plane) in planes.chunks_exact_mut(stride).enumerate() {
                for (x, value) in plane[..width + 2 * radius].iter_mut().enumerate() {
                    *value = f32::from(row[mirror(x as isize - radius as isize, width)][channel]);
                }
            }
        }
        let blocks = width.div_ceil(BLOCK);
        self.sums.resize(blocks, [[0.0; BLOCK]; 3]);
        for (y, row) in frame.rgb.as_chunks_mut::<3>().0.chunks_exact_mut(width).enumerate() {
            for (block, result) in self.sums.iter_mut().enumerate() {
                let [mut red, mut green, mut blue] = [[0.0; BLOCK]; 3];
                for (line, weights) in self.weights.chunks_exact(side).enumerate() {
                    let (from, channel) = (mirror((y + line / 3) as isize - radius as isize, height), line % 3);
                    let start = (3 * from + channel) * stride + block * BLOCK;
                    let plane = &self.planes[start..start + BLOCK + side - 1];
                    for (values, [r, g, b]) in plane.array_windows::<BLOCK>().zip(weights) {
                        for i in 0..BLOCK {
                            red[i] += r * values[i];
                            green[i] += g * values[i];
                            blue[i] += b * values[i];
                        }
                    }
                }
                *result = [red, green, blue];
            }
            for (pixels, sums) in row.chunks_mut(BLOCK).zip(&self.sums) {
                for (i, pixel) in pixels.iter_mut().enumerate() {
                    *pixel = [0, 1, 2].map(|channel| sums[channel][i] as u8);
                }
            }
        }
    }

    fn fork(&self) -> Box<dyn VisualWrapper> {
        Box::new(self.clone())
    }
}
