//! The scripted expert of the pendulum: it pumps energy into the swing, then balances (Åström and Furuta 2000, "Swinging up a
//! pendulum by energy control").

use std::f64::consts::PI;
use swm_core::policy::Expert;
use swm_core::{Error, ExpertEntry, Key, Result, RowRef};

/// The experts of the pendulum.
pub const EXPERTS: &[ExpertEntry] = &[ExpertEntry {
    id: "expert",
    summary: "swings up by energy control, and balances with a PD controller",
    tasks: &[],
    make: || Box::new(Controller),
}];

/// Moment of inertia about the hinge, in kg m², and weight times distance of the centre of mass, in J: of a mass of 1 kg at the end of a
/// pole of 0.5 m. What the pole itself weighs changes no return.
const INERTIA: f64 = 0.251;
const WEIGHT: f64 = 4.905;
/// The energy at rest at the top, and 0.1 J for friction.
const ENERGY: f64 = WEIGHT + 0.1;
/// Control per joule of missing energy, large enough to be at the limit almost always.
const PUMP: f64 = 20.0;
/// Stiffness (control per radian) and damping (control per rad/s) of the balance.
const BALANCE: [f64; 2] = [20.0, 4.0];
/// The expert balances where the angle is at most [`NEAR`] and [`LOOK_AHEAD`] seconds later at most [`HELD`], in radians: there the motor
/// can hold the pole.
const NEAR: f64 = 0.5;
const LOOK_AHEAD: f64 = 0.22;
const HELD: f64 = 0.2;

/// A stateless controller that reads `qpos` and `qvel`.
struct Controller;

impl Expert for Controller {
    fn begin(&mut self, _key: Key) {}

    fn act(&mut self, row: RowRef<'_>, action: &mut [f64]) -> Result<()> {
        let (angles, speeds) = (row.to_f64("qpos")?, row.to_f64("qvel")?);
        let (&[angle], &[speed], [control]) = (&angles[..], &speeds[..], action) else {
            let given = format!("{} angles and {} speeds", angles.len(), speeds.len());
            return Err(Error::mismatch("controlling a pendulum", given, "one of each"));
        };
        // 0 is upright.
        let angle = (angle + PI).rem_euclid(2.0 * PI) - PI;
        let is_held = angle.abs() < NEAR && (angle + LOOK_AHEAD * speed).abs() < HELD;
        let wanted = if is_held {
            -BALANCE[0] * angle - BALANCE[1] * speed
        } else {
            let missing = ENERGY - 0.5 * INERTIA * speed * speed - WEIGHT * angle.cos();
            PUMP * missing * if speed < 0.0 { -1.0 } else { 1.0 }
        };
        *control = wanted.clamp(-1.0, 1.0);
        Ok(())
    }
}
