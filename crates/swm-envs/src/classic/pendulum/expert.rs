//! The controller.

use super::angle::between;
use super::physics::Physics;

/// Near enough to upright to be caught, in units of what the motor can hold.
const CATCH: f64 = 1.0;
/// Where both poles of the closed loop lie near upright, in units of the rod's own rate of falling.
const RATE: f64 = 1.5;

/// The torque, at most `limit`, that swings the rod up and holds it.
pub fn torque(physics: &Physics, &[angle, turn, _]: &[f64; 3], limit: f64) -> f64 {
    let (fall, push) = (physics.fall(), physics.per_torque());
    let (off, limit) = (between(0.0, angle), limit.min(physics.max_torque));
    // Upright, θ'' = fall θ + push u.
    let rate = RATE * fall.sqrt();
    let wanted = -((fall + rate * rate) * off + 2.0 * rate * turn) / push;
    if wanted.abs() <= CATCH * limit {
        return wanted.clamp(-limit, limit);
    }
    // The energy that is missing for standing upright; a torque the way the rod turns adds to it.
    let missing = fall * (1.0 - off.cos()) - turn * turn / 2.0;
    let way = if turn == 0.0 { 1.0 } else { turn.signum() };
    limit.copysign(missing * way)
}

#[cfg(test)]
mod tests {
    use crate::classic::measure::tally;
    use crate::classic::pendulum::ENTRY;

    #[test]
    fn the_expert_swings_up_and_holds() {
        assert_eq!(tally(&ENTRY, false, false).successes, 200, "upright");
        assert_eq!(tally(&ENTRY, true, false).successes, 169, "upright, everything varied: some motors are too weak");
        assert!(tally(&ENTRY, false, true).successes >= 180, "sampled goals are on its way, but for chance");
    }
}
