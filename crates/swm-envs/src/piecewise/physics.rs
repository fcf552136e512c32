//! The dynamics: a disc moves by `action * speed` and by the drift of the zone it is in, and is held inside the border.
//!
//! Constants are the reference's (`piecewise/piecewise_env.py`); so is single precision for positions. Lengths are in
//! pixels of the 224-pixel world.

/// Side of the square world.
pub const SIZE: f64 = 224.0;
/// Where the room begins: the border takes this much on every side.
pub const BORDER: f64 = 14.0;
/// Zones along a side of the room.
pub const GRID: usize = 2;
/// Zones, numbered row by row.
pub const ZONES: usize = GRID * GRID;
/// Nearer to the target than this, the episode is over.
pub const GOAL_RADIUS: f32 = 16.0;

/// A place: x to the right, y down.
pub type Point = [f32; 2];

/// How an episode's world moves what is in it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Dynamics {
    /// The agent's radius.
    pub radius: f64,
    /// How far a step with action 1 goes.
    pub speed: f64,
    /// What each zone adds to every step.
    pub drift: [[f64; 2]; ZONES],
}

impl Dynamics {
    /// Numbers in a row of the `dynamics` column.
    pub const LEN: usize = 2 + 2 * ZONES;

    /// The `dynamics` column: radius, speed, then the drift of every zone.
    #[allow(clippy::cast_possible_truncation)]
    pub fn to_row(self) -> [f32; Self::LEN] {
        let mut row = [0.0; Self::LEN];
        let numbers = [self.radius, self.speed].into_iter().chain(self.drift.into_iter().flatten());
        row.iter_mut().zip(numbers).for_each(|(to, from)| *to = from as f32);
        row
    }

    /// Reads what [`Dynamics::to_row`] wrote.
    pub fn from_row(row: &[f64]) -> Self {
        Self { radius: row[0], speed: row[1], drift: std::array::from_fn(|i| [row[2 + 2 * i], row[3 + 2 * i]]) }
    }

    /// The least and the greatest coordinate the agent's centre can have.
    pub fn reach(&self) -> [f64; 2] {
        [BORDER + self.radius, SIZE - BORDER - self.radius]
    }

    /// The drift at a place.
    pub fn drift_at(&self, place: Point) -> [f64; 2] {
        self.drift[zone(place)]
    }

    /// Where an action, clipped to -1 ..= 1, takes the agent.
    #[allow(clippy::cast_possible_truncation)]
    pub fn advance(&self, from: Point, action: Point) -> Point {
        let [low, high] = self.reach().map(|v| v as f32);
        let drift = self.drift_at(from);
        std::array::from_fn(|i| {
            (from[i] + action[i].clamp(-1.0, 1.0) * self.speed as f32 + drift[i] as f32).clamp(low, high)
        })
    }

    /// The action that leads nearest to `to`: it makes up for the drift, each axis as far as the agent is strong enough.
    #[allow(clippy::cast_possible_truncation)]
    pub fn steer(&self, from: Point, to: Point) -> Point {
        let drift = self.drift_at(from);
        std::array::from_fn(|i| {
            let wanted = f64::from(to[i]) - f64::from(from[i]) - drift[i];
            (wanted / self.speed).clamp(-1.0, 1.0) as f32
        })
    }
}

/// The zone of a place; places in the border belong to the nearest one.
#[allow(clippy::cast_possible_truncation, clippy::cast_precision_loss, clippy::cast_sign_loss)]
fn zone(place: Point) -> usize {
    let [column, row] = place.map(|v| {
        let cells = (f64::from(v) - BORDER) / (SIZE - 2.0 * BORDER) * GRID as f64;
        (cells as usize).min(GRID - 1)
    });
    row * GRID + column
}

/// The distance between two places, in single precision and with one rounding fewer (a fused sum of squares), as
/// the reference's `torch.norm` decides the termination.
pub fn distance(a: Point, b: Point) -> f32 {
    let [dx, dy] = [a[0] - b[0], a[1] - b[1]];
    dy.mul_add(dy, dx * dx).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn world() -> Dynamics {
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
            assert_eq!(world().advance(from, [1.0, 0.0]), to);
        }
    }

    #[test]
    fn the_border_holds_and_actions_are_clipped() {
        assert_eq!(world().advance([22.0, 200.0], [-9.0, 9.0]), [21.0, 203.0]);
    }

    #[test]
    fn steering_makes_up_for_the_drift() {
        for from in [[50.0, 50.0], [150.0, 50.0], [50.0, 150.0], [150.0, 150.0]] {
            let to = [from[0] + 0.5, from[1] - 0.75];
            assert!(distance(world().advance(from, world().steer(from, to)), to) < 1e-4, "from {from:?}");
        }
    }

    #[test]
    fn dynamics_survive_their_column() {
        let row: Vec<f64> = world().to_row().iter().map(|&v| f64::from(v)).collect();
        assert_eq!(Dynamics::from_row(&row), world());
    }
}
