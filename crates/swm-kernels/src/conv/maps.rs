//! Operations on the channels of feature maps: batch normalisation, ReLU and their gradients.
//!
//! Maps are `[pixels, width]`, and the width is a multiple of the number of SIMD lanes.

use super::geometry::Geometry;
use crate::panels::LANES;
use swm_simd::{F32x16, Kernel, Level, dispatch};

/// Mean and spread of every channel over pixels.
#[derive(Clone, Debug)]
pub(super) struct Moments {
    pub count: f64,
    pub mean: Vec<f64>,
    /// Sum of the squared distances from the mean.
    pub squares: Vec<f64>,
}

impl Moments {
    pub fn new(width: usize) -> Self {
        Self { count: 0.0, mean: vec![0.0; width], squares: vec![0.0; width] }
    }

    /// Adds the pixels of a map.
    pub fn add_map(&mut self, y: &[f32]) {
        let width = self.mean.len();
        let count = (y.len() / width) as f64;
        let sums = dispatch(PivotedSums { y, width });
        for (channel, [sum, squares]) in sums.into_iter().enumerate() {
            let (sum, squares) = (f64::from(sum), f64::from(squares));
            self.add(channel, count, f64::from(y[channel]) + sum / count, squares - sum * sum / count);
        }
        self.count += count;
    }

    /// Adds the pixels of other moments.
    pub fn merge(mut self, other: &Self) -> Self {
        for channel in 0..self.mean.len() {
            self.add(channel, other.count, other.mean[channel], other.squares[channel]);
        }
        self.count += other.count;
        self
    }

    /// Adds moments to those of a channel (Chan, Golub and LeVeque 1983).
    fn add(&mut self, channel: usize, count: f64, mean: f64, squares: f64) {
        let (total, distance) = (self.count + count, mean - self.mean[channel]);
        self.mean[channel] += distance * count / total;
        self.squares[channel] += squares + distance * distance * self.count * count / total;
    }
}

/// Sums and squared sums of every channel. The values of the first pixel are subtracted, so that the squares of a channel
/// whose mean is far from 0 keep their precision.
struct PivotedSums<'a> {
    y: &'a [f32],
    width: usize,
}

impl Kernel for PivotedSums<'_> {
    type Output = Vec<[f32; 2]>;

    #[inline(always)]
    fn run<L: Level>(self) -> Vec<[f32; 2]> {
        let simd = L::f32x16();
        let vectors = self.width / LANES;
        let y = self.y.as_chunks::<LANES>().0;
        let mut all = Vec::with_capacity(self.width);
        for vector in 0..vectors {
            let pivot = simd.load(&y[vector]);
            let (mut sum, mut squares) = (simd.splat(0.0), simd.splat(0.0));
            for y in y[vector..].iter().step_by(vectors) {
                let distance = simd.sub(simd.load(y), pivot);
                sum = simd.add(sum, distance);
                squares = simd.fma(distance, distance, squares);
            }
            let (mut sums, mut squared) = ([0.0; LANES], [0.0; LANES]);
            simd.store(sum, &mut sums);
            simd.store(squares, &mut squared);
            all.extend((0..LANES).map(|lane| [sums[lane], squared[lane]]));
        }
        all
    }
}

/// Coefficients of the activation `relu(scale * y + shift)` for every channel.
#[derive(Clone, Debug)]
pub(super) struct Activation {
    pub scale: Vec<f32>,
    pub shift: Vec<f32>,
    pub mean: Vec<f32>,
}

impl Activation {
    /// Returns the activation without normalisation.
    pub fn relu(width: usize) -> Self {
        Self { scale: vec![1.0; width], shift: vec![0.0; width], mean: vec![0.0; width] }
    }

    /// Writes the activations of maps to the inputs of the next layer; their margins keep their zeros.
    pub fn apply(&self, y: &[f32], next: &Geometry, padded: &mut [f32]) {
        next.copy_rows(y, padded, |from, to| dispatch(Activate { activation: self, from, to }));
    }
}

struct Activate<'a> {
    activation: &'a Activation,
    from: &'a [f32],
    to: &'a mut [f32],
}

impl Kernel for Activate<'_> {
    type Output = ();

    #[inline(always)]
    fn run<L: Level>(self) {
        let simd = L::f32x16();
        let Activation { scale, shift, .. } = self.activation;
        let (scale, shift) = (scale.as_chunks::<LANES>().0, shift.as_chunks::<LANES>().0);
        let pixels = self.from.as_chunks::<LANES>().0.chunks_exact(scale.len());
        for (from, to) in pixels.zip(self.to.as_chunks_mut::<LANES>().0.chunks_exact_mut(scale.len())) {
            for (((from, to), scale), shift) in from.iter().zip(to).zip(scale).zip(shift) {
                let normal = simd.fma(simd.load(from), simd.load(scale), simd.load(shift));
                simd.store(simd.max(normal, simd.splat(0.0)), to);
            }
        }
    }
}

/// Adds, for every channel, the sum of the gradients `d` of active values, and of their products with `y - mean`.
///
/// # Shapes
/// `d` and `y` are `[pixels, width]`, `sums` is `[2, width]`.
pub(super) fn add_norm_gradient(activation: &Activation, d: &[f32], y: &[f32], sums: &mut [f64]) {
    dispatch(NormGradient { activation, d, y, sums });
}

struct NormGradient<'a> {
    activation: &'a Activation,
    d: &'a [f32],
    y: &'a [f32],
    sums: &'a mut [f64],
}

impl Kernel for NormGradient<'_> {
    type Output = ();

    #[inline(always)]
    fn run<L: Level>(self) {
        let simd = L::f32x16();
        let Activation { scale, shift, mean } = self.activation;
        let width = scale.len();
        let vectors = width / LANES;
        let (d, y) = (self.d.as_chunks::<LANES>().0, self.y.as_chunks::<LANES>().0);
        for v in 0..vectors {
            let (scale, shift, mean) = (vector::<L>(scale, v), vector::<L>(shift, v), vector::<L>(mean, v));
            let (mut sum, mut products) = (simd.splat(0.0), simd.splat(0.0));
            for (d, y) in d[v..].iter().step_by(vectors).zip(y[v..].iter().step_by(vectors)) {
                let y = simd.load(y);
                let d = simd.where_positive(simd.fma(y, scale, shift), simd.load(d));
                sum = simd.add(sum, d);
                products = simd.fma(d, simd.sub(y, mean), products);
            }
            for (part, sum) in [sum, products].into_iter().enumerate() {
                let mut lanes = [0.0; LANES];
                simd.store(sum, &mut lanes);
                let sums = &mut self.sums[part * width + v * LANES..][..LANES];
                sums.iter_mut().zip(lanes).for_each(|(sum, lane)| *sum += f64::from(lane));
            }
        }
    }
}

/// Coefficients of the gradient of `y`: `factor * d + slope * (y - mean) + offset`, where `d` is 0 for inactive values.
#[derive(Clone, Debug)]
pub(super) struct GradientCoefficients {
    pub factor: Vec<f32>,
    pub slope: Vec<f32>,
    pub offset: Vec<f32>,
}

impl GradientCoefficients {
    /// Returns the coefficients of an activation without normalisation.
    pub fn relu(width: usize) -> Self {
        Self { factor: vec![1.0; width], slope: vec![0.0; width], offset: vec![0.0; width] }
    }

    /// Writes the gradients of the maps `y`, whose activations have the gradients `d`, to padded maps; the margins keep
    /// their zeros.
    pub fn apply(&self, activation: &Activation, d: &[f32], y: &[f32], geometry: &Geometry, padded: &mut [f32]) {
        let maps = d.chunks_exact(geometry.output()).zip(y.chunks_exact(geometry.output()));
        for ((d, y), to) in maps.zip(padded.chunks_exact_mut(geometry.padded_gradient())) {
            let row = geometry.out * geometry.outputs;
            let rows = to.chunks_exact_mut(geometry.gradient_side() * geometry.outputs);
            for ((d, y), to) in d.chunks_exact(row).zip(y.chunks_exact(row)).zip(rows) {
                dispatch(Differentiate { coefficients: self, activation, d, y, to: &mut to[..row] });
            }
        }
    }
}

struct Differentiate<'a> {
    coefficients: &'a GradientCoefficients,
    activation: &'a Activation,
    d: &'a [f32],
    y: &'a [f32],
    to: &'a mut [f32],
}

impl Kernel for Differentiate<'_> {
    type Output = ();

    #[inline(always)]
    fn run<L: Level>(self) {
        let simd = L::f32x16();
        let Activation { scale, shift, mean } = self.activation;
        let GradientCoefficients { factor, slope, offset } = self.coefficients;
        let vectors = scale.len() / LANES;
        let (d, y) = (self.d.as_chunks::<LANES>().0, self.y.as_chunks::<LANES>().0);
        let to = self.to.as_chunks_mut::<LANES>().0;
        for v in 0..vectors {
            let (scale, shift, mean) = (vector::<L>(scale, v), vector::<L>(shift, v), vector::<L>(mean, v));
            let (factor, slope, offset) = (vector::<L>(factor, v), vector::<L>(slope, v), vector::<L>(offset, v));
            let inputs = d[v..].iter().step_by(vectors).zip(y[v..].iter().step_by(vectors));
            for ((d, y), to) in inputs.zip(to[v..].iter_mut().step_by(vectors)) {
                let y = simd.load(y);
                let d = simd.where_positive(simd.fma(y, scale, shift), simd.load(d));
                simd.store(simd.fma(d, factor, simd.fma(simd.sub(y, mean), slope, offset)), to);
            }
        }
    }
}

/// Loads a vector of the channels.
#[inline(always)]
fn vector<L: Level>(channels: &[f32], index: usize) -> <L::F32x16 as F32x16>::Vector {
    L::f32x16().load(&channels.as_chunks::<LANES>().0[index])
}
