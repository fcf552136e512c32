//! How far a configuration is from another: joint by joint.

use mujoco_rs::wrappers::MjModel;
use mujoco_rs::wrappers::mj_model::{MjtJoint, MjtObjBase};
use std::f64::consts::PI;

/// A coordinate that a goal asks for, by its place in `qpos`.
#[derive(Clone, Copy)]
enum Coordinate {
    /// A length, or an angle between limits.
    Number(usize),
    /// An angle that comes round.
    Angle(usize),
    /// The orientation of a free body.
    Turn(usize),
}

/// The coordinates that goals ask for.
pub struct Coordinates {
    asked: Vec<Coordinate>,
    /// Those of joints with limits, by their place in `qpos`, and the limits.
    limits: Vec<(usize, [f64; 2])>,
}

impl Coordinates {
    /// Those of every joint that is not idle. Of a free body these are its height and its orientation: where it is on the
    /// floor is neither observed nor asked for.
    pub fn new(model: &MjModel, idle: &[&str]) -> Self {
        let (mut asked, mut limits) = (vec![], vec![]);
        for joint in 0..model.jnt_type().len() {
            if model.id_to_name(MjtObjBase::mjOBJ_JOINT, joint).is_some_and(|name| idle.contains(&name)) {
                continue;
            }
            let at = model.jnt_qposadr()[joint] as usize;
            if model.jnt_limited()[joint] {
                limits.push((at, model.jnt_range()[joint]));
            }
            match model.jnt_type()[joint] {
                MjtJoint::mjJNT_FREE => asked.extend([Coordinate::Number(at + 2), Coordinate::Turn(at + 3)]),
                MjtJoint::mjJNT_HINGE if !model.jnt_limited()[joint] => asked.push(Coordinate::Angle(at)),
                _ => asked.push(Coordinate::Number(at)),
            }
        }
        Self { asked, limits }
    }

    /// Whether every joint is within its limits, or no more than this beyond. Limits give way: where a joint was thrown against
    /// them it cannot stay.
    pub fn can_stay(&self, qpos: &[f64], beyond: f64) -> bool {
        self.limits.iter().all(|&(at, [low, high])| (low - beyond..=high + beyond).contains(&qpos[at]))
    }

    /// How far apart two configurations are in each coordinate, in radians or metres.
    fn differences<'a>(&'a self, here: &'a [f64], there: &'a [f64]) -> impl Iterator<Item = f64> + 'a {
        self.asked.iter().map(move |coordinate| match *coordinate {
            Coordinate::Number(at) => (here[at] - there[at]).abs(),
            Coordinate::Angle(at) => ((here[at] - there[at] + PI).rem_euclid(2.0 * PI) - PI).abs(),
            Coordinate::Turn(at) => angle_between(&here[at..at + 4], &there[at..at + 4]),
        })
    }

    /// Whether every coordinate is nearer than this.
    pub fn reached(&self, here: &[f64], there: &[f64], near: f64) -> bool {
        self.differences(here, there).all(|difference| difference < near)
    }

    /// The square root of the squared differences, added.
    pub fn distance(&self, here: &[f64], there: &[f64]) -> f64 {
        self.differences(here, there).map(|difference| difference * difference).sum::<f64>().sqrt()
    }
}

/// The angle by which one must turn to come from one orientation to another. The quaternions need not have length 1.
fn angle_between(a: &[f64], b: &[f64]) -> f64 {
    // Between rounding and arc cosine, the difference is the better conditioned way for small angles.
    let [a, b] = [a, b].map(|q| {
        let length = super::norm(q);
        std::array::from_fn::<f64, 4, _>(|i| q[i] / length)
    });
    let apart = |sign: f64| super::norm(&std::array::from_fn::<f64, 4, _>(|i| a[i] - sign * b[i]));
    4.0 * (apart(1.0).min(apart(-1.0)) / 2.0).clamp(0.0, 1.0).asin()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn turns_are_compared_the_short_way() {
        let about_x = |angle: f64| [(angle / 2.0).cos(), (angle / 2.0).sin(), 0.0, 0.0];
        for (a, b, wanted) in [(0.0, 0.5, 0.5), (0.0, -2.0, 2.0), (3.0, -3.0, 2.0 * PI - 6.0), (1.0, 1.0, 0.0)] {
            assert!((angle_between(&about_x(a), &about_x(b)) - wanted).abs() < 1e-12, "from {a} to {b}");
            let opposite = about_x(b).map(|number| -2.0 * number);
            assert!(
                (angle_between(&about_x(a), &opposite) - wanted).abs() < 1e-12,
                "from {a} to {b}, written otherwise"
            );
        }
    }
}
