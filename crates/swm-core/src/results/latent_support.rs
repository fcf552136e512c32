//! [`LatentSupport`]: how far latents lie from those of a dataset, and their projection on the dataset's principal components.

use crate::{Error, Result};
use rayon::prelude::*;

/// The number of principal components.
const COMPONENTS: usize = 2;
/// The most iterations of the search for principal components, and the change of a direction at which it ends.
const ITERATIONS: usize = 2000;
const CONVERGED: f64 = 1e-12;
/// The share of held-out latents that are nearer to the dataset than [`LatentSupport::edge`].
const INSIDE: f64 = 0.99;

/// The latents of a dataset: where a model was trained.
pub struct LatentSupport {
    dim: usize,
    /// The latents, `[rows, dim]`.
    latents: Vec<f32>,
    /// Their mean, `[dim]`.
    mean: Vec<f64>,
    /// The directions of the largest variance, orthonormal, `[COMPONENTS, dim]`.
    components: Vec<Vec<f64>>,
    /// The mean distance of held-out latents to the nearest latent of the dataset: the unit of distances.
    unit: f64,
    /// The distance, in units, within which 99 % of the held-out latents lie.
    edge: f64,
}

impl LatentSupport {
    /// The support of the latents of a dataset. `held_out`, latents of other episodes of the same policy, give the unit.
    ///
    /// # Shapes
    /// `latents` and `held_out` are `[rows, dim]`.
    ///
    /// # Errors
    /// When there are fewer than three latents or no held-out ones, a value is not finite, or all latents are equal.
    pub fn new(latents: Vec<f32>, held_out: &[f32], dim: usize) -> Result<Self> {
        let rows = latents.len() / dim.max(1);
        let invalid = |problem: String, fix: &str| Err(Error::config("the latents of a dataset", problem, fix));
        if rows <= COMPONENTS || held_out.len() < dim.max(1) {
            let problem = format!("{rows} of the dataset and {} held-out ones", held_out.len() / dim.max(1));
            return invalid(problem, "collect more episodes");
        }
        if !latents.iter().chain(held_out).all(|value| value.is_finite()) {
            return invalid("a value is not finite".to_owned(), "train longer or with a smaller learning rate");
        }
        let mut mean = vec![0.0; dim];
        for row in latents.chunks_exact(dim) {
            mean.iter_mut().zip(row).for_each(|(sum, value)| *sum += f64::from(*value) / rows as f64);
        }
        let components = principal(&covariance(&latents, &mean), dim);
        let mut support = Self { dim, latents, mean, components, unit: 1.0, edge: 1.0 };
        let mut distances = support.distances(held_out);
        support.unit = distances.iter().sum::<f64>() / distances.len() as f64;
        if support.unit <= 0.0 {
            return invalid("held-out latents do not differ from those of the dataset".to_owned(), "train longer");
        }
        distances.sort_by(f64::total_cmp);
        let at = ((distances.len() as f64 * INSIDE).ceil() as usize).clamp(1, distances.len()) - 1;
        support.edge = distances[at] / support.unit;
        Ok(support)
    }

    /// The distance of each latent to the nearest latent of the dataset, in units of the mean of the held-out latents.
    ///
    /// # Shapes
    /// Maps `[rows, dim]` to `[rows]`.
    pub fn distances(&self, latents: &[f32]) -> Vec<f64> {
        let nearest = |latent: &[f32]| {
            let square = |row: &[f32]| latent.iter().zip(row).map(|(a, b)| (a - b) * (a - b)).sum::<f32>();
            let nearest = self.latents.chunks_exact(self.dim).map(square).fold(f32::INFINITY, f32::min);
            f64::from(nearest).sqrt() / self.unit
        };
        latents.par_chunks_exact(self.dim).map(nearest).collect()
    }

    /// The distance, in the unit of [`LatentSupport::distances`], within which 99 % of the held-out latents lie.
    pub fn edge(&self) -> f64 {
        self.edge
    }

    /// The coordinates of latents along the first two principal components of the dataset.
    ///
    /// # Shapes
    /// Maps `[rows, dim]` to `[rows]`.
    pub fn project(&self, latents: &[f32]) -> Vec<[f64; COMPONENTS]> {
        let coordinate = |row: &[f32], component: &[f64]| {
            let centred = row.iter().zip(&self.mean).map(|(value, mean)| f64::from(*value) - mean);
            centred.zip(component).map(|(value, weight)| value * weight).sum::<f64>()
        };
        let project = |row: &[f32]| [0, 1].map(|i| coordinate(row, &self.components[i]));
        latents.chunks_exact(self.dim).map(project).collect()
    }

    /// The share of the variance of latents, around the mean of the dataset, that the projection keeps.
    ///
    /// # Shapes
    /// `latents` is `[rows, dim]`.
    pub fn kept(&self, latents: &[f32]) -> f64 {
        let square = |row: &[f32]| {
            row.iter().zip(&self.mean).map(|(value, mean)| (f64::from(*value) - mean).powi(2)).sum::<f64>()
        };
        let all: f64 = latents.chunks_exact(self.dim).map(square).sum();
        let plane: f64 = self.project(latents).iter().flatten().map(|value| value * value).sum();
        if all > 0.0 { (plane / all).min(1.0) } else { 1.0 }
    }
}

/// The covariance matrix, `[dim, dim]`.
fn covariance(latents: &[f32], mean: &[f64]) -> Vec<f64> {
    let dim = mean.len();
    let rows = latents.len() / dim;
    let mut covariance = vec![0.0; dim * dim];
    covariance.par_chunks_exact_mut(dim).enumerate().for_each(|(i, line)| {
        for row in latents.chunks_exact(dim) {
            let left = (f64::from(row[i]) - mean[i]) / rows as f64;
            for ((sum, value), mean) in line.iter_mut().zip(row).zip(mean) {
                *sum += left * (f64::from(*value) - mean);
            }
        }
    });
    covariance
}

/// The first eigenvectors of a symmetric matrix by orthogonal iteration. The largest element of each is positive, so that
/// equal data have equal figures.
fn principal(matrix: &[f64], dim: usize) -> Vec<Vec<f64>> {
    let mut found: Vec<Vec<f64>> = vec![];
    for component in 0..COMPONENTS {
        // A fixed start that is not orthogonal to any axis.
        let start = (0..dim).map(|i| 1.0 + ((i * 7919 + component * 104_729) % 1009) as f64 / 1009.0).collect();
        let mut vector = orthonormal(start, &found);
        for _ in 0..ITERATIONS {
            let product: Vec<f64> = matrix.chunks_exact(dim).map(|line| dot(line, &vector)).collect();
            // A direction without variance stays as it is.
            if dot(&product, &product) <= f64::MIN_POSITIVE {
                break;
            }
            let next = orthonormal(product, &found);
            let change: f64 = next.iter().zip(&vector).map(|(a, b)| (a - b).powi(2)).sum();
            vector = next;
            if change < CONVERGED {
                break;
            }
        }
        let largest =
            vector.iter().fold(0.0_f64, |largest, value| if value.abs() > largest.abs() { *value } else { largest });
        vector.iter_mut().for_each(|value| *value *= largest.signum());
        found.push(vector);
    }
    found
}

/// The vector without its parts along others, with length 1; zero if nothing is left.
fn orthonormal(mut vector: Vec<f64>, others: &[Vec<f64>]) -> Vec<f64> {
    for other in others {
        let along = dot(&vector, other);
        vector.iter_mut().zip(other).for_each(|(value, other)| *value -= along * other);
    }
    let length = dot(&vector, &vector).sqrt();
    vector.iter_mut().for_each(|value| *value = if length > 1e-150 { *value / length } else { 0.0 });
    vector
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Key;
    use rand::Rng as _;

    /// Points with standard deviations of 4, 2 and 0.1 along three orthogonal directions.
    fn points(rows: usize, name: &str) -> Vec<f32> {
        let directions = [[0.6, 0.8, 0.0], [-0.8, 0.6, 0.0], [0.0, 0.0, 1.0]];
        let mut rng = Key::new(0).with(name).rng();
        let mut point = || {
            let parts = [4.0, 2.0, 0.1].map(|std| std * 3.0_f32.sqrt() * rng.random_range(-1.0..1.0_f32));
            [0, 1, 2].map(|i| 5.0 + (0..3).map(|d| parts[d] * directions[d][i]).sum::<f32>())
        };
        (0..rows).flat_map(|_| point()).collect()
    }

    #[test]
    fn projections_keep_the_directions_of_the_largest_variance() {
        let (latents, held_out) = (points(4000, "a"), points(500, "b"));
        let support = LatentSupport::new(latents.clone(), &held_out, 3).expect("a support");
        let along = [&support.components[0], &support.components[1]].map(|component| component.clone());
        for (component, expected) in along.iter().zip([[0.6, 0.8, 0.0], [0.8, -0.6, 0.0]]) {
            let same = component.iter().zip(expected).map(|(a, b)| a * b).sum::<f64>().abs();
            assert!(same > 0.995, "{component:?}");
        }
        assert!(support.kept(&latents) > 0.999);
        assert!(support.kept(&[5.0, 5.0, 9.0]) < 0.01, "a point beside the plane");
        let projected = support.project(&[5.6 + 0.6 * 3.0, 5.8 + 0.8 * 3.0, 5.0]);
        assert!((projected[0][0] - 4.0).abs() < 0.4 && projected[0][1].abs() < 0.6, "{projected:?}");
    }

    #[test]
    fn distances_are_in_units_of_held_out_latents() {
        let (latents, held_out) = (points(2000, "a"), points(1000, "b"));
        let support = LatentSupport::new(latents, &held_out, 3).expect("a support");
        let distances = support.distances(&held_out);
        assert!((distances.iter().sum::<f64>() / 1000.0 - 1.0).abs() < 1e-9);
        let outside = distances.iter().filter(|distance| **distance > support.edge()).count();
        assert_eq!(outside, 10, "1 % of 1000");
        assert!(support.distances(&[60.0, 5.0, 5.0])[0] > 20.0);
        for (latents, held_out) in
            [(vec![1.0; 6], vec![1.0; 3]), (vec![f32::NAN; 30], vec![1.0; 3]), (points(9, "a"), vec![])]
        {
            assert!(LatentSupport::new(latents, &held_out, 3).is_err());
        }
    }
}
