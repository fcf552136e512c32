//! How episodes of the suite begin.

use crate::Physics;
use mujoco_rs::wrappers::mj_model::MjtJoint;
use rand::Rng as _;
use std::f64::consts::PI;
use swm_core::{Error, Result, Rng};

/// How often a start is drawn before giving up.
const TRIES: usize = 1000;

/// Turns every joint at random: those with limits within them, hinges without them anywhere, and bodies that float free.
/// Free slides keep their place.
///
/// A free body's quaternion has no negative numbers, which are not all turns there are: the suite's own slip, kept for the
/// sake of comparison.
pub fn random_joints(physics: &mut Physics, rng: &mut Rng) {
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
                let turn: [f64; 4] = rng.random();
                let length = super::norm(&turn);
                qpos[at + 3..at + 7].copy_from_slice(&turn.map(|number| number / length));
            }
            _ => {}
        }
    }
}

/// Turns the joints that have limits within them.
pub fn limited_joints(physics: &mut Physics, rng: &mut Rng) {
    for joint in 0..physics.model().jnt_type().len() {
        let model = physics.model();
        let (limited, [low, high]) = (model.jnt_limited()[joint], model.jnt_range()[joint]);
        let at = model.jnt_qposadr()[joint] as usize;
        if limited {
            physics.data_mut().qpos_mut()[at] = rng.random_range(low..high);
        }
    }
}

/// Draws until nothing touches anything.
///
/// # Errors
/// When something always does.
pub fn without_contacts(
    physics: &mut Physics,
    rng: &mut Rng,
    mut draw: impl FnMut(&mut Physics, &mut Rng),
) -> Result<()> {
    for _ in 0..TRIES {
        draw(physics, rng);
        physics.forward_passive();
        if physics.data().contact().is_empty() {
            return Ok(());
        }
    }
    let constraint = "nothing touches anything".to_owned();
    Err(Error::Unsatisfiable { factor: "start".to_owned(), constraint, tries: TRIES })
}
