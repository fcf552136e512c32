//! Paths of states in the plane: as positions on the frame where a state holds them, else along the two directions in which
//! the states of a search differ most (PCA).

use super::Position;

/// Steps of the power iteration.
const STEPS: usize = 60;
/// The share of the square that paths fill.
const FILLED: f64 = 0.9;

/// A path in the unit square, x to the right, y down, for each thing that moves.
pub type Paths = Vec<Vec<[f32; 2]>>;

/// The positions of a state, in fractions of the frame.
pub fn positions(state: &[f64], positions: &[Position]) -> Vec<[f32; 2]> {
    let all = positions.iter().map(|position| {
        let [x, y] = position.elements.map(|i| state.get(i).copied().unwrap_or_default() / position.side);
        [rounded(x), rounded(if position.is_up { 1.0 - y } else { y })]
    });
    all.collect()
}

/// Rounds to a tenth of a pixel of a large frame.
fn rounded(value: f64) -> f32 {
    ((value * 1e4).round() / 1e4) as f32
}

/// Directions in which states differ.
pub struct Pca {
    mean: Vec<f64>,
    /// The reciprocal of the standard deviation of every element; 0 for one that is constant.
    weight: Vec<f64>,
    directions: [Vec<f64>; 2],
    low: [f64; 2],
    scale: f64,
    /// The share of the variance that the two directions have.
    pub explained: f64,
}

impl Pca {
    /// Finds the directions. Elements are standardised first, because their units differ.
    pub fn of<'a>(states: impl Iterator<Item = &'a [f64]> + Clone) -> Option<Self> {
        let dim = states.clone().next()?.len();
        let count = states.clone().count() as f64;
        let sum = |value: &dyn Fn(&[f64], usize) -> f64| -> Vec<f64> {
            (0..dim).map(|i| states.clone().map(|state| value(state, i)).sum::<f64>() / count).collect()
        };
        let mean = sum(&|state, i| state[i]);
        let variance = sum(&|state, i| (state[i] - mean[i]).powi(2));
        let weight: Vec<f64> = variance.iter().map(|&v| if v > 1e-18 { v.sqrt().recip() } else { 0.0 }).collect();
        let mut covariance = vec![vec![0.0; dim]; dim];
        for state in states.clone() {
            let z: Vec<f64> = (0..dim).map(|i| (state[i] - mean[i]) * weight[i] / count.sqrt()).collect();
            for (row, a) in covariance.iter_mut().zip(&z) {
                row.iter_mut().zip(&z).for_each(|(entry, b)| *entry += a * b);
            }
        }
        let total: f64 = (0..dim).map(|i| covariance[i][i]).sum();
        let (first, largest) = eigenvector(&covariance);
        for (i, row) in covariance.iter_mut().enumerate() {
            row.iter_mut().enumerate().for_each(|(j, entry)| *entry -= largest * first[i] * first[j]);
        }
        let (second, next) = eigenvector(&covariance);
        let explained = if total > 0.0 { (largest + next) / total } else { 1.0 };
        let mut pca = Self { mean, weight, directions: [first, second], low: [0.0; 2], scale: 1.0, explained };
        let points: Vec<[f64; 2]> = states.map(|state| pca.raw(state)).collect();
        let bound = |axis: usize, pick: fn(f64, f64) -> f64| points.iter().map(|p| p[axis]).reduce(pick);
        let [low, high] = [f64::min, f64::max].map(|pick| [0, 1].map(|axis| bound(axis, pick).unwrap_or_default()));
        let side = (high[0] - low[0]).max(high[1] - low[1]).max(1e-12);
        pca.scale = FILLED / side;
        pca.low = [0, 1].map(|axis| f64::midpoint(low[axis], high[axis]) - 0.5 / pca.scale);
        Some(pca)
    }

    fn raw(&self, state: &[f64]) -> [f64; 2] {
        let along = |direction: &Vec<f64>| {
            (0..self.mean.len()).map(|i| (state[i] - self.mean[i]) * self.weight[i] * direction[i]).sum()
        };
        [along(&self.directions[0]), along(&self.directions[1])]
    }

    /// The point of a state in the unit square.
    pub fn point(&self, state: &[f64]) -> [f32; 2] {
        let raw = self.raw(state);
        [0, 1].map(|axis| rounded((raw[axis] - self.low[axis]) * self.scale))
    }
}

/// The eigenvector of the largest eigenvalue of a symmetric matrix, by power iteration, and the eigenvalue.
fn eigenvector(matrix: &[Vec<f64>]) -> (Vec<f64>, f64) {
    let dim = matrix.len();
    // No direction is special; equal elements could be orthogonal to the result.
    let mut vector: Vec<f64> = (0..dim).map(|i| 1.0 + (i as f64 * 0.618).fract()).collect();
    let mut value = 0.0;
    for _ in 0..STEPS {
        let product: Vec<f64> = matrix.iter().map(|row| row.iter().zip(&vector).map(|(a, b)| a * b).sum()).collect();
        value = product.iter().map(|v| v * v).sum::<f64>().sqrt();
        if value < 1e-12 {
            return (vec![0.0; dim], 0.0);
        }
        vector = product.iter().map(|v| v / value).collect();
    }
    (vector, value)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn positions_are_fractions_of_the_frame() {
        let of = |is_up| Position { name: "agent", elements: [1, 0], side: 200.0, is_up };
        assert_eq!(positions(&[50.0, 100.0], &[of(false), of(true)]), [[0.5, 0.25], [0.5, 0.75]]);
    }

    #[test]
    fn pca_finds_the_plane_of_states() {
        // A plane in four dimensions, one of which is constant.
        let states: Vec<[f64; 4]> = (0..50)
            .map(|i| {
                let (a, b) = (f64::from(i).sin(), f64::from(i).cos() * 0.1);
                [a + b, a - b, 7.0, 2.0 * a]
            })
            .collect();
        let pca = Pca::of(states.iter().map(<[f64; 4]>::as_slice)).expect("directions");
        assert!(pca.explained > 0.999, "{}", pca.explained);
        let points: Vec<[f32; 2]> = states.iter().map(|state| pca.point(state)).collect();
        assert!(points.iter().flatten().all(|v| (0.0..=1.0).contains(v)));
        assert!(points.iter().any(|p| p[0] < 0.1) && points.iter().any(|p| p[0] > 0.9));
        assert!(Pca::of(std::iter::empty()).is_none());
        assert!(Pca::of([[1.0].as_slice()].into_iter()).expect("a point").point(&[1.0])[0] > 0.4);
    }
}
