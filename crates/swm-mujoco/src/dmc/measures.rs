//! Quantities that rewards and observations of several domains read from the physics.

use crate::Physics;

/// The Euclidean distance of two points, in metres.
pub fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    norm(&[a[0] - b[0], a[1] - b[1], a[2] - b[2]])
}

/// The Euclidean norm of a vector.
pub fn norm(vector: &[f64]) -> f64 {
    vector.iter().map(|x| x * x).sum::<f64>().sqrt()
}

/// Rotates a vector from world axes to the axes of `frame`, a row-major rotation matrix.
pub fn in_frame(frame: &[f64; 9], vector: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|i| (0..3).map(|k| vector[k] * frame[3 * k + i]).sum())
}

/// The height of a body's origin, in metres.
pub fn height(physics: &Physics, body: usize) -> f64 {
    physics.data().xpos()[body][2]
}

/// The vertical component of a body's z-axis: 1 upright, -1 upside down.
pub fn uprightness(physics: &Physics, body: usize) -> f64 {
    physics.data().xmat()[body][8]
}

/// The angular momentum of a body's subtree about the y-axis, in kg m²/s; positive for a forward rotation.
pub fn forward_spin(physics: &Physics, body: usize) -> f64 {
    physics.data().subtree_angmom()[body][1]
}
