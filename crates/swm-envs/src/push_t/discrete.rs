//! `swm/PushT-Discrete-v1`: Push-T with actions from a polar grid, for planners and models of discrete actions.
//!
//! Only the actions differ from [`super::PushT`]. The grid is that of the reference (`quantizer.py`): equal bins of the
//! radius and of the angle, each represented by its centre.

use super::{PushT, expert};
use std::f64::consts::TAU;
use swm_core::policy::Expert;
use swm_core::{EnvEntry, ExpertEntry, Result, RowRef, Space};

/// The registry row of this environment.
pub const ENTRY: EnvEntry = EnvEntry {
    id: "swm/PushT-Discrete-v1",
    summary: "push a block to a goal pose, by steps from a polar grid",
    options: &[],
    make: |_| Ok(Box::new(PushT::with_actions(ENTRY.id, space()))),
    experts: EXPERTS,
};

const EXPERTS: &[ExpertEntry] = &[
    ExpertEntry {
        id: "expert",
        summary: "pushes planned with the environment's own physics",
        tasks: &[],
        make: || Box::new(OnGrid(expert::Pusher::new(rounded, expert::Pace::FULL))),
    },
    ExpertEntry {
        id: "weak",
        summary: "random actions that stay near the block",
        tasks: &[],
        make: || Box::new(OnGrid(expert::WeakExpert::default())),
    },
];

/// The number of bins of the radius, from 0 to 1, and of the angle, from x towards y.
const BINS: [i64; 2] = [16, 16];

/// The action space: the bins of radius and angle.
pub fn space() -> Space {
    Space::MultiDiscrete { nvec: BINS.to_vec(), start: vec![0, 0] }
}

/// Returns the continuous action that a pair of bins represents.
pub fn action(bins: &[i64]) -> [f32; 2] {
    let centre = |i: usize| (bins[i] as f64 + 0.5) / BINS[i] as f64;
    let (radius, angle) = (centre(0), centre(1) * TAU);
    [(radius * angle.cos()) as f32, (radius * angle.sin()) as f32]
}

/// Returns the bins of a continuous action. Actions outside the unit circle belong to the outermost ring.
pub fn bins([x, y]: [f64; 2]) -> [i64; 2] {
    let shares = [x.hypot(y), y.atan2(x).rem_euclid(TAU) / TAU];
    std::array::from_fn(|i| ((shares[i] * BINS[i] as f64) as i64).clamp(0, BINS[i] - 1))
}

/// Rounds a continuous action to the grid.
fn rounded(continuous: [f64; 2]) -> [f64; 2] {
    action(&bins(continuous)).map(f64::from)
}

/// An expert of the continuous environment whose actions are rounded to the grid.
struct OnGrid<E>(E);

impl<E: Expert> Expert for OnGrid<E> {
    fn begin(&mut self, key: swm_core::Key) {
        self.0.begin(key);
    }

    fn act(&mut self, row: RowRef<'_>, action: &mut [f64]) -> Result<()> {
        let mut continuous = [0.0; 2];
        self.0.act(row, &mut continuous)?;
        action.copy_from_slice(&bins(continuous).map(|bin| bin as f64));
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_bin_contains_its_action() {
        for radius in 0..BINS[0] {
            for angle in 0..BINS[1] {
                assert_eq!(bins(action(&[radius, angle]).map(f64::from)), [radius, angle]);
            }
        }
        // Corners of the square lie outside the circle; angles increase from x towards y.
        assert_eq!(bins([-1.0, -1.0]), [15, 10]);
        assert_eq!(bins([0.0, 0.0]), [0, 0]);
        assert_eq!(bins([0.5, -1e-300]), [8, 15]);
    }
}
