//! The dynamics: a disc moves by `action * speed`, is held inside the border, and is pushed back from the wall
//! between the rooms unless its centre passes through a door.
//!
//! Constants and the order of the checks are the reference's (`two_room/env.py`); so is single precision for
//! positions, which makes rollouts agree to the last bits. Lengths are in pixels of the 224-pixel world.

/// Side of the square world.
pub const SIZE: f64 = 224.0;
/// Where the rooms begin: the border takes this much on every side.
pub const BORDER: f64 = 14.0;
/// The middle of the wall, on the axis it crosses.
pub const CENTER: f64 = 112.0;
/// Nearer to the target than this, the episode is over.
pub const GOAL_RADIUS: f32 = 16.0;
/// How far the agent's centre may be beside a door's opening and still pass.
const DOOR_MARGIN: f64 = 1.75;
/// How far from touching the wall the agent is put back.
const PUSH_BACK: f64 = 0.5;
/// The most doors there can be.
pub const MAX_DOORS: usize = 3;

/// A place: x to the right, y down.
pub type Point = [f32; 2];

/// What an episode's world is like, as far as moving in it goes.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Layout {
    /// The coordinate one changes to get from room to room: 0 (x) for a vertical wall, 1 (y) for a horizontal.
    pub across: usize,
    /// Half the wall's thickness.
    pub half: f64,
    /// The agent's radius.
    pub radius: f64,
    /// How far a step with action 1 goes.
    pub speed: f64,
    /// The doors: where along the wall the agent's centre may pass, first and last place. Absent doors are 0, 0.
    pub doors: [[f64; 2]; MAX_DOORS],
}

impl Layout {
    /// Numbers in a row of the `layout` column.
    pub const LEN: usize = 4 + 2 * MAX_DOORS;

    /// Where a door of half-width `size` at `center` lets the agent's centre pass.
    pub fn door(center: f64, size: f64) -> [f64; 2] {
        [center - size - DOOR_MARGIN, center + size + DOOR_MARGIN]
    }

    /// The `layout` column: axis across the wall, half thickness, radius, speed, then first and last place of
    /// every door.
    #[allow(clippy::cast_possible_truncation, clippy::cast_precision_loss)]
    pub fn to_row(self) -> [f32; Self::LEN] {
        let [[a, b], [c, d], [e, f]] = self.doors;
        [self.across as f64, self.half, self.radius, self.speed, a, b, c, d, e, f].map(|v| v as f32)
    }

    /// Reads what [`Layout::to_row`] wrote.
    pub fn from_row(row: &[f64]) -> Self {
        Self {
            across: usize::from(row[0] != 0.0),
            half: row[1],
            radius: row[2],
            speed: row[3],
            doors: std::array::from_fn(|i| [row[4 + 2 * i], row[5 + 2 * i]]),
        }
    }

    /// The least and the greatest coordinate the agent's centre can have.
    pub fn reach(&self) -> [f64; 2] {
        [BORDER + self.radius, SIZE - BORDER - self.radius]
    }

    /// How near to the wall's middle the agent's centre comes when it touches the wall.
    pub fn touch(&self) -> f64 {
        self.half + self.radius
    }

    /// Whether the agent's centre at `p` is clear of the border and of the wall.
    pub fn is_free(&self, p: Point) -> bool {
        let [low, high] = self.reach();
        let inside = p.iter().all(|&v| (low..=high).contains(&f64::from(v)));
        inside && (f64::from(p[self.across]) - CENTER).abs() > self.touch()
    }

    /// Where an action, clipped to -1 ..= 1, takes the agent.
    #[allow(clippy::cast_possible_truncation)]
    pub fn advance(&self, from: Point, action: Point) -> Point {
        let [low, high] = self.reach();
        let mut to: Point = std::array::from_fn(|i| {
            let next = from[i] + action[i].clamp(-1.0, 1.0) * self.speed as f32;
            f64::from(next).clamp(low, high) as f32
        });
        let (across, along) = (f64::from(to[self.across]), f64::from(to[1 - self.across]));
        let in_door = self.doors.iter().any(|&[first, last]| (first..=last).contains(&along));
        if !in_door {
            // The side counts from where the step began, so a fast agent is put back to its own room.
            let (low, high) = (CENTER - self.touch(), CENTER + self.touch());
            if f64::from(from[self.across]) < CENTER {
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

/// The distance between two places, in single precision and with one rounding fewer (a fused sum of squares), as
/// the reference's `torch.norm` decides the termination.
pub fn distance(a: Point, b: Point) -> f32 {
    let [dx, dy] = [a[0] - b[0], a[1] - b[1]];
    dy.mul_add(dy, dx * dx).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn layout(across: usize) -> Layout {
        let doors = [Layout::door(49.0, 14.0), [0.0; 2], [0.0; 2]];
        Layout { across, half: 5.0, radius: 7.0, speed: 5.0, doors }
    }

    #[test]
    fn the_wall_stops_and_the_door_lets_pass() {
        for (across, flip) in [(0, false), (1, true)] {
            let at = |x: f32, y: f32| if flip { [y, x] } else { [x, y] };
            let world = layout(across);
            assert_eq!(world.advance(at(98.0, 150.0), at(1.0, 0.0)), at(99.5, 150.0), "pushed back from the left");
            assert_eq!(world.advance(at(126.0, 150.0), at(-1.0, 0.0)), at(124.5, 150.0), "and from the right");
            assert_eq!(world.advance(at(98.0, 49.0), at(1.0, 0.0)), at(103.0, 49.0), "through the door");
            assert_eq!(world.advance(at(22.0, 150.0), at(-1.0, 0.0)), at(21.0, 150.0), "held by the border");
        }
    }

    #[test]
    fn actions_are_clipped() {
        let world = layout(0);
        assert_eq!(world.advance([50.0, 50.0], [9.0, -9.0]), world.advance([50.0, 50.0], [1.0, -1.0]));
    }

    #[test]
    fn a_layout_survives_its_column() {
        let world = layout(1);
        let row: Vec<f64> = world.to_row().iter().map(|&v| f64::from(v)).collect();
        assert_eq!(Layout::from_row(&row), world);
    }
}
