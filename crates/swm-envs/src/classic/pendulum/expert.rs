//! The controller of Pendulum, which adds energy to the rod, then holds the rod upright by state feedback.

use super::physics::Physics;
use crate::classic::angle::between;

/// The largest torque at which state feedback starts, as a share of the maximal torque.
const CATCH: f64 = 1.0;
/// The two coinciding poles of the closed loop near upright, in units of the rate at which the rod falls.
const RATE: f64 = 1.5;

/// Returns the torque, at most `limit`, that swings the rod up and holds it, in N m.
pub fn torque(physics: &Physics, &[angle, velocity, _]: &[f64; 3], limit: f64) -> f64 {
    let (fall, push) = (physics.gravity_acceleration(), physics.acceleration_per_torque());
    let (error, limit) = (between(0.0, angle), limit.min(physics.max_torque));
    // Near upright, θ'' = fall θ + push u for a torque u.
    let rate = RATE * fall.sqrt();
    let wanted = -((fall + rate * rate) * error + 2.0 * rate * velocity) / push;
    if wanted.abs() <= CATCH * limit {
        return wanted.clamp(-limit, limit);
    }
    // The energy that is missing for standing upright. A torque in the direction of motion adds energy.
    let missing_energy = fall * (1.0 - error.cos()) - velocity * velocity / 2.0;
    let direction = if velocity == 0.0 { 1.0 } else { velocity.signum() };
    limit.copysign(missing_energy * direction)
}

#[cfg(test)]
mod tests {
    use crate::classic::measure::tally;
    use crate::classic::pendulum::ENTRY;

    #[test]
    fn expert_swings_the_rod_up_and_holds_it() {
        assert_eq!(tally(&ENTRY, false, false).successes, 200, "the rod is upright");
        assert_eq!(tally(&ENTRY, true, false).successes, 169, "the rod is upright, all factors varied");
        assert!(tally(&ENTRY, false, true).successes >= 180, "the expert reaches sampled goals");
    }
}
