//! The dynamics: a disc moves by `action * speed` and by the drift of its zone, and is held inside the border.
//!
//! Constants, and the single precision of positions, are those of the reference (`piecewise/piecewise_env.py`).
//! Lengths are in pixels of the 224-pixel frame.

use crate::point_agent::Position;
use crate::point_agent::room::{self, BORDER, SIZE};

/// Zones along a side of the room.
pub const GRID: usize = 2;
/// The number of zones, which are numbered row by row.
pub const ZONES: usize = GRID * GRID;

/// The parameters of the agent's motion in an episode. Lengths are in pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Dynamics {
    /// The agent's radius.
    pub radius: f64,
    /// Distance per step of an action component of 1.
    pub speed: f64,
    /// The drift of each zone per step, x and y.
    pub drift: [[f64; 2]; ZONES],
}

impl Dynamics {
    /// Values in a row of the `dynamics` column.
    pub const LEN: usize = 2 + 2 * ZONES;

    /// Returns the `dynamics` column: radius, speed, then the drift of every zone.
    pub fn to_row(self) -> [f32; Self::LEN] {
        let mut row = [0.0; Self::LEN];
        let values = [self.radius, self.speed].into_iter().chain(self.drift.into_iter().flatten());
        row.iter_mut().zip(values).for_each(|(to, from)| *to = from as f32);
        row
    }

    /// Reads a `dynamics` column, `[LEN]` values.
    pub fn from_row(row: &[f64]) -> Self {
        Self { radius: row[0], speed: row[1], drift: std::array::from_fn(|i| [row[2 + 2 * i], row[3 + 2 * i]]) }
    }

    /// Returns the least and the greatest coordinate of the agent's centre.
    pub fn reach(&self) -> [f64; 2] {
        room::reach(self.radius)
    }

    /// Returns the drift at a position.
    pub fn drift_at(&self, position: Position) -> [f64; 2] {
        self.drift[zone(position)]
    }

    /// Returns the position after a step with an action, which is clipped to -1 ..= 1.
    pub fn advance(&self, from: Position, action: [f32; 2]) -> Position {
        let [low, high] = self.reach().map(|v| v as f32);
        let drift = self.drift_at(from);
        std::array::from_fn(|i| {
            (from[i] + action[i].clamp(-1.0, 1.0) * self.speed as f32 + drift[i] as f32).clamp(low, high)
        })
    }

    /// Returns the action that leads nearest to `to`: it compensates the drift, on each axis as far as the agent's
    /// speed allows.
    pub fn steer(&self, from: Position, to: Position) -> [f32; 2] {
        let drift = self.drift_at(from);
        std::array::from_fn(|i| {
            let wanted = f64::from(to[i]) - f64::from(from[i]) - drift[i];
            (wanted / self.speed).clamp(-1.0, 1.0) as f32
        })
    }
}

/// Returns the zone of a position; positions in the border belong to the nearest zone.
fn zone(position: Position) -> usize {
    let [column, row] = position.map(|v| {
        let cells = (f64::from(v) - BORDER) / (SIZE - 2.0 * BORDER) * GRID as f64;
        (cells as usize).min(GRID - 1)
    });
    row * GRID + column
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::point_agent::room::distance;

    fn dynamics() -> Dynamics {
        Dynamics { radius: 7.0, speed: 5.0, drift: [[2.0, 0.0], [0.0, 3.0], [-1.0, 0.5], [-4.0, -4.0]] }
    }

    #[test]
    fn every_zone_has_its_own_drift() {
        for (from, to) in [
            ([50.0, 50.0], [57.0, 50.0]),
            ([112.0, 111.9], [117.0, 114.9]),
            ([111.9, 112.0], [115.9, 112.5]),
            ([150.0, 150.0], [151.0, 146.0]),
            ([14.0, 14.0], [21.0, 21.0]),
        ] {
            assert_eq!(dynamics().advance(from, [1.0, 0.0]), to);
        }
    }

    #[test]
    fn agent_stays_within_the_border_and_actions_are_clipped() {
        assert_eq!(dynamics().advance([22.0, 200.0], [-9.0, 9.0]), [21.0, 203.0]);
    }

    #[test]
    fn steering_compensates_the_drift() {
        for from in [[50.0, 50.0], [150.0, 50.0], [50.0, 150.0], [150.0, 150.0]] {
            let to = [from[0] + 0.5, from[1] - 0.75];
            assert!(distance(dynamics().advance(from, dynamics().steer(from, to)), to) < 1e-4, "from {from:?}");
        }
    }

    #[test]
    fn dynamics_column_round_trips() {
        let row: Vec<f64> = dynamics().to_row().iter().map(|&v| f64::from(v)).collect();
        assert_eq!(Dynamics::from_row(&row), dynamics());
    }
}
