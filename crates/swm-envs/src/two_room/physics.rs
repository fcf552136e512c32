//! The dynamics: a disc moves by `action * speed`, is held inside the border, and is pushed back from the wall
//! between the rooms unless its centre passes through a door.
//!
//! Constants and the order of the checks are those of the reference (`two_room/env.py`). Positions are in single
//! precision as in the reference, so that rollouts agree to the last bit. Lengths are in pixels of the 224-pixel frame.

use crate::point_agent::Position;
use crate::point_agent::room;

/// Coordinate of the centre line of the wall, on the axis across it, in pixels.
pub const WALL_CENTER: f64 = 112.0;
/// Distance beyond the edge of a door within which the agent's centre can still pass, in pixels.
const DOOR_MARGIN: f64 = 1.75;
/// Gap between the agent and the wall after the agent was pushed back, in pixels.
const PUSH_BACK: f64 = 0.5;
/// The maximal number of doors.
pub const MAX_DOORS: usize = 3;

/// The parameters of the agent's motion in an episode. Lengths are in pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Layout {
    /// The axis that crosses the wall: 0 (x) for a vertical wall, 1 (y) for a horizontal wall.
    pub across: usize,
    /// Half the wall's thickness.
    pub half_thickness: f64,
    /// The agent's radius.
    pub radius: f64,
    /// Distance per step of an action component of 1.
    pub speed: f64,
    /// For each door, the interval along the wall in which the agent's centre may pass. Absent doors are `[0, 0]`.
    pub doors: [[f64; 2]; MAX_DOORS],
}

impl Layout {
    /// Values in a row of the `layout` column.
    pub const LEN: usize = 4 + 2 * MAX_DOORS;

    /// Returns the interval in which a door of half-width `size` at `center` lets the agent's centre pass.
    pub fn opening(center: f64, size: f64) -> [f64; 2] {
        [center - size - DOOR_MARGIN, center + size + DOOR_MARGIN]
    }

    /// Returns the `layout` column: the axis across the wall, half its thickness, radius, speed, then the interval of
    /// every door.
    pub fn to_row(self) -> [f32; Self::LEN] {
        let [[a, b], [c, d], [e, f]] = self.doors;
        [self.across as f64, self.half_thickness, self.radius, self.speed, a, b, c, d, e, f].map(|v| v as f32)
    }

    /// Reads a `layout` column, `[LEN]` values.
    pub fn from_row(row: &[f64]) -> Self {
        Self {
            across: usize::from(row[0] != 0.0),
            half_thickness: row[1],
            radius: row[2],
            speed: row[3],
            doors: std::array::from_fn(|i| [row[4 + 2 * i], row[5 + 2 * i]]),
        }
    }

    /// Returns the least and the greatest coordinate of the agent's centre.
    pub fn reach(&self) -> [f64; 2] {
        room::reach(self.radius)
    }

    /// Returns the distance between the wall's centre line and the agent's centre at which the agent touches the wall.
    pub fn contact_depth(&self) -> f64 {
        self.half_thickness + self.radius
    }

    /// Returns whether an agent with its centre at `p` touches neither the border nor the wall.
    pub fn is_free(&self, p: Position) -> bool {
        let [low, high] = self.reach();
        let inside = p.iter().all(|&v| (low..=high).contains(&f64::from(v)));
        inside && (f64::from(p[self.across]) - WALL_CENTER).abs() > self.contact_depth()
    }

    /// Returns the position after a step with an action, which is clipped to -1 ..= 1.
    pub fn advance(&self, from: Position, action: [f32; 2]) -> Position {
        let [low, high] = self.reach();
        let mut to: Position = std::array::from_fn(|i| {
            let next = from[i] + action[i].clamp(-1.0, 1.0) * self.speed as f32;
            f64::from(next).clamp(low, high) as f32
        });
        let (across, along) = (f64::from(to[self.across]), f64::from(to[1 - self.across]));
        let in_door = self.doors.iter().any(|&[first, last]| (first..=last).contains(&along));
        if !in_door {
            // The agent's side of the wall is that at the start of the step, so that a fast agent is put back into its
            // own room.
            let (low, high) = (WALL_CENTER - self.contact_depth(), WALL_CENTER + self.contact_depth());
            if f64::from(from[self.across]) < WALL_CENTER {
                if across > low {
                    to[self.across] = (low - PUSH_BACK) as f32;
                }
            } else if across < high {
                to[self.across] = (high + PUSH_BACK) as f32;
            }
        }
        to
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn layout(across: usize) -> Layout {
        let doors = [Layout::opening(49.0, 14.0), [0.0; 2], [0.0; 2]];
        Layout { across, half_thickness: 5.0, radius: 7.0, speed: 5.0, doors }
    }

    #[test]
    fn wall_stops_the_agent_except_in_a_door() {
        for (across, flip) in [(0, false), (1, true)] {
            let at = |x: f32, y: f32| if flip { [y, x] } else { [x, y] };
            let layout = layout(across);
            assert_eq!(
                layout.advance(at(98.0, 150.0), at(1.0, 0.0)),
                at(99.5, 150.0),
                "the wall stops the agent from the left"
            );
            assert_eq!(
                layout.advance(at(126.0, 150.0), at(-1.0, 0.0)),
                at(124.5, 150.0),
                "the wall stops the agent from the right"
            );
            assert_eq!(layout.advance(at(98.0, 49.0), at(1.0, 0.0)), at(103.0, 49.0), "the agent passes the door");
            assert_eq!(layout.advance(at(22.0, 150.0), at(-1.0, 0.0)), at(21.0, 150.0), "the border stops the agent");
        }
    }

    #[test]
    fn actions_are_clipped() {
        let layout = layout(0);
        assert_eq!(layout.advance([50.0, 50.0], [9.0, -9.0]), layout.advance([50.0, 50.0], [1.0, -1.0]));
    }

    #[test]
    fn layout_column_round_trips() {
        let layout = layout(1);
        let row: Vec<f64> = layout.to_row().iter().map(|&v| f64::from(v)).collect();
        assert_eq!(Layout::from_row(&row), layout);
    }
}
