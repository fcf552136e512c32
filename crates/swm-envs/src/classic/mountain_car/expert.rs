//! The controller of Mountain Car, which adds energy on every swing.

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
        for (entry, expected) in [(&ENTRY, 163), (&CONTINUOUS, 192)] {
            for sampled in [false, true] {
                assert_eq!(tally(entry, false, sampled).successes, 200, "{}, sampled goal: {sampled}", entry.id);
            }
            // The factors of the remaining episodes make the flag unreachable within the time limit.
            assert_eq!(tally(entry, true, false).successes, expected, "{}, all factors varied", entry.id);
        }
    }
}
