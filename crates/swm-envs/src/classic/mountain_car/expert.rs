//! The controller: an energy pump.

/// Returns whether to push to the right: in the direction of motion, so that every swing is higher than the last.
pub fn pushes_right([_, speed]: &[f64; 2]) -> bool {
    *speed >= 0.0
}

#[cfg(test)]
mod tests {
    use crate::classic::measure::tally;
    use crate::classic::mountain_car::{CONTINUOUS, ENTRY};

    #[test]
    fn expert_reaches_the_flag() {
        for (entry, varied) in [(&ENTRY, 163), (&CONTINUOUS, 192)] {
            for sampled in [false, true] {
                assert_eq!(tally(entry, false, sampled).successes, 200, "{}, sampled goal: {sampled}", entry.id);
            }
            // In the other episodes the flag is unreachable, or not reachable in time.
            assert_eq!(tally(entry, true, false).successes, varied, "{}, all factors varied", entry.id);
        }
    }
}
