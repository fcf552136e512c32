//! Inverse kinematics of the arm by damped least squares.
//!
//! The iteration is that of OGBench's `DiffIKController`: at most 20 steps of at most 45° per joint, until position and
//! orientation are within 10⁻⁴ m and rad.

use super::pose::{Pose, Vec3, about, cross, inverse, log, mul, norm, normalized, rotate, sub};

/// The number of joints of the arm.
pub const JOINTS: usize = 6;

const MAX_ITERATIONS: usize = 20;
/// Tolerance of position and orientation, in metres and radians.
const TOLERANCE: f64 = 1e-4;
/// The damping λ of the least squares.
const DAMPING: f64 = 1e-12;
/// The maximal rotation of a joint in one iteration, in radians.
const MAX_STEP: f64 = std::f64::consts::FRAC_PI_4;

/// A link of the arm and the joint that moves it.
#[derive(Clone, Copy, Debug)]
pub struct Link {
    /// The pose in the frame of the previous link at joint angle 0.
    pub rest: Pose,
    /// The joint's axis through the link's origin, a unit vector in the frame of the link.
    pub axis: Vec3,
}

/// A kinematic chain of hinges.
#[derive(Clone, Debug)]
pub struct Chain {
    /// The pose of the base in the world.
    pub base: Pose,
    /// The links, from the base on.
    pub links: [Link; JOINTS],
    /// The pose of the flange in the frame of the last link.
    pub flange: Pose,
}

/// The Jacobian of the flange: three rows for linear velocity (m/rad), then three for angular velocity (rad/rad).
type Jacobian = [[f64; JOINTS]; 6];

impl Chain {
    /// Joint angles (rad) that bring the flange to `target`, starting from `start`.
    pub fn solve(&self, target: Pose, start: [f64; JOINTS]) -> [f64; JOINTS] {
        let mut joints = start;
        for _ in 0..MAX_ITERATIONS {
            let (flange, jacobian) = self.forward(&joints);
            let offset = sub(target.position, flange.position);
            let rotation = log(mul(target.rotation, inverse(flange.rotation)));
            if norm(&offset) <= TOLERANCE && norm(&rotation) <= TOLERANCE {
                break;
            }
            let error = [offset[0], offset[1], offset[2], rotation[0], rotation[1], rotation[2]];
            let mut step = least_squares(&jacobian, error);
            let largest = step.iter().fold(0.0, |most: f64, angle| most.max(angle.abs()));
            if largest > MAX_STEP {
                step = step.map(|angle| angle * (MAX_STEP / largest));
            }
            joints = std::array::from_fn(|i| joints[i] + step[i]);
        }
        joints
    }

    /// The pose of the flange and its Jacobian.
    fn forward(&self, joints: &[f64; JOINTS]) -> (Pose, Jacobian) {
        let mut pose = self.base;
        let mut axes = [([0.0; 3], [0.0; 3]); JOINTS];
        for ((link, &angle), axis) in self.links.iter().zip(joints).zip(&mut axes) {
            pose = pose.then(link.rest);
            pose.rotation = normalized(mul(pose.rotation, about(link.axis, angle)));
            *axis = (rotate(pose.rotation, link.axis), pose.position);
        }
        let flange = pose.then(self.flange);
        let mut jacobian = [[0.0; JOINTS]; 6];
        for (joint, (axis, anchor)) in axes.into_iter().enumerate() {
            let velocity = cross(axis, sub(flange.position, anchor));
            for row in 0..3 {
                jacobian[row][joint] = velocity[row];
                jacobian[row + 3][joint] = axis[row];
            }
        }
        (flange, jacobian)
    }
}

/// Solves damped least squares: `Jᵀ (J Jᵀ + λ I)⁻¹ error`.
fn least_squares(jacobian: &Jacobian, error: [f64; 6]) -> [f64; JOINTS] {
    let square = std::array::from_fn(|i| {
        std::array::from_fn(|j| {
            let product: f64 = (0..JOINTS).map(|k| jacobian[i][k] * jacobian[j][k]).sum();
            if i == j { product + DAMPING } else { product }
        })
    });
    let solution = solve(square, error);
    std::array::from_fn(|joint| (0..6).map(|row| jacobian[row][joint] * solution[row]).sum())
}

/// Solves a linear system of six equations by Gaussian elimination with partial pivoting.
fn solve(mut matrix: [[f64; 6]; 6], mut right: [f64; 6]) -> [f64; 6] {
    for column in 0..6 {
        let size = |row: &usize| matrix[*row][column].abs();
        let pivot = (column..6).max_by(|a, b| size(a).total_cmp(&size(b)).then(b.cmp(a))).unwrap_or(column);
        matrix.swap(column, pivot);
        right.swap(column, pivot);
        let above = matrix[column];
        for row in column + 1..6 {
            let factor = matrix[row][column] / above[column];
            for (entry, above) in matrix[row][column..].iter_mut().zip(&above[column..]) {
                *entry -= factor * above;
            }
            right[row] -= factor * right[column];
        }
    }
    for row in (0..6).rev() {
        let known: f64 = (row + 1..6).map(|k| matrix[row][k] * right[k]).sum();
        right[row] = (right[row] - known) / matrix[row][row];
    }
    right
}

#[cfg(test)]
mod tests {
    use super::super::pose::{IDENTITY, Quat, distance};
    use super::*;

    fn link(position: Vec3, rotation: Quat, axis: Vec3) -> Link {
        Link { rest: Pose { position, rotation: normalized(rotation) }, axis }
    }

    /// The dimensions of the UR5e.
    fn arm() -> Chain {
        let (y, z) = ([0.0, 1.0, 0.0], [0.0, 0.0, 1.0]);
        Chain {
            base: Pose { position: [0.0; 3], rotation: normalized([1.0, 0.0, 0.0, 1.0]) },
            links: [
                link([0.0, 0.0, 0.163], IDENTITY, z),
                link([0.0, 0.138, 0.0], [1.0, 0.0, 1.0, 0.0], y),
                link([0.0, -0.131, 0.425], IDENTITY, y),
                link([0.0, 0.0, 0.392], [1.0, 0.0, 1.0, 0.0], y),
                link([0.0, 0.127, 0.0], IDENTITY, z),
                link([0.0, 0.0, 0.1], IDENTITY, y),
            ],
            flange: Pose { position: [0.0, 0.1, 0.0], rotation: normalized([-1.0, 1.0, 0.0, 0.0]) },
        }
    }

    #[test]
    fn jacobian_equals_finite_differences() {
        let (arm, joints) = (arm(), [0.3, -1.2, 1.4, -0.9, -1.5, 0.2]);
        let (before, jacobian) = arm.forward(&joints);
        for joint in 0..JOINTS {
            let mut moved = joints;
            moved[joint] += 1e-6;
            let (after, _) = arm.forward(&moved);
            let offset = sub(after.position, before.position);
            let rotation = log(mul(after.rotation, inverse(before.rotation)));
            for row in 0..3 {
                assert!((offset[row] / 1e-6 - jacobian[row][joint]).abs() < 1e-5);
                assert!((rotation[row] / 1e-6 - jacobian[row + 3][joint]).abs() < 1e-5);
            }
        }
    }

    #[test]
    fn inverse_kinematics_reaches_the_target() {
        use std::f64::consts::FRAC_PI_2 as RIGHT;
        let (arm, home) = (arm(), [-RIGHT, -RIGHT, RIGHT, -RIGHT, -RIGHT, 0.0]);
        let (start, _) = arm.forward(&home);
        let [x, y, z] = start.position;
        let target = Pose { position: [x + 0.1, y - 0.2, z - 0.1], ..start };
        let (reached, _) = arm.forward(&arm.solve(target, home));
        assert!(distance(reached.position, target.position) <= TOLERANCE);
        assert!(norm(&log(mul(target.rotation, inverse(reached.rotation)))) <= TOLERANCE);
        assert_eq!(arm.solve(start, home), home, "the arm does not move if it is at the target");
    }
}
