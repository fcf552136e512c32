//! [`GoalCoordinates`]: compares configurations joint by joint.

use super::measures::norm;
use mujoco_rs::wrappers::MjModel;
use mujoco_rs::wrappers::mj_model::{MjtJoint, MjtObjBase};
use std::f64::consts::PI;

/// A coordinate that goals include, by its index in `qpos`.
#[derive(Clone, Copy)]
enum Coordinate {
    /// A length, or an angle between limits.
    Scalar(usize),
    /// A periodic angle.
    Angle(usize),
    /// The orientation quaternion of a free body.
    Orientation(usize),
}

/// The coordinates that goals include.
pub struct GoalCoordinates {
    included: Vec<Coordinate>,
    /// Index in `qpos` and limits of each limited joint, in radians or metres.
    limits: Vec<(usize, [f64; 2])>,
}

impl GoalCoordinates {
    /// The coordinates of every joint except `ignored`. Of a free body, goals include height and orientation, but not
    /// the position on the floor, which is not observed.
    pub fn new(model: &MjModel, ignored: &[&str]) -> Self {
        let (mut included, mut limits) = (vec![], vec![]);
        for joint in 0..model.jnt_type().len() {
            if model.id_to_name(MjtObjBase::mjOBJ_JOINT, joint).is_some_and(|name| ignored.contains(&name)) {
                continue;
            }
            let at = model.jnt_qposadr()[joint] as usize;
            if model.jnt_limited()[joint] {
                limits.push((at, model.jnt_range()[joint]));
            }
            match model.jnt_type()[joint] {
                MjtJoint::mjJNT_FREE => included.extend([Coordinate::Scalar(at + 2), Coordinate::Orientation(at + 3)]),
                MjtJoint::mjJNT_HINGE if !model.jnt_limited()[joint] => included.push(Coordinate::Angle(at)),
                _ => included.push(Coordinate::Scalar(at)),
            }
        }
        Self { included, limits }
    }

    /// Whether every joint is within its limits, extended by `tolerance`. Limits are soft: a joint can exceed them for
    /// a few steps.
    pub fn within_limits(&self, qpos: &[f64], tolerance: f64) -> bool {
        self.limits.iter().all(|&(at, [low, high])| (low - tolerance..=high + tolerance).contains(&qpos[at]))
    }

    /// The absolute difference in each coordinate, in radians or metres.
    fn differences<'a>(&'a self, qpos: &'a [f64], goal: &'a [f64]) -> impl Iterator<Item = f64> + 'a {
        self.included.iter().map(move |coordinate| match *coordinate {
            Coordinate::Scalar(at) => (qpos[at] - goal[at]).abs(),
            Coordinate::Angle(at) => ((qpos[at] - goal[at] + PI).rem_euclid(2.0 * PI) - PI).abs(),
            Coordinate::Orientation(at) => angle_between(&qpos[at..at + 4], &goal[at..at + 4]),
        })
    }

    /// Whether every coordinate of `qpos` differs from the coordinate of `goal` by less than `tolerance`.
    pub fn reached(&self, qpos: &[f64], goal: &[f64], tolerance: f64) -> bool {
        self.differences(qpos, goal).all(|difference| difference < tolerance)
    }

    /// The Euclidean norm of the differences between `qpos` and `goal`. It mixes radians and metres.
    pub fn distance(&self, qpos: &[f64], goal: &[f64]) -> f64 {
        self.differences(qpos, goal).map(|difference| difference * difference).sum::<f64>().sqrt()
    }
}

/// The angle (rad) of the rotation between two orientations. The quaternions need not be normalised.
fn angle_between(a: &[f64], b: &[f64]) -> f64 {
    // For small angles, the arcsine of the difference is better conditioned than the arccosine of the product.
    let [a, b] = [a, b].map(|q| {
        let length = norm(q);
        std::array::from_fn::<f64, 4, _>(|i| q[i] / length)
    });
    let apart = |sign: f64| norm(&std::array::from_fn::<f64, 4, _>(|i| a[i] - sign * b[i]));
    4.0 * (apart(1.0).min(apart(-1.0)) / 2.0).clamp(0.0, 1.0).asin()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn angle_between_orientations_is_the_shortest() {
        let about_x = |angle: f64| [(angle / 2.0).cos(), (angle / 2.0).sin(), 0.0, 0.0];
        for (a, b, expected) in [(0.0, 0.5, 0.5), (0.0, -2.0, 2.0), (3.0, -3.0, 2.0 * PI - 6.0), (1.0, 1.0, 0.0)] {
            assert!((angle_between(&about_x(a), &about_x(b)) - expected).abs() < 1e-12, "from {a} to {b}");
            let opposite = about_x(b).map(|value| -2.0 * value);
            assert!(
                (angle_between(&about_x(a), &opposite) - expected).abs() < 1e-12,
                "from {a} to {b}, with a scaled and negated quaternion"
            );
        }
    }
}
