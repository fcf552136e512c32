//! The controller.

use super::physics::Physics;

/// Where all four poles of the closed loop lie, in units of the pole's own rate of falling.
const RATE: f64 = 0.8;
/// The most the cart may be away from where it should be, in metres: beyond, it only goes as fast.
const FAR: f64 = 0.5;

/// Whether to push to the right, to bring the cart to `goal` with the pole up.
///
/// Near upright, the motion follows from one quantity alone, the place `y = x + c θ` with `c` the ratio of what a force
/// does to cart and pole (a flat output): its second derivative is proportional to the angle, the fourth contains the
/// force. Feedback puts all four poles of the loop at one place, which says how `y` should be accelerated; the force
/// that would do so says which way to push.
pub fn pushes_right(physics: &Physics, state: &[f64; 5], goal: f64) -> bool {
    let Physics { gravity, length, pole, total, .. } = *physics;
    let [x, v, angle, turn, _] = *state;
    // θ'' = fall θ - β u and x'' = γ u - δ θ for a force u.
    let lever = length * (4.0 / 3.0 - pole / total);
    let (fall, beta) = (gravity / lever, 1.0 / (total * lever));
    let drag = pole * length / total;
    let (gamma, delta) = (1.0 / total + drag * beta, drag * fall);
    let c = gamma / beta;
    let pull = c * fall - delta;
    // y and its derivatives.
    let away = (x + c * angle - goal).clamp(-FAR, FAR);
    let (speed, acceleration, jerk) = (v + c * turn, pull * angle, pull * turn);
    let p = RATE * fall.sqrt();
    let wanted = -(p.powi(4) * away + 4.0 * p.powi(3) * speed + 6.0 * p * p * acceleration + 4.0 * p * jerk);
    // y'''' = pull (fall θ - β u)
    fall * angle - wanted / pull > 0.0
}

#[cfg(test)]
mod tests {
    use crate::classic::cart_pole::ENTRY;
    use crate::classic::measure::{Tally, tally};

    #[test]
    fn the_expert_reaches_the_goal_and_keeps_the_pole_up() {
        for (all, sampled, reached) in [(false, false, 200), (false, true, 200), (true, false, 199), (true, true, 198)]
        {
            let what = format!("all varied: {all}, sampled goal: {sampled}");
            let Tally { successes, reward, .. } = tally(&ENTRY, all, sampled);
            assert_eq!(successes, reached, "{what}");
            assert_eq!(reward, 200.0 * 500.0, "{what}: the pole fell");
        }
    }
}
