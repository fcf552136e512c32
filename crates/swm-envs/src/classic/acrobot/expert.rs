//! The controller.

use super::physics::State;

/// The torque that adds energy: the way the joint turns.
pub fn torque(&[_, _, _, fold]: &State) -> f64 {
    if fold >= 0.0 { 1.0 } else { -1.0 }
}

#[cfg(test)]
mod tests {
    use crate::classic::acrobot::ENTRY;
    use crate::classic::measure::tally;

    #[test]
    fn the_expert_gets_above_the_line() {
        assert_eq!(tally(&ENTRY, false, false).successes, 200, "the line");
        assert_eq!(tally(&ENTRY, true, false).successes, 199, "the line, everything varied");
        assert!(tally(&ENTRY, false, true).successes >= 160, "sampled goals are on its way, but for chance");
    }
}
