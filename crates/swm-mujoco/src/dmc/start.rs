//! Start states of episodes (`dm_control/suite/utils/randomizers.py`).

use super::measures::norm;
use crate::Physics;
use mujoco_rs::wrappers::mj_model::MjtJoint;
use rand::Rng as _;
use std::f64::consts::PI;
use swm_core::{Error, Result, Rng};

/// The number of starts that [`sample_without_contacts`] draws before it fails.
const START_TRIES: usize = 1000;

/// Randomises every joint: limited joints within their limits, unlimited hinges over the full circle, free bodies in
/// orientation. Unlimited slides keep their position.
///
/// The quaternion of a free body is drawn from the positive orthant, which does not contain all rotations: a bug of the
/// suite, reproduced so that starts have the same distribution.
pub fn randomize_joints(physics: &mut Physics, rng: &mut Rng) {
    for joint in 0..physics.model().jnt_type().len() {
        let model = physics.model();
        let (kind, limited, [low, high]) =
            (model.jnt_type()[joint], model.jnt_limited()[joint], model.jnt_range()[joint]);
        let at = model.jnt_qposadr()[joint] as usize;
        let qpos = physics.data_mut().qpos_mut();
        match kind {
            MjtJoint::mjJNT_HINGE | MjtJoint::mjJNT_SLIDE if limited => qpos[at] = rng.random_range(low..high),
            MjtJoint::mjJNT_HINGE => qpos[at] = rng.random_range(-PI..PI),
            MjtJoint::mjJNT_FREE => {
                let quat: [f64; 4] = rng.random();
                let length = norm(&quat);
                qpos[at + 3..at + 7].copy_from_slice(&quat.map(|value| value / length));
            }
            _ => {}
        }
    }
}

/// Randomises the limited joints within their limits.
pub fn randomize_limited_joints(physics: &mut Physics, rng: &mut Rng) {
    for joint in 0..physics.model().jnt_type().len() {
        let model = physics.model();
        let (limited, [low, high]) = (model.jnt_limited()[joint], model.jnt_range()[joint]);
        let at = model.jnt_qposadr()[joint] as usize;
        if limited {
            physics.data_mut().qpos_mut()[at] = rng.random_range(low..high);
        }
    }
}

/// Draws starts until a start has no contacts.
///
/// # Errors
/// When every drawn start has contacts.
pub fn sample_without_contacts(
    physics: &mut Physics,
    rng: &mut Rng,
    mut draw: impl FnMut(&mut Physics, &mut Rng),
) -> Result<()> {
    for _ in 0..START_TRIES {
        draw(physics, rng);
        physics.forward_passive();
        if physics.data().contact().is_empty() {
            return Ok(());
        }
    }
    let constraint = "free of contacts".to_owned();
    Err(Error::Unsatisfiable { factor: "start".to_owned(), constraint, tries: START_TRIES })
}
