//! Layer normalisation of rows, plain and modulated.

use super::functions::{dot, sum};
use super::numbers;
use super::simd::{Kernel, Level, dispatch};
use crate::nn::LayerNorm;

/// The weights of a layer normalisation.
#[derive(Clone, Debug)]
pub struct Norm {
    weight: Vec<f32>,
    bias: Vec<f32>,
    epsilon: f32,
}

impl Norm {
    /// Those of a layer.
    #[allow(clippy::cast_possible_truncation)]
    pub fn new(layer: &LayerNorm) -> Self {
        Self { weight: numbers(layer.weight.val()), bias: numbers(layer.bias.val()), epsilon: layer.epsilon() as f32 }
    }

    /// Normalised rows.
    ///
    /// # Shapes
    /// `x` and `y` are `[rows, features]`.
    pub fn apply(&self, x: &[f32], y: &mut [f32]) {
        dispatch(Normalise { norm: self, modulation: None, x, y });
    }

    /// Rows standardised, modulated, and normalised.
    ///
    /// # Shapes
    /// As [`Norm::apply`].
    pub fn apply_modulated(&self, modulation: Modulation<'_>, x: &[f32], y: &mut [f32]) {
        dispatch(Normalise { norm: self, modulation: Some(modulation), x, y });
    }

    fn features(&self) -> usize {
        self.weight.len()
    }
}

/// Shift and scale of every row.
#[derive(Clone, Copy)]
pub struct Modulation<'a> {
    /// `[rows, parts * features]`.
    pub numbers: &'a [f32],
    /// How many parts there are.
    pub parts: usize,
    /// Which part the shift is; the scale follows it.
    pub shift: usize,
    /// What the standardisation before the modulation adds to the variance.
    pub epsilon: f32,
}

struct Normalise<'a> {
    norm: &'a Norm,
    modulation: Option<Modulation<'a>>,
    x: &'a [f32],
    y: &'a mut [f32],
}

impl Kernel for Normalise<'_> {
    type Output = ();

    #[inline(always)]
    fn run<L: Level>(self) {
        let (Norm { weight, bias, epsilon }, features) = (self.norm, self.norm.features());
        let rows = self.x.chunks_exact(features).zip(self.y.chunks_exact_mut(features));
        for (index, (x, y)) in rows.enumerate() {
            y.copy_from_slice(x);
            if let Some(Modulation { numbers, parts, shift, epsilon }) = self.modulation {
                let modulation = &numbers[(index * parts + shift) * features..][..2 * features];
                let (shift, scale) = modulation.split_at(features);
                let factor = centre::<L>(y, epsilon);
                for ((y, shift), scale) in y.iter_mut().zip(shift).zip(scale) {
                    *y = L::fma(*y * factor, 1.0 + scale, *shift);
                }
            }
            let factor = centre::<L>(y, *epsilon);
            for ((y, weight), bias) in y.iter_mut().zip(weight).zip(bias) {
                *y = L::fma(*y * factor, *weight, *bias);
            }
        }
    }
}

/// Takes the mean away; returns what makes the variance 1, up to `epsilon`.
#[inline(always)]
#[allow(clippy::cast_precision_loss)]
fn centre<L: Level>(row: &mut [f32], epsilon: f32) -> f32 {
    let n = row.len() as f32;
    let mean = sum(row) / n;
    for x in row.iter_mut() {
        *x -= mean;
    }
    1.0 / (dot::<L>(row, row) / n + epsilon).sqrt()
}

/// Takes the gradient of normalised rows back to the rows: adds it to `dx`, and to `weight` and `bias` what is theirs.
///
/// # Shapes
/// `x`, `dy` and `dx` are `[rows, features]`, `weight` and `bias` `[features]`.
pub fn backward(norm: &Norm, x: &[f32], dy: &[f32], dx: &mut [f32], [weight, bias]: [&mut [f32]; 2]) {
    struct Backward<'a> {
        norm: &'a Norm,
        x: &'a [f32],
        dy: &'a [f32],
        dx: &'a mut [f32],
        weight: &'a mut [f32],
        bias: &'a mut [f32],
        row: Vec<f32>,
        pull: Vec<f32>,
    }
    impl Kernel for Backward<'_> {
        type Output = ();

        #[inline(always)]
        #[allow(clippy::cast_precision_loss)]
        fn run<L: Level>(mut self) {
            let (features, n) = (self.norm.features(), self.norm.features() as f32);
            let rows = self.x.chunks_exact(features).zip(self.dy.chunks_exact(features));
            for ((x, dy), dx) in rows.zip(self.dx.chunks_exact_mut(features)) {
                self.row.copy_from_slice(x);
                let factor = centre::<L>(&mut self.row, self.norm.epsilon);
                for i in 0..features {
                    self.row[i] *= factor;
                    self.weight[i] = L::fma(dy[i], self.row[i], self.weight[i]);
                    self.bias[i] += dy[i];
                    self.pull[i] = dy[i] * self.norm.weight[i];
                }
                let (mean, along) = (sum(&self.pull) / n, dot::<L>(&self.pull, &self.row) / n);
                for i in 0..features {
                    dx[i] = L::fma(factor, self.pull[i] - mean - along * self.row[i], dx[i]);
                }
            }
        }
    }
    let scratch = || vec![0.0; norm.features()];
    dispatch(Backward { norm, x, dy, dx, weight, bias, row: scratch(), pull: scratch() });
}

/// Adds `y` to `x`, number by number; rows of `y` are gated by part `gate` of their modulations where there are some.
///
/// # Shapes
/// `x` and `y` are `[rows, features]`, modulations `[rows, parts * features]`.
pub fn add_gated(x: &mut [f32], y: &[f32], modulation: &[f32], [features, parts, gate]: [usize; 3]) {
    struct Add<'a> {
        x: &'a mut [f32],
        y: &'a [f32],
        modulation: &'a [f32],
        sizes: [usize; 3],
    }
    impl Kernel for Add<'_> {
        type Output = ();

        #[inline(always)]
        fn run<L: Level>(self) {
            let [features, parts, gate] = self.sizes;
            let rows = self.x.chunks_exact_mut(features).zip(self.y.chunks_exact(features));
            for ((x, y), modulation) in rows.zip(self.modulation.chunks_exact(parts * features)) {
                let gates = &modulation[gate * features..][..features];
                for ((x, y), gate) in x.iter_mut().zip(y).zip(gates) {
                    *x = L::fma(*gate, *y, *x);
                }
            }
        }
    }
    dispatch(Add { x, y, modulation, sizes: [features, parts, gate] });
}

/// Adds `y` to `x`.
pub fn add(x: &mut [f32], y: &[f32]) {
    for (x, y) in x.iter_mut().zip(y) {
        *x += y;
    }
}
