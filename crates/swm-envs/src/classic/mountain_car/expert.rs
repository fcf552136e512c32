//! The controller.

/// Whether to push to the right: the way the car rolls, so that every swing is higher than the last.
pub fn pushes_right([_, speed]: &[f64; 2]) -> bool {
    *speed >= 0.0
}

#[cfg(test)]
mod tests {
    use crate::classic::measure::tally;
    use crate::classic::mountain_car::{CONTINUOUS, ENTRY};

    #[test]
    fn the_expert_reaches_the_flag() {
        for (entry, varied) in [(&ENTRY, 163), (&CONTINUOUS, 192)] {
            for sampled in [false, true] {
                assert_eq!(tally(entry, false, sampled).successes, 200, "{}, sampled goal: {sampled}", entry.id);
            }
            // Elsewhere the car cannot get there, or not in time.
            assert_eq!(tally(entry, true, false).successes, varied, "{}, everything varied", entry.id);
        }
    }
}
