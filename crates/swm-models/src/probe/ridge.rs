//! Linear read-outs in closed form: ridge regression with an intercept.
//!
//! With features `X` and targets `Y` centred, the map is `W = (XᵀX + λnI)⁻¹ XᵀY = Xᵀ (XXᵀ + λnI)⁻¹ Y`: solved where the
//! matrix is smaller, by Cholesky's factorisation, in double precision. Features are scaled to unit spread first, so that λ
//! means the same for every encoder.

use rayon::prelude::*;
use swm_core::{Error, Result};

/// `y = W x + b`.
#[derive(Clone, Debug)]
pub struct Ridge {
    /// `[targets, features]`, for features as they come.
    weights: Vec<f64>,
    /// `[targets]`.
    intercept: Vec<f64>,
    features: usize,
}

impl Ridge {
    /// The map that fits best.
    ///
    /// # Shapes
    /// `x` is `[rows, features]`, `y` is `[rows, targets]`.
    ///
    /// # Errors
    /// When λ is not above 0, or the features are not finite.
    #[allow(clippy::cast_precision_loss)]
    pub fn fit(x: &[f32], y: &[f32], rows: usize, lambda: f64) -> Result<Self> {
        if !(lambda.is_finite() && lambda > 0.0) {
            return Err(Error::config("ridge", lambda.to_string(), "give a number above 0"));
        }
        let (features, targets) = (x.len() / rows, y.len() / rows);
        let (mean_x, spread) = moments(x, rows);
        let (mean_y, _) = moments(y, rows);
        // A feature that never changes says nothing, whatever its scale.
        let scale: Vec<f64> = spread.iter().map(|&s| if s > 1e-12 { 1.0 / s } else { 0.0 }).collect();
        let x: Vec<f64> =
            x.iter().enumerate().map(|(i, &v)| (f64::from(v) - mean_x[i % features]) * scale[i % features]).collect();
        let y: Vec<f64> = y.iter().enumerate().map(|(i, &v)| f64::from(v) - mean_y[i % targets]).collect();
        if !x.iter().chain(&y).all(|v| v.is_finite()) {
            return Err(Error::NotFinite {
                what: "the latents that a probe reads, or what it reads from them".to_owned(),
                given: "numbers that are not finite".to_owned(),
                fix: "check the checkpoint and the dataset".to_owned(),
            });
        }
        let penalty = lambda * rows as f64;
        // `[features, targets]`, for centred and scaled features.
        let solution = if features <= rows {
            let xt = transpose(&x, rows, features);
            let gram = products(&xt, &xt, rows);
            let right = products(&xt, &transpose(&y, rows, targets), rows);
            solve(gram, right, targets, penalty)
        } else {
            let gram = products(&x, &x, features);
            let dual = solve(gram, y, targets, penalty);
            products(&transpose(&x, rows, features), &transpose(&dual, rows, targets), rows)
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

    /// # Shapes
    /// `[rows, features]` to `[rows, targets]`.
    #[allow(clippy::cast_possible_truncation)]
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

/// Mean and standard deviation of every column.
#[allow(clippy::cast_precision_loss)]
pub(super) fn moments(x: &[f32], rows: usize) -> (Vec<f64>, Vec<f64>) {
    let width = x.len() / rows;
    let mut mean = vec![0.0f64; width];
    for row in x.chunks_exact(width) {
        mean.iter_mut().zip(row).for_each(|(sum, &v)| *sum += f64::from(v));
    }
    mean.iter_mut().for_each(|sum| *sum /= rows as f64);
    let mut square = vec![0.0f64; width];
    for row in x.chunks_exact(width) {
        square.iter_mut().zip(row).zip(&mean).for_each(|((sum, &v), mean)| *sum += (f64::from(v) - mean).powi(2));
    }
    (mean, square.into_iter().map(|sum| (sum / rows as f64).sqrt()).collect())
}

/// `[rows, columns]` to `[columns, rows]`.
fn transpose(x: &[f64], rows: usize, columns: usize) -> Vec<f64> {
    (0..rows * columns).map(|i| x[i % rows * columns + i / rows]).collect()
}

/// The inner products of all rows of `a` with all rows of `b`, `width` numbers each.
fn products(a: &[f64], b: &[f64], width: usize) -> Vec<f64> {
    a.par_chunks_exact(width)
        .flat_map_iter(|a| b.chunks_exact(width).map(move |b| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>()))
        .collect()
}

/// Solves `(gram + penalty I) S = right`, `right` and `S` being `[size, targets]`, for a gram that has no negative
/// eigenvalue and a positive penalty.
fn solve(mut gram: Vec<f64>, mut right: Vec<f64>, targets: usize, penalty: f64) -> Vec<f64> {
    let size = right.len() / targets;
    // Cholesky's factor takes the place of the lower triangle, row after row of what is left.
    for i in 0..size {
        gram[i * size + i] += penalty;
    }
    for pivot in 0..size {
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
    right
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

    #[test]
    fn a_linear_map_is_found_again() {
        let (rows, features) = (200, 7);
        let x = noise(rows * features, "x");
        let truth = noise(2 * features, "w");
        let y: Vec<f32> = x
            .chunks(features)
            .flat_map(|x| [0, 1].map(|t| 3.0 + x.iter().zip(&truth[t * features..]).map(|(x, w)| x * w).sum::<f32>()))
            .collect();
        let found = Ridge::fit(&x, &y, rows, 1e-9).expect("fitted").predict(&x);
        let worst = found.iter().zip(&y).fold(0.0f32, |m, (a, b)| m.max((a - b).abs()));
        assert!(worst < 1e-4, "{worst}");
    }

    #[test]
    fn both_ways_to_solve_agree() {
        // The same problem, once with more rows than features; then some features twice, so that there are more of them.
        let (rows, features) = (12, 9);
        let (x, y) = (noise(rows * features, "x"), noise(rows * 3, "y"));
        let primal = Ridge::fit(&x, &y, rows, 0.1).expect("fitted").predict(&x);
        let twice: Vec<f32> = x.chunks(features).flat_map(|x| [x, x].concat()).collect();
        // Every feature twice with twice the penalty is the same map, its weights shared out.
        let dual = Ridge::fit(&twice, &y, rows, 0.2).expect("fitted").predict(&twice);
        let worst = primal.iter().zip(&dual).fold(0.0f32, |m, (a, b)| m.max((a - b).abs()));
        assert!(worst < 1e-5, "{worst}");
    }

    #[test]
    fn a_penalty_of_nothing_and_numbers_that_are_none_are_refused() {
        assert!(Ridge::fit(&[1.0, 2.0], &[1.0, 2.0], 2, 0.0).is_err());
        assert!(Ridge::fit(&[1.0, f32::NAN], &[1.0, 2.0], 2, 0.1).is_err());
    }
}
