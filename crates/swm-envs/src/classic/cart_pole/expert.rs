//! The controller of CartPole: state feedback on a flat output.

use super::physics::Physics;

/// The four coinciding poles of the closed loop, in units of the rate at which the pole falls.
const RATE: f64 = 0.8;
/// Position errors are clipped to this, in metres.
const MAX_ERROR: f64 = 0.5;

/// Returns whether to push to the right, in order to bring the cart to `goal` (in metres) with the pole up.
///
/// Near upright, the motion has the flat output `y = x + c θ`, where `c` is the ratio of the accelerations that a force
/// causes in cart and pole: the second derivative of `y` is proportional to the angle, and the fourth contains the
/// force. State feedback places all four poles of the closed loop at one value, which gives the desired fourth
/// derivative; the sign of the force that achieves it is the direction of the push.
pub fn pushes_right(physics: &Physics, state: &[f64; 5], goal: f64) -> bool {
    let Physics { gravity, length, pole, total, .. } = *physics;
    let [x, v, angle, angular_velocity, _] = *state;
    // θ'' = fall θ - β u and x'' = γ u - δ θ for a force u.
    let lever = length * (4.0 / 3.0 - pole / total);
    let (fall, beta) = (gravity / lever, 1.0 / (total * lever));
    let drag = pole * length / total;
    let (gamma, delta) = (1.0 / total + drag * beta, drag * fall);
    let c = gamma / beta;
    let pull = c * fall - delta;
    // The error of y, and its first three derivatives.
    let error = (x + c * angle - goal).clamp(-MAX_ERROR, MAX_ERROR);
    let (speed, acceleration, jerk) = (v + c * angular_velocity, pull * angle, pull * angular_velocity);
    let p = RATE * fall.sqrt();
    let wanted = -(p.powi(4) * error + 4.0 * p.powi(3) * speed + 6.0 * p * p * acceleration + 4.0 * p * jerk);
    // y'''' = pull (fall θ - β u)
    fall * angle - wanted / pull > 0.0
}

#[cfg(test)]
mod tests {
    use crate::classic::cart_pole::ENTRY;
    use crate::classic::measure::{Tally, tally};

    #[test]
    fn expert_reaches_the_goal_and_keeps_the_pole_up() {
        for (all, sampled, reached) in [(false, false, 200), (false, true, 200), (true, false, 199), (true, true, 198)]
        {
            let case = format!("all varied: {all}, sampled goal: {sampled}");
            let Tally { successes, reward, .. } = tally(&ENTRY, all, sampled);
            assert_eq!(successes, reached, "{case}");
            assert_eq!(reward, 200.0 * 500.0, "{case}: the pole fell");
        }
    }
}
