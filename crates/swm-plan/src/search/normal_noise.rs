//! Standard normal noise for the sampling solvers, identical on every platform.
//!
//! The Box–Muller transform turns two uniform values into two independent normal values,
//! `√(-2 ln u) (cos 2πv, sin 2πv)`. The uniform values are the words of a key's ChaCha stream, in order, so a run of
//! the noise can be generated without the runs before it. `ln`, `cos` and `sin` are polynomials (minimax fits, relative
//! error below 3e-7) because the system's functions differ between platforms, while additions, multiplications and
//! square roots are defined to the last bit. The polynomials are also vectorised.

use rand::RngCore as _;
use swm_core::{Key, Rng};
use swm_simd::{Kernel, Level, dispatch};

/// The number of values in a run. The noise of a key is a sequence of runs, each generated as a whole.
pub const RUN: usize = 32;

/// Fills `noise` with the normal values of `key`, from run `first` on.
pub fn fill(key: Key, first: usize, noise: &mut [f32]) {
    let mut rng = key.rng();
    rng.set_word_pos((first * RUN) as u128);
    let (runs, rest) = noise.as_chunks_mut::<RUN>();
    fill_runs(&mut rng, runs);
    if !rest.is_empty() {
        let mut last = [[0.0; RUN]];
        fill_runs(&mut rng, &mut last);
        rest.copy_from_slice(&last[0][..rest.len()]);
    }
}

fn fill_runs(rng: &mut Rng, runs: &mut [[f32; RUN]]) {
    rng.fill_bytes(bytemuck::cast_slice_mut(runs.as_flattened_mut()));
    dispatch(Transform(runs));
}

/// [`transform`], compiled for the vector instructions of the CPU. The compiler neither contracts nor reorders its
/// arithmetic, so the values are the same at every level.
struct Transform<'a>(&'a mut [[f32; RUN]]);

impl Kernel for Transform<'_> {
    type Output = ();

    #[inline(always)]
    fn run<L: Level>(self) {
        transform(self.0);
    }
}

/// Turns random words, as the generator wrote them to memory, into normal values.
#[inline(always)]
fn transform(runs: &mut [[f32; RUN]]) {
    for run in runs {
        let (first, second) = run.split_at_mut(RUN / 2);
        for (a, b) in first.iter_mut().zip(second) {
            (*a, *b) = normal_pair(u32::from_le(a.to_bits()), u32::from_le(b.to_bits()));
        }
    }
}

/// Two normal values from two random words: the first determines their distance from the origin, the second the
/// direction.
#[inline(always)]
fn normal_pair(distance: u32, direction: u32) -> (f32, f32) {
    // Uniform between 2⁻³² and 1. Only 31 bits are used, because many vector units convert signed integers only.
    let u = ((distance >> 1) as i32 as f32 + 0.5) * 2f32.powi(-31);
    let r = (-2.0 * ln(u)).sqrt();
    // Two bits select the quadrant. The other 30 bits are the angle from the middle of the quadrant, in quarter turns
    // between -1/2 and 1/2.
    let angle = ((direction << 2) as i32 as f32) * 2f32.powi(-32);
    let square = angle * angle;
    let (cos, sin) = (r * cos(square), r * angle * sin_over_angle(square));
    let (x, y) = if direction & 1 << 31 == 0 { (cos, sin) } else { (-sin, cos) };
    let sign = (direction & 1 << 30) << 1;
    (f32::from_bits(x.to_bits() ^ sign), f32::from_bits(y.to_bits() ^ sign))
}

/// The natural logarithm of a positive number that is not subnormal.
#[inline(always)]
fn ln(x: f32) -> f32 {
    // x = 2ᵉ (1 + m) with 1 + m between √½ and √2.
    const ROOT_HALF: u32 = 0x3f35_04f3;
    const MANTISSA: u32 = 0x007f_ffff;
    let above = x.to_bits().wrapping_sub(ROOT_HALF);
    let e = (above as i32 >> 23) as f32;
    let m = f32::from_bits((above & MANTISSA) + ROOT_HALF) - 1.0;
    let p = -0.101_917_53 * m + 0.160_244_58;
    let p = p * m - 0.171_371_47;
    let p = p * m + 0.199_244_97;
    let p = p * m - 0.249_832_66;
    let p = p * m + 0.333_342_46;
    e * std::f32::consts::LN_2 + (m + m * m * (m * p - 0.5))
}

/// The cosine of a quarter turn times `angle`, given the square of `angle`, for angles up to 1/2.
#[inline(always)]
fn cos(square: f32) -> f32 {
    ((-0.020_426_24 * square + 0.253_606_36) * square - 1.233_698) * square + 1.0
}

/// The sine of a quarter turn times `angle`, divided by `angle`, given the square of `angle`, for angles up to 1/2.
#[inline(always)]
fn sin_over_angle(square: f32) -> f32 {
    ((-0.004_601_655_7 * square + 0.079_680_03) * square - 0.645_963_46) * square + std::f32::consts::FRAC_PI_2
}

#[cfg(test)]
mod tests {
    use super::*;

    fn noise(n: usize) -> Vec<f32> {
        let mut noise = vec![0.0; n];
        fill(Key::new(3), 0, &mut noise);
        noise
    }

    #[test]
    fn polynomials_of_ln_sin_and_cos_are_accurate() {
        for i in 1..100_000 {
            let x = i as f32 / 1e5;
            assert!((f64::from(ln(x)) / f64::from(x).ln() - 1.0).abs() < 5e-7, "ln {x}");
            let angle = f64::from(x) - 0.5;
            let (square, turn) = ((angle * angle) as f32, angle * std::f64::consts::FRAC_PI_2);
            assert!((f64::from(cos(square)) - turn.cos()).abs() < 3e-7, "cos {angle}");
            assert!((f64::from(sin_over_angle(square)) * angle - turn.sin()).abs() < 3e-7, "sin {angle}");
        }
    }

    #[test]
    fn extreme_random_words_give_bounded_values() {
        let corners = [0, 1, 2, u32::MAX, u32::MAX - 1, 1 << 30, 1 << 31, (1 << 30) - 1, (1 << 31) - 1, 3 << 30];
        for (a, b) in corners.iter().flat_map(|&a| corners.map(|b| (a, b))) {
            let (x, y) = normal_pair(a, b);
            assert!(x.hypot(y) < 6.7, "{a} {b}: {x} {y}");
        }
    }

    #[test]
    fn values_are_normal_and_independent() {
        let noise = noise(1 << 20);
        let n = noise.len() as f64;
        let mean = |f: &dyn Fn(f64) -> f64| noise.iter().map(|&v| f(f64::from(v))).sum::<f64>() / n;
        // Every statistic is within five standard errors of its expected value.
        for (moment, expected, variance) in [(1, 0.0, 1.0), (2, 1.0, 2.0), (3, 0.0, 15.0), (4, 3.0, 96.0)] {
            let error = mean(&|v| v.powi(moment)) - expected;
            assert!(error.abs() < 5.0 * (variance / n).sqrt(), "moment {moment}: off by {error}");
        }
        for (limit, fraction) in [(-2.0, 0.022_750_1), (-1.0, 0.158_655_3), (0.5, 0.691_462_5), (3.0, 0.998_650_1)] {
            let error = mean(&|v| f64::from(u8::from(v < limit))) - fraction;
            assert!(error.abs() < 5.0 * (fraction * (1.0 - fraction) / n).sqrt(), "below {limit}: off by {error}");
        }
        for lag in [1, RUN / 2, RUN] {
            let product = noise.iter().zip(&noise[lag..]).map(|(a, b)| f64::from(a * b)).sum::<f64>() / n;
            assert!(product.abs() < 5.0 / n.sqrt(), "lag {lag}: {product}");
        }
    }

    #[test]
    fn noise_from_any_run_equals_the_full_sequence() {
        let all = noise(10 * RUN + 7);
        for (first, n) in [(0, 1), (3, RUN), (7, 3 * RUN + 7), (10, 7)] {
            let mut noise = vec![0.0; n];
            fill(Key::new(3), first, &mut noise);
            assert_eq!(noise, all[first * RUN..][..n]);
        }
        let mut words = vec![[0.0; RUN]; 10];
        Key::new(3).rng().fill_bytes(bytemuck::cast_slice_mut(words.as_flattened_mut()));
        transform(&mut words);
        assert_eq!(words.as_flattened(), &all[..10 * RUN]);
    }

    #[test]
    fn noise_equals_the_pinned_values() {
        // Published plans depend on these values: changing them is a breaking change.
        assert_eq!(noise(4).iter().map(|v| v.to_bits()).collect::<Vec<_>>(), PINNED);
    }

    const PINNED: [u32; 4] = [3219753185, 1057778974, 1023962241, 1010235872];
}
