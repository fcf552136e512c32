//! [`StepHooks`]: changes to MuJoCo's dynamics between the stages of a time step.

use mujoco_rs::mujoco_c::mjContact;
use mujoco_rs::wrappers::MjModel;

/// Positions (m) and orientations (row-major 3 x 3) of all geoms.
pub(crate) type GeomPoses<'a> = (&'a [[f64; 3]], &'a [[f64; 9]]);

/// One row of an equality constraint, before its reference acceleration is computed.
pub(crate) struct EqualityRow {
    /// Stiffness (1/s²), damping (1/s), impedance, and derivative of the impedance.
    pub kbip: [f64; 4],
    /// Constraint violation, in metres or radians.
    pub position: f64,
    /// Violation at which the constraint begins to act, in metres or radians.
    pub margin: f64,
    /// Rate of the violation, in metres or radians per second.
    pub velocity: f64,
}

/// Replaces the contacts and the reference accelerations of equality constraints in every time step. Supports only
/// models with Euler integration and without activations, flexes and tendons.
pub(crate) trait StepHooks: Send + Sync {
    /// Appends the contacts to simulate to `contacts`, all between geoms of `model`: MuJoCo does not check their indices.
    /// `found` are MuJoCo's contacts, grouped by pair of geoms.
    fn replace_contacts(
        &self,
        model: &MjModel,
        poses: GeomPoses<'_>,
        found: &[mjContact],
        contacts: &mut Vec<mjContact>,
    );

    /// The reference acceleration of an equality constraint, in m/s² or rad/s².
    fn reference_acceleration(&self, row: &EqualityRow) -> f64;
}
