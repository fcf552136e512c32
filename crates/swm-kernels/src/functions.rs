//! Element-wise functions, softmax and reductions, written without branches and calls so that compilers vectorise them.

use crate::panels::LANES;
use swm_simd::{Kernel, Level, dispatch};

/// Replaces every element by its GELU, `x Φ(x)` (Hendrycks and Gimpel 2016), with an error below 1e-6.
///
/// `Φ` is the standard normal distribution function, computed with the error function, not approximated by `tanh`.
pub fn gelu(x: &mut [f32]) {
    struct Gelu<'a>(&'a mut [f32]);
    impl Kernel for Gelu<'_> {
        type Output = ();

        #[inline(always)]
        fn run<L: Level>(self) {
            for x in self.0 {
                *x *= 0.5 + half_erf::<L>(*x);
            }
        }
    }
    dispatch(Gelu(x));
}

/// Computes the tangent of [`gelu`] at every element: replaces `x` by the value of the tangent line at 0, `-x² φ(x)`,
/// and writes the slope of the line, `Φ(x) + x φ(x)`, to `slopes`. `φ` is the standard normal density.
///
/// # Shapes
/// `x` and `slopes` have the same length.
pub fn gelu_tangent(x: &mut [f32], slopes: &mut [f32]) {
    struct Tangent<'a>(&'a mut [f32], &'a mut [f32]);
    impl Kernel for Tangent<'_> {
        type Output = ();

        #[inline(always)]
        fn run<L: Level>(self) {
            /// The standard normal density at 0, `1 / √(2π)`.
            const HEIGHT: f32 = 0.398_942_3;
            for (x, slope) in self.0.iter_mut().zip(self.1) {
                let x_density = *x * HEIGHT * exp::<L>(-0.5 * *x * *x);
                *slope = 0.5 + half_erf::<L>(*x) + x_density;
                *x *= -x_density;
            }
        }
    }
    dispatch(Tangent(x, slopes));
}

/// Replaces every element by `x / (1 + exp(-x))` (SiLU).
pub fn silu(x: &mut [f32]) {
    struct Silu<'a>(&'a mut [f32]);
    impl Kernel for Silu<'_> {
        type Output = ();

        #[inline(always)]
        fn run<L: Level>(self) {
            for x in self.0 {
                let e = exp::<L>(-x.abs());
                *x *= if *x < 0.0 { e } else { 1.0 } / (1.0 + e);
            }
        }
    }
    dispatch(Silu(x));
}

/// Replaces every element by its Mish (Misra 2019), `x tanh(ln(1 + exp x))`.
pub fn mish(x: &mut [f32]) {
    struct Mish<'a>(&'a mut [f32]);
    impl Kernel for Mish<'_> {
        type Output = ();

        #[inline(always)]
        fn run<L: Level>(self) {
            for x in self.0 {
                let (tanh, _) = tanh_softplus::<L>(*x);
                *x *= tanh;
            }
        }
    }
    dispatch(Mish(x));
}

/// Computes the tangent of [`mish`] at every element: replaces `x` by the value of the tangent line at 0, and writes the slope
/// of the line to `slopes`. For `t = tanh(ln(1 + exp x))` and the logistic function `σ`, the slope is `t + x σ(x) (1 - t²)`.
///
/// # Shapes
/// `x` and `slopes` have the same length.
pub fn mish_tangent(x: &mut [f32], slopes: &mut [f32]) {
    struct Tangent<'a>(&'a mut [f32], &'a mut [f32]);
    impl Kernel for Tangent<'_> {
        type Output = ();

        #[inline(always)]
        fn run<L: Level>(self) {
            for (x, slope) in self.0.iter_mut().zip(self.1) {
                let (tanh, logistic) = tanh_softplus::<L>(*x);
                let rest = *x * logistic * (1.0 - tanh * tanh);
                *slope = tanh + rest;
                *x *= -rest;
            }
        }
    }
    dispatch(Tangent(x, slopes));
}

/// Returns `tanh(ln(1 + exp x))` and `1 / (1 + exp(-x))`.
#[inline(always)]
pub(crate) fn tanh_softplus<L: Level>(x: f32) -> (f32, f32) {
    // With e = exp(-|x|), which is at most 1: (1 + 2 e) / (1 + 2 e + 2 e²) above 0, e (e + 2) / (e (e + 2) + 2) below.
    let e = exp::<L>(-x.abs());
    let is_negative = x < 0.0;
    let numerator = if is_negative { e * (e + 2.0) } else { 1.0 + 2.0 * e };
    let rest = if is_negative { 2.0 } else { 2.0 * e * e };
    (numerator / (numerator + rest), if is_negative { e } else { 1.0 } / (1.0 + e))
}

/// Returns `Φ(x) - 1/2`, half the error function of `x / √2`, by a fitted rational function with an error of at most
/// 2e-7.
#[inline(always)]
fn half_erf<L: Level>(x: f32) -> f32 {
    let x = x.clamp(-5.6, 5.6);
    let t = x * x;
    let horner = |coefficients: [f32; 6]| {
        coefficients[..5].iter().rev().fold(coefficients[5], |sum, coefficient| L::fma(sum, t, *coefficient))
    };
    let numerator = horner([0.398_942_23, 0.034_376_13, 4.707_261e-3, 1.738_510_2e-4, 6.356_537_6e-6, 2.214_531_8e-8]);
    let denominator = horner([1.0, 0.252_833_9, 0.028_940_102, 1.912_979_8e-3, 7.510_203_4e-5, 1.180_212_6e-6]);
    (x * numerator / denominator).clamp(-0.5, 0.5)
}

/// Returns the exponential of `x <= 0` as a power of two times a polynomial.
#[inline(always)]
pub(crate) fn exp<L: Level>(x: f32) -> f32 {
    /// 1.5 times 2²³: adding this constant leaves the nearest integer in the low bits.
    const ROUND: f32 = 12_582_912.0;
    let x = x.max(-87.0);
    let shifted = L::fma(x, std::f32::consts::LOG2_E, ROUND);
    let power = shifted - ROUND;
    let r = L::fma(power, 2.121_944_4e-4, L::fma(power, -0.693_359_4, x));
    let coefficients = [1.0, 1.0, 0.5, 0.166_666_57, 0.041_665_796, 8.333_45e-3];
    let series = coefficients.iter().rev().fold(1.398_2e-3, |sum, coefficient| L::fma(sum, r, *coefficient));
    let scale = f32::from_bits(shifted.to_bits().wrapping_sub(ROUND.to_bits()).wrapping_add(127) << 23);
    series * scale
}

/// Returns the sum of the elements of `x`, accumulated in separate lanes.
#[inline(always)]
pub(crate) fn sum(x: &[f32]) -> f32 {
    let mut lanes = [0.0f32; LANES];
    let (chunks, rest) = x.as_chunks::<LANES>();
    for chunk in chunks {
        for lane in 0..LANES {
            lanes[lane] += chunk[lane];
        }
    }
    fold(lanes) + rest.iter().sum::<f32>()
}

/// Returns the scalar product of `a` and `b`, which have the same length, accumulated in separate lanes.
#[inline(always)]
pub(crate) fn dot<L: Level>(a: &[f32], b: &[f32]) -> f32 {
    let mut lanes = [0.0f32; LANES];
    let ((a, a_rest), (b, b_rest)) = (a.as_chunks::<LANES>(), b.as_chunks::<LANES>());
    for (a, b) in a.iter().zip(b) {
        for lane in 0..LANES {
            lanes[lane] = L::fma(a[lane], b[lane], lanes[lane]);
        }
    }
    fold(lanes) + a_rest.iter().zip(b_rest).map(|(a, b)| a * b).sum::<f32>()
}

/// Returns the sum of all lanes, halving the number of lanes at each step.
#[inline(always)]
fn fold(mut lanes: [f32; LANES]) -> f32 {
    let mut width = LANES / 2;
    while width > 0 {
        for lane in 0..width {
            lanes[lane] += lanes[lane + width];
        }
        width /= 2;
    }
    lanes[0]
}

/// Computes `to += factor * x` for slices of the same length.
#[inline(always)]
pub(crate) fn add_scaled<L: Level>(to: &mut [f32], factor: f32, x: &[f32]) {
    for (to, x) in to.iter_mut().zip(x) {
        *to = L::fma(factor, *x, *to);
    }
}

/// Replaces every row by the softmax of the row.
///
/// # Shapes
/// `x` is `[rows, width]`.
pub fn softmax(x: &mut [f32], width: usize) {
    struct Softmax<'a>(&'a mut [f32], usize);
    impl Kernel for Softmax<'_> {
        type Output = ();

        #[inline(always)]
        fn run<L: Level>(self) {
            for row in self.0.chunks_exact_mut(self.1) {
                let max = max(row);
                for x in row.iter_mut() {
                    *x = exp::<L>(*x - max);
                }
                let factor = 1.0 / sum(row);
                for x in row {
                    *x *= factor;
                }
            }
        }
    }
    dispatch(Softmax(x, width));
}

/// Replaces the gradient `d` of the output of a [`softmax`] by the gradient of the input.
///
/// # Shapes
/// `weights`, the output of the softmax, and `d` are `[rows, width]`.
pub fn softmax_backward(weights: &[f32], d: &mut [f32], width: usize) {
    struct Backward<'a>(&'a [f32], &'a mut [f32], usize);
    impl Kernel for Backward<'_> {
        type Output = ();

        #[inline(always)]
        fn run<L: Level>(self) {
            for (weights, d) in self.0.chunks_exact(self.2).zip(self.1.chunks_exact_mut(self.2)) {
                let mean = dot::<L>(weights, d);
                for (weight, d) in weights.iter().zip(d) {
                    *d = weight * (*d - mean);
                }
            }
        }
    }
    dispatch(Backward(weights, d, width));
}

/// Computes `x *= slopes` element by element.
///
/// # Shapes
/// `x` and `slopes` have the same shape.
pub fn multiply(x: &mut [f32], slopes: &[f32]) {
    x.iter_mut().zip(slopes).for_each(|(x, slope)| *x *= slope);
}

/// Computes `offsets += x * slopes` element by element.
///
/// # Shapes
/// `offsets`, `x` and `slopes` have the same shape.
pub fn multiply_add(offsets: &mut [f32], x: &[f32], slopes: &[f32]) {
    offsets.iter_mut().zip(x).zip(slopes).for_each(|((offset, x), slope)| *offset += x * slope);
}

/// Adds all rows of `x` to `sum`.
///
/// # Shapes
/// `x` is `[rows, features]`, `sum` is `[features]`.
pub fn add_rows(sum: &mut [f32], x: &[f32]) {
    for row in x.chunks_exact(sum.len()) {
        sum.iter_mut().zip(row).for_each(|(sum, x)| *sum += x);
    }
}

/// Adds `y` to `x` element by element.
///
/// # Shapes
/// `x` and `y` have the same shape.
pub fn add(x: &mut [f32], y: &[f32]) {
    for (x, y) in x.iter_mut().zip(y) {
        *x += y;
    }
}

/// Returns the largest element of `x`.
#[inline(always)]
fn max(x: &[f32]) -> f32 {
    let mut max = [f32::NEG_INFINITY; LANES];
    let (chunks, rest) = x.as_chunks::<LANES>();
    for chunk in chunks {
        for lane in 0..LANES {
            max[lane] = max[lane].max(chunk[lane]);
        }
    }
    max.iter().chain(rest).copied().fold(f32::NEG_INFINITY, f32::max)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exp_silu_mish_gelu_softmax_and_sum_match_their_definitions() {
        struct Exp(f32);
        impl Kernel for Exp {
            type Output = f32;

            #[inline(always)]
            fn run<L: Level>(self) -> f32 {
                exp::<L>(self.0)
            }
        }
        for i in -4000..4000 {
            let x = i as f32 / 200.0;
            if x <= 0.0 {
                let y = dispatch(Exp(x));
                assert!((y - x.exp()).abs() <= 3e-7 * x.exp(), "exp({x}) = {y}");
            }
            let mut values = [x];
            silu(&mut values);
            assert!((values[0] - x / (1.0 + (-x).exp())).abs() < 2e-6, "silu({x})");
            let double = f64::from(x);
            let (tanh, logistic) = (double.exp().ln_1p().tanh(), 1.0 / (1.0 + (-double).exp()));
            let slope = tanh + double * logistic * (1.0 - tanh * tanh);
            let (mut value, mut offset, mut found) = ([x], [x], [0.0]);
            mish(&mut value);
            mish_tangent(&mut offset, &mut found);
            assert!((f64::from(value[0]) - double * tanh).abs() < 1e-6 * (1.0 + double.abs()), "mish({x})");
            assert!((f64::from(found[0]) - slope).abs() < 1e-6, "slope of mish at {x}: {}, not {slope}", found[0]);
            let expected = double * (tanh - slope);
            assert!((f64::from(offset[0]) - expected).abs() < 2e-6 * (1.0 + double.abs()), "offset of mish at {x}");
        }
        // Φ is integrated from 0 by Simpson's rule; the density is smooth enough for 2,000 intervals.
        let density = |x: f64| (-x * x / 2.0).exp() / std::f64::consts::TAU.sqrt();
        for i in -600..=600 {
            let x = f64::from(i) / 50.0;
            let h = x / 2000.0;
            let inner: f64 = (1..2000).map(|k| density(h * f64::from(k)) * if k % 2 == 1 { 4.0 } else { 2.0 }).sum();
            let phi = 0.5 + h / 3.0 * (density(0.0) + inner + density(x));
            let mut values = [x as f32];
            gelu(&mut values);
            assert!((f64::from(values[0]) - x * phi).abs() < 1e-6, "gelu({x}) = {}, not {}", values[0], x * phi);
            let (mut offset, mut slope) = ([x as f32], [0.0]);
            gelu_tangent(&mut offset, &mut slope);
            assert!((f64::from(slope[0]) - phi - x * density(x)).abs() < 1e-6, "slope at {x}: {}", slope[0]);
            assert!((f64::from(offset[0]) + x * x * density(x)).abs() < 1e-6, "offset at {x}: {}", offset[0]);
        }
        let mut rows: Vec<f32> = (0..38).map(|i| (i * 7 % 19) as f32 * 0.3 - 2.0).collect();
        let inputs = rows.clone();
        softmax(&mut rows, 19);
        for (row, inputs) in rows.chunks(19).zip(inputs.chunks(19)) {
            let sum: f32 = inputs.iter().map(|x| x.exp()).sum();
            assert!(row.iter().zip(inputs).all(|(weight, x)| (weight - x.exp() / sum).abs() < 1e-7), "{row:?}");
        }
        let values: Vec<f32> = (0..37).map(|i| i as f32).collect();
        assert_eq!(sum(&values), 666.0);
    }
}
