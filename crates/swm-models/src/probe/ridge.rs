//! Ridge regression with an intercept, in closed form (Hoerl and Kennard 1970).
//!
//! For centred features `X` and targets `Y`, the weights are `W = (XᵀX + λnI)⁻¹ XᵀY = Xᵀ (XXᵀ + λnI)⁻¹ Y`. The smaller
//! of the two systems is solved by Cholesky factorisation in double precision. Features are standardised first, so that
//! λ has the same meaning for every encoder.

use rayon::prelude::*;
use swm_core::run::Control;
use swm_core::{Error, Result};

/// The number of rows of a product after which an interrupt is noticed.
const ROWS_PER_CHECK: usize = 64;

/// The linear map `y = W x + b`.
#[derive(Clone, Debug)]
pub struct Ridge {
    /// The weights `W` of features before standardisation, `[targets, features]`.
    weights: Vec<f64>,
    /// The intercept `b`, `[targets]`.
    intercept: Vec<f64>,
    features: usize,
}

impl Ridge {
    /// Fits the ridge regression of `y` on `x` with the penalty λ, `lambda`.
    ///
    /// # Shapes
    /// `x` is `[rows, features]`, `y` is `[rows, targets]`.
    ///
    /// # Errors
    /// When λ is not positive, a feature or target is not finite, or the run is stopped ([`Error::Interrupted`]).
    pub fn fit(x: &[f32], y: &[f32], rows: usize, lambda: f64, control: &mut Control<'_>) -> Result<Self> {
        if !(lambda.is_finite() && lambda > 0.0) {
            return Err(Error::config("ridge", lambda.to_string(), "give a positive value"));
        }
        let (features, targets) = (x.len() / rows, y.len() / rows);
        let (mean_x, std) = mean_and_std(x, rows);
        let (mean_y, _) = mean_and_std(y, rows);
        // A constant feature gets no weight.
        let scale: Vec<f64> = std.iter().map(|&s| if s > 0.0 { 1.0 / s } else { 0.0 }).collect();
        let x: Vec<f64> =
            x.iter().enumerate().map(|(i, &v)| (f64::from(v) - mean_x[i % features]) * scale[i % features]).collect();
        let y: Vec<f64> = y.iter().enumerate().map(|(i, &v)| f64::from(v) - mean_y[i % targets]).collect();
        if let Some(bad) = x.iter().chain(&y).find(|v| !v.is_finite()) {
            return Err(Error::NotFinite {
                what: "a latent or a target of a probe".to_owned(),
                given: format!("{bad} after centring"),
                fix: "check the checkpoint and the dataset".to_owned(),
            });
        }
        let penalty = lambda * rows as f64;
        // The solution is `[features, targets]`, for centred and scaled features.
        let solution = if features <= rows {
            let xt = transpose(&x, rows, features);
            let gram = products(&xt, &xt, rows, control)?;
            let right = products(&xt, &transpose(&y, rows, targets), rows, control)?;
            solve(gram, right, targets, penalty, control)?
        } else {
            let gram = products(&x, &x, features, control)?;
            let dual = solve(gram, y, targets, penalty, control)?;
            products(&transpose(&x, rows, features), &transpose(&dual, rows, targets), rows, control)?
        };
        let mut weights = transpose(&solution, features, targets);
        let mut intercept = mean_y;
        for (weights, intercept) in weights.chunks_exact_mut(features).zip(&mut intercept) {
            for ((weight, scale), mean) in weights.iter_mut().zip(&scale).zip(&mean_x) {
                *weight *= scale;
                *intercept -= *weight * mean;
            }
        }
        Ok(Self { weights, intercept, features })
    }

    /// Predicts targets.
    ///
    /// # Shapes
    /// Maps `[rows, features]` to `[rows, targets]`.
    pub fn predict(&self, x: &[f32]) -> Vec<f32> {
        x.par_chunks_exact(self.features)
            .flat_map_iter(|x| {
                self.weights.chunks_exact(self.features).zip(&self.intercept).map(move |(weights, intercept)| {
                    (weights.iter().zip(x).map(|(w, &x)| w * f64::from(x)).sum::<f64>() + intercept) as f32
                })
            })
            .collect()
    }
}

/// Computes mean and standard deviation of every column; the deviation of equal values is exactly 0.
///
/// # Shapes
/// `x` is `[rows, width]`; returns `[width]` twice.
pub(super) fn mean_and_std(x: &[f32], rows: usize) -> (Vec<f64>, Vec<f64>) {
    let width = x.len() / rows;
    let mut mean = vec![0.0f64; width];
    for row in x.chunks_exact(width) {
        mean.iter_mut().zip(row).for_each(|(sum, &v)| *sum += f64::from(v));
    }
    mean.iter_mut().for_each(|sum| *sum /= rows as f64);
    let (mut square, mut varies) = (vec![0.0f64; width], vec![false; width]);
    for row in x.chunks_exact(width) {
        varies.iter_mut().zip(row).zip(x).for_each(|((varies, value), first)| *varies |= value != first);
        square.iter_mut().zip(row).zip(&mean).for_each(|((sum, &v), mean)| *sum += (f64::from(v) - mean).powi(2));
    }
    let std = square.into_iter().zip(varies).map(|(sum, varies)| if varies { (sum / rows as f64).sqrt() } else { 0.0 });
    (mean, std.collect())
}

/// Transposes a matrix.
///
/// # Shapes
/// Maps `[rows, columns]` to `[columns, rows]`.
fn transpose(x: &[f64], rows: usize, columns: usize) -> Vec<f64> {
    (0..rows * columns).map(|i| x[i % rows * columns + i / rows]).collect()
}

/// Computes `a bᵀ`, the inner products of all rows.
///
/// # Shapes
/// `a` is `[m, width]`, `b` is `[n, width]`; returns `[m, n]`.
fn products(a: &[f64], b: &[f64], width: usize, control: &mut Control<'_>) -> Result<Vec<f64>> {
    let mut out = Vec::with_capacity(a.len() / width * (b.len() / width));
    for rows in a.chunks(ROWS_PER_CHECK * width) {
        control.check()?;
        out.par_extend(
            rows.par_chunks_exact(width).flat_map_iter(|a| {
                b.chunks_exact(width).map(move |b| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>())
            }),
        );
    }
    Ok(out)
}

/// Solves `(gram + penalty I) S = right` for a positive semidefinite `gram` and a positive penalty.
///
/// # Shapes
/// `gram` is `[size, size]`, `right` and the result are `[size, targets]`.
fn solve(
    mut gram: Vec<f64>,
    mut right: Vec<f64>,
    targets: usize,
    penalty: f64,
    control: &mut Control<'_>,
) -> Result<Vec<f64>> {
    let size = right.len() / targets;
    // The Cholesky factor overwrites the lower triangle.
    for i in 0..size {
        gram[i * size + i] += penalty;
    }
    for pivot in 0..size {
        control.check()?;
        let root = gram[pivot * size + pivot].sqrt();
        let (above, below) = gram.split_at_mut((pivot + 1) * size);
        above[pivot * size + pivot] = root;
        below.par_chunks_exact_mut(size).for_each(|row| row[pivot] /= root);
        let column: Vec<f64> = below.chunks_exact(size).map(|row| row[pivot]).collect();
        below.par_chunks_exact_mut(size).enumerate().for_each(|(index, row)| {
            let factor = row[pivot];
            for (to, by) in row[pivot + 1..=pivot + 1 + index].iter_mut().zip(&column) {
                *to -= factor * by;
            }
        });
    }
    for i in 0..size {
        for j in 0..i {
            let factor = gram[i * size + j];
            for t in 0..targets {
                right[i * targets + t] -= factor * right[j * targets + t];
            }
        }
        right[i * targets..(i + 1) * targets].iter_mut().for_each(|v| *v /= gram[i * size + i]);
    }
    for i in (0..size).rev() {
        for j in i + 1..size {
            let factor = gram[j * size + i];
            for t in 0..targets {
                right[i * targets + t] -= factor * right[j * targets + t];
            }
        }
        right[i * targets..(i + 1) * targets].iter_mut().for_each(|v| *v /= gram[i * size + i]);
    }
    Ok(right)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::Rng as _;
    use swm_core::Key;

    fn noise(count: usize, name: &str) -> Vec<f32> {
        let mut rng = Key::new(0).with(name).rng();
        (0..count).map(|_| rng.random_range(-1.0f32..1.0)).collect()
    }

    fn fit(x: &[f32], y: &[f32], rows: usize, lambda: f64) -> Result<Ridge> {
        Ridge::fit(x, y, rows, lambda, &mut Control::new())
    }

    #[test]
    fn ridge_regression_recovers_a_linear_map() {
        let (rows, features) = (200, 7);
        let x = noise(rows * features, "x");
        let truth = noise(2 * features, "w");
        let y: Vec<f32> = x
            .chunks(features)
            .flat_map(|x| [0, 1].map(|t| 3.0 + x.iter().zip(&truth[t * features..]).map(|(x, w)| x * w).sum::<f32>()))
            .collect();
        let found = fit(&x, &y, rows, 1e-9).expect("fitting the ridge regression").predict(&x);
        let worst = found.iter().zip(&y).fold(0.0f32, |m, (a, b)| m.max((a - b).abs()));
        assert!(worst < 1e-4, "{worst}");
    }

    #[test]
    fn primal_and_dual_solutions_agree() {
        // The first fit has more rows than features. The second fit has every feature twice, and so more features than
        // rows.
        let (rows, features) = (12, 9);
        let (x, y) = (noise(rows * features, "x"), noise(rows * 3, "y"));
        let primal = fit(&x, &y, rows, 0.1).expect("fitting the ridge regression").predict(&x);
        let twice: Vec<f32> = x.chunks(features).flat_map(|x| [x, x].concat()).collect();
        // Every feature twice with twice the penalty gives the same map, with each weight split in two.
        let dual = fit(&twice, &y, rows, 0.2).expect("fitting the ridge regression").predict(&twice);
        let worst = primal.iter().zip(&dual).fold(0.0f32, |m, (a, b)| m.max((a - b).abs()));
        assert!(worst < 1e-5, "{worst}");
    }

    #[test]
    fn zero_penalty_and_non_finite_values_are_refused() {
        assert!(fit(&[1.0, 2.0], &[1.0, 2.0], 2, 0.0).is_err());
        assert!(fit(&[1.0, f32::NAN], &[1.0, 2.0], 2, 0.1).is_err());
    }

    #[test]
    fn fit_can_be_interrupted() {
        let flag = std::sync::Arc::new(std::sync::atomic::AtomicBool::new(true));
        let mut control = Control::new().with_interrupt(flag);
        let stopped = Ridge::fit(&[1.0, 2.0], &[1.0, 2.0], 2, 0.1, &mut control);
        assert!(matches!(stopped, Err(Error::Interrupted)), "{stopped:?}");
    }
}
