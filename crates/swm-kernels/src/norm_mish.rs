//! [`NormMish`]: bias, layer normalisation and Mish of a hidden layer in one pass over its rows.

use crate::functions::{dot, sum, tanh_softplus};
use crate::norm::center;
use swm_simd::{Kernel, Level, dispatch};

/// What follows the matrix product of a hidden layer: a bias, dropout, layer normalisation and Mish.
#[derive(Clone, Debug)]
pub struct NormMish {
    /// The bias of the product, `[features]`.
    pub bias: Vec<f32>,
    /// The scale of the normalisation, `[features]`.
    pub scale: Vec<f32>,
    /// The shift of the normalisation, `[features]`.
    pub shift: Vec<f32>,
    /// The value that the normalisation adds to the variance.
    pub epsilon: f32,
}

/// What the gradient needs from the forward pass. `T` is `&mut [f32]` while it is recorded, `&[f32]` afterwards.
#[derive(Debug)]
pub struct NormMishTape<T> {
    /// The standardised features, `[rows, features]`.
    pub standard: T,
    /// The slopes of Mish, `[rows, features]`.
    pub slopes: T,
    /// The factors by which the rows were standardised, `[rows]`.
    pub factors: T,
}

impl NormMish {
    /// Replaces products by the outputs of the layer. `mask`, which may be empty, holds the factors of dropout.
    ///
    /// # Shapes
    /// `x` and `mask` are `[rows, features]`.
    pub fn apply(&self, mask: &[f32], x: &mut [f32]) {
        dispatch(Forward { layer: self, mask, x, tape: None });
    }

    /// As [`NormMish::apply`]; also records what [`NormMish::backward`] needs.
    pub fn apply_recorded(&self, mask: &[f32], x: &mut [f32], tape: NormMishTape<&mut [f32]>) {
        dispatch(Forward { layer: self, mask, x, tape: Some(tape) });
    }

    /// Replaces the gradient `d` of the outputs by the gradient of the products, and returns the gradients of bias, scale and
    /// shift.
    ///
    /// # Shapes
    /// `d` and `mask`, which may be empty, are `[rows, features]`; returns `[features]` three times.
    pub fn backward(&self, mask: &[f32], tape: &NormMishTape<&[f32]>, d: &mut [f32]) -> [Vec<f32>; 3] {
        let mut sums = [(); 3].map(|()| vec![0.0; self.bias.len()]);
        dispatch(Backward { layer: self, mask, tape, d, sums: &mut sums, row: vec![0.0; self.bias.len()] });
        sums
    }
}

/// Returns a row of a mask that may be empty.
#[inline(always)]
fn row_of(mask: &[f32], index: usize, features: usize) -> Option<&[f32]> {
    (!mask.is_empty()).then(|| &mask[index * features..][..features])
}

struct Forward<'a> {
    layer: &'a NormMish,
    mask: &'a [f32],
    x: &'a mut [f32],
    tape: Option<NormMishTape<&'a mut [f32]>>,
}

impl Kernel for Forward<'_> {
    type Output = ();

    #[inline(always)]
    fn run<L: Level>(mut self) {
        let NormMish { bias, scale, shift, epsilon } = self.layer;
        let features = bias.len();
        for (index, x) in self.x.chunks_exact_mut(features).enumerate() {
            x.iter_mut().zip(bias).for_each(|(x, bias)| *x += bias);
            if let Some(mask) = row_of(self.mask, index, features) {
                x.iter_mut().zip(mask).for_each(|(x, mask)| *x *= mask);
            }
            let factor = center::<L>(x, *epsilon);
            x.iter_mut().for_each(|x| *x *= factor);
            let Some(tape) = &mut self.tape else {
                for ((x, scale), shift) in x.iter_mut().zip(scale).zip(shift) {
                    let z = L::fma(*x, *scale, *shift);
                    *x = z * tanh_softplus::<L>(z).0;
                }
                continue;
            };
            tape.factors[index] = factor;
            tape.standard[index * features..][..features].copy_from_slice(x);
            let slopes = &mut tape.slopes[index * features..][..features];
            for (((x, slope), scale), shift) in x.iter_mut().zip(slopes).zip(scale).zip(shift) {
                let z = L::fma(*x, *scale, *shift);
                let (tanh, logistic) = tanh_softplus::<L>(z);
                *slope = tanh + z * logistic * (1.0 - tanh * tanh);
                *x = z * tanh;
            }
        }
    }
}

struct Backward<'a> {
    layer: &'a NormMish,
    mask: &'a [f32],
    tape: &'a NormMishTape<&'a [f32]>,
    d: &'a mut [f32],
    sums: &'a mut [Vec<f32>; 3],
    /// The gradient of the standardised features of a row.
    row: Vec<f32>,
}

impl Kernel for Backward<'_> {
    type Output = ();

    #[inline(always)]
    fn run<L: Level>(mut self) {
        let features = self.row.len();
        let (row, scale) = (&mut self.row[..], &self.layer.scale[..features]);
        let [of_bias, of_scale, of_shift] = self.sums.each_mut().map(|sum| &mut sum[..features]);
        for (index, d) in self.d.chunks_exact_mut(features).enumerate() {
            let standard = &self.tape.standard[index * features..][..features];
            let slopes = &self.tape.slopes[index * features..][..features];
            let factor = self.tape.factors[index];
            for i in 0..features {
                let d = d[i] * slopes[i];
                of_shift[i] += d;
                of_scale[i] = L::fma(d, standard[i], of_scale[i]);
                row[i] = d * scale[i];
            }
            let (mean, correlation) = (sum(row) / features as f32, dot::<L>(row, standard) / features as f32);
            for i in 0..features {
                d[i] = factor * (row[i] - mean - correlation * standard[i]);
            }
            if let Some(mask) = row_of(self.mask, index, features) {
                d.iter_mut().zip(mask).for_each(|(d, mask)| *d *= mask);
            }
            of_bias.iter_mut().zip(d).for_each(|(sum, d)| *sum += *d);
        }
    }
}
