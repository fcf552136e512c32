//! Layer normalisation of rows, plain and modulated (AdaLN, Peebles and Xie 2023).

use crate::Affine;
use crate::functions::{dot, sum};
use swm_simd::{Kernel, Level, dispatch};

/// A layer normalisation: scale and shift per feature, and the constant added to the variance.
#[derive(Clone, Debug)]
pub struct Norm {
    weight: Vec<f32>,
    bias: Vec<f32>,
    epsilon: f32,
}

impl Norm {
    /// Creates a normalisation that adds `epsilon` to the variance.
    pub fn new(parameters: Affine, epsilon: f32) -> Self {
        Self { weight: parameters.weight, bias: parameters.bias, epsilon }
    }

    /// Writes the normalised rows of `x` to `y`.
    ///
    /// # Shapes
    /// `x` and `y` are `[rows, features]`.
    pub fn apply(&self, x: &[f32], y: &mut [f32]) {
        dispatch(Normalise { norm: self, modulation: None, x, y });
    }

    /// Standardises and modulates the rows of `x`, and writes the normalised rows to `y`.
    ///
    /// # Shapes
    /// `x` and `y` are `[rows, features]`.
    pub fn apply_modulated(&self, modulation: Modulation<'_>, x: &[f32], y: &mut [f32]) {
        dispatch(Normalise { norm: self, modulation: Some(modulation), x, y });
    }

    fn features(&self) -> usize {
        self.weight.len()
    }
}

/// Shift and scale of every row, as parts of a larger array of modulations.
#[derive(Clone, Copy)]
pub struct Modulation<'a> {
    /// The modulations, `[rows, parts * features]`.
    pub values: &'a [f32],
    /// Number of parts.
    pub parts: usize,
    /// Index of the part that holds the shift; the scale is the next part.
    pub shift: usize,
    /// The constant that the standardisation before the modulation adds to the variance.
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
            if let Some(Modulation { values, parts, shift, epsilon }) = self.modulation {
                let modulation = &values[(index * parts + shift) * features..][..2 * features];
                let (shift, scale) = modulation.split_at(features);
                let factor = center::<L>(y, epsilon);
                for ((y, shift), scale) in y.iter_mut().zip(shift).zip(scale) {
                    *y = L::fma(*y * factor, 1.0 + scale, *shift);
                }
            }
            let factor = center::<L>(y, *epsilon);
            for ((y, weight), bias) in y.iter_mut().zip(weight).zip(bias) {
                *y = L::fma(*y * factor, *weight, *bias);
            }
        }
    }
}

/// Subtracts the mean and returns the factor `1 / sqrt(variance + epsilon)`.
#[inline(always)]
pub(crate) fn center<L: Level>(row: &mut [f32], epsilon: f32) -> f32 {
    let n = row.len() as f32;
    let mean = sum(row) / n;
    for x in row.iter_mut() {
        *x -= mean;
    }
    1.0 / (dot::<L>(row, row) / n + epsilon).sqrt()
}

/// Adds the gradients of a normalisation, whose output has the gradient `dy`, to `dx`, `weight` and `bias`.
///
/// # Shapes
/// `x`, `dy` and `dx` are `[rows, features]`, `weight` and `bias` are `[features]`.
pub(crate) fn backward(norm: &Norm, x: &[f32], dy: &[f32], dx: &mut [f32], [weight, bias]: [&mut [f32]; 2]) {
    struct Backward<'a> {
        norm: &'a Norm,
        x: &'a [f32],
        dy: &'a [f32],
        dx: &'a mut [f32],
        weight: &'a mut [f32],
        bias: &'a mut [f32],
        row: Vec<f32>,
        scaled: Vec<f32>,
    }
    impl Kernel for Backward<'_> {
        type Output = ();

        #[inline(always)]
        fn run<L: Level>(mut self) {
            let (features, n) = (self.norm.features(), self.norm.features() as f32);
            let rows = self.x.chunks_exact(features).zip(self.dy.chunks_exact(features));
            for ((x, dy), dx) in rows.zip(self.dx.chunks_exact_mut(features)) {
                self.row.copy_from_slice(x);
                let factor = center::<L>(&mut self.row, self.norm.epsilon);
                for i in 0..features {
                    self.row[i] *= factor;
                    self.weight[i] = L::fma(dy[i], self.row[i], self.weight[i]);
                    self.bias[i] += dy[i];
                    self.scaled[i] = dy[i] * self.norm.weight[i];
                }
                let (mean, correlation) = (sum(&self.scaled) / n, dot::<L>(&self.scaled, &self.row) / n);
                for i in 0..features {
                    dx[i] = L::fma(factor, self.scaled[i] - mean - correlation * self.row[i], dx[i]);
                }
            }
        }
    }
    let scratch = || vec![0.0; norm.features()];
    dispatch(Backward { norm, x, dy, dx, weight, bias, row: scratch(), scaled: scratch() });
}

/// Adds the rows of `y`, each multiplied element by element by part `gate` of the row's modulation, to `x`.
///
/// # Shapes
/// `x` and `y` are `[rows, features]`, `modulation` is `[rows, parts * features]`.
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
