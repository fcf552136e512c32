//! The controller of Acrobot, which adds energy to the links.

use super::physics::State;

/// Returns the torque that adds energy: it has the sign of the joint's angular velocity.
pub fn torque(&[_, _, _, joint_velocity]: &State) -> f64 {
    if joint_velocity >= 0.0 { 1.0 } else { -1.0 }
}

#[cfg(test)]
mod tests {
    use crate::classic::acrobot::ENTRY;
    use crate::classic::measure::tally;

    #[test]
    fn expert_lifts_the_end_above_the_line() {
        assert_eq!(tally(&ENTRY, false, false).successes, 200, "the expert reaches the line");
        assert_eq!(tally(&ENTRY, true, false).successes, 199, "the expert reaches the line, all factors varied");
        assert!(tally(&ENTRY, false, true).successes >= 160, "the expert reaches sampled goals");
    }
}
