//! Where the joints must be for the flange to be at a pose: damped least squares.
//!
//! The iteration is OGBench's `DiffIKController`: at most 20 steps, none of which turns a joint by more than 45°, until
//! place and turn are within 10⁻⁴ m and rad.

use super::pose::{Pose, Vec3, about, cross, inverse, log, mul, norm, normalized, rotate, sub};

/// Joints of the arm.
pub const JOINTS: usize = 6;

const ITERATIONS: usize = 20;
const TOLERANCE: f64 = 1e-4;
const DAMPING: f64 = 1e-12;
const LARGEST_TURN: f64 = std::f64::consts::FRAC_PI_4;

/// One joint: where its link is seen from the link before, and the axis it turns about, seen from its link.
#[derive(Clone, Copy, Debug)]
pub struct Link {
    /// Where the link is while the joint is at 0.
    pub at: Pose,
    /// The joint's axis through the link's origin, of length 1.
    pub axis: Vec3,
}

/// An arm of hinges.
#[derive(Clone, Debug)]
pub struct Chain {
    /// Where the arm stands.
    pub base: Pose,
    /// Its links, from the base on.
    pub links: [Link; JOINTS],
    /// Where the flange is, seen from the last link.
    pub flange: Pose,
}

/// Three rows for the velocity of the flange, three for its angular velocity.
type Jacobian = [[f64; JOINTS]; 6];

impl Chain {
    /// Joint positions that bring the flange to `target`, near `start`.
    pub fn solve(&self, target: Pose, start: [f64; JOINTS]) -> [f64; JOINTS] {
        let mut joints = start;
        for _ in 0..ITERATIONS {
            let (flange, jacobian) = self.forward(&joints);
            let away = sub(target.place, flange.place);
            let turned = log(mul(target.turn, inverse(flange.turn)));
            if norm(&away) <= TOLERANCE && norm(&turned) <= TOLERANCE {
                break;
            }
            let error = [away[0], away[1], away[2], turned[0], turned[1], turned[2]];
            let mut step = least_squares(&jacobian, error);
            let largest = step.iter().fold(0.0, |most: f64, turn| most.max(turn.abs()));
            if largest > LARGEST_TURN {
                step = step.map(|turn| turn * (LARGEST_TURN / largest));
            }
            joints = std::array::from_fn(|i| joints[i] + step[i]);
        }
        joints
    }

    /// Where the flange is, and how it moves with each joint.
    fn forward(&self, joints: &[f64; JOINTS]) -> (Pose, Jacobian) {
        let mut pose = self.base;
        let mut axes = [([0.0; 3], [0.0; 3]); JOINTS];
        for ((link, &angle), axis) in self.links.iter().zip(joints).zip(&mut axes) {
            pose = pose.then(link.at);
            pose.turn = normalized(mul(pose.turn, about(link.axis, angle)));
            *axis = (rotate(pose.turn, link.axis), pose.place);
        }
        let flange = pose.then(self.flange);
        let mut jacobian = [[0.0; JOINTS]; 6];
        for (joint, (axis, anchor)) in axes.into_iter().enumerate() {
            let velocity = cross(axis, sub(flange.place, anchor));
            for row in 0..3 {
                jacobian[row][joint] = velocity[row];
                jacobian[row + 3][joint] = axis[row];
            }
        }
        (flange, jacobian)
    }
}

/// `Jᵀ (J Jᵀ + λ I)⁻¹ error`.
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

/// Solves a system of six equations by elimination, the largest pivot first.
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

    fn link(place: Vec3, turn: Quat, axis: Vec3) -> Link {
        Link { at: Pose { place, turn: normalized(turn) }, axis }
    }

    /// The UR5e's measures.
    fn arm() -> Chain {
        let (y, z) = ([0.0, 1.0, 0.0], [0.0, 0.0, 1.0]);
        Chain {
            base: Pose { place: [0.0; 3], turn: normalized([1.0, 0.0, 0.0, 1.0]) },
            links: [
                link([0.0, 0.0, 0.163], IDENTITY, z),
                link([0.0, 0.138, 0.0], [1.0, 0.0, 1.0, 0.0], y),
                link([0.0, -0.131, 0.425], IDENTITY, y),
                link([0.0, 0.0, 0.392], [1.0, 0.0, 1.0, 0.0], y),
                link([0.0, 0.127, 0.0], IDENTITY, z),
                link([0.0, 0.0, 0.1], IDENTITY, y),
            ],
            flange: Pose { place: [0.0, 0.1, 0.0], turn: normalized([-1.0, 1.0, 0.0, 0.0]) },
        }
    }

    #[test]
    fn the_jacobian_is_the_derivative() {
        let (arm, joints) = (arm(), [0.3, -1.2, 1.4, -0.9, -1.5, 0.2]);
        let (before, jacobian) = arm.forward(&joints);
        for joint in 0..JOINTS {
            let mut moved = joints;
            moved[joint] += 1e-6;
            let (after, _) = arm.forward(&moved);
            let (way, turn) = (sub(after.place, before.place), log(mul(after.turn, inverse(before.turn))));
            for row in 0..3 {
                assert!((way[row] / 1e-6 - jacobian[row][joint]).abs() < 1e-5);
                assert!((turn[row] / 1e-6 - jacobian[row + 3][joint]).abs() < 1e-5);
            }
        }
    }

    #[test]
    fn the_flange_arrives() {
        use std::f64::consts::FRAC_PI_2 as RIGHT;
        let (arm, home) = (arm(), [-RIGHT, -RIGHT, RIGHT, -RIGHT, -RIGHT, 0.0]);
        let (start, _) = arm.forward(&home);
        let target = Pose { place: [start.place[0] + 0.1, start.place[1] - 0.2, start.place[2] - 0.1], ..start };
        let (reached, _) = arm.forward(&arm.solve(target, home));
        assert!(distance(reached.place, target.place) <= TOLERANCE);
        assert!(norm(&log(mul(target.turn, inverse(reached.turn)))) <= TOLERANCE);
        assert_eq!(arm.solve(start, home), home, "who is there does not move");
    }
}
