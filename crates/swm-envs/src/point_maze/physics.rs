//! The dynamics: a disc moves by `action * speed` unless it would touch a wall, and is held inside the
//! square.
//!
//! Constants, the order of the checks and the single precision are those of the reference (`simple_point_maze.py`).
//! Only the end of a step is checked, and this happens before the end is clipped to the square: a step may jump over a
//! corner, and a step that ends outside the square may be clipped into a wall at the border. Lengths are in maze units,
//! y up.

use crate::point_agent::Position;

/// Side of the square maze, in maze units.
pub const SIZE: f32 = 5.0;
/// The maximal number of walls.
pub const MAX_WALLS: usize = 6;
/// The largest action component; larger components are clipped.
pub const MAX_ACTION: f32 = 0.2;

/// A rectangular wall.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Wall {
    /// The least x and y, in maze units.
    pub low: Position,
    /// The greatest x and y, in maze units.
    pub high: Position,
}

impl Wall {
    /// Returns the squared distance to a position; 0 inside.
    fn distance_squared(&self, position: Position) -> f32 {
        let [dx, dy] = [0, 1].map(|i| position[i].clamp(self.low[i], self.high[i]) - position[i]);
        dx * dx + dy * dy
    }
}

/// The parameters of the agent's motion in an episode. Lengths are in maze units.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Layout {
    walls: [Wall; MAX_WALLS],
    count: usize,
    /// The agent's radius.
    pub radius: f32,
    /// Distance per step of an action component of 1.
    pub speed: f32,
}

impl Layout {
    /// Values in a row of the `layout` column.
    pub const LEN: usize = 2 + 4 * MAX_WALLS;

    /// Makes a layout of the first [`MAX_WALLS`] of these walls.
    pub fn new(radius: f32, speed: f32, walls: impl IntoIterator<Item = Wall>) -> Self {
        let mut layout = Self { radius, speed, ..Self::default() };
        for (slot, wall) in layout.walls.iter_mut().zip(walls) {
            *slot = wall;
            layout.count += 1;
        }
        layout
    }

    /// The walls.
    pub fn walls(&self) -> &[Wall] {
        &self.walls[..self.count]
    }

    /// Returns the `layout` column: radius, speed, then the least and the greatest x and y of every wall.
    pub fn to_row(self) -> [f32; Self::LEN] {
        let mut row = [0.0; Self::LEN];
        (row[0], row[1]) = (self.radius, self.speed);
        for (slot, wall) in row[2..].as_chunks_mut::<4>().0.iter_mut().zip(self.walls()) {
            *slot = [wall.low[0], wall.low[1], wall.high[0], wall.high[1]];
        }
        row
    }

    /// Reads a `layout` column, `[LEN]` values.
    pub fn from_row(row: &[f64]) -> Self {
        let walls = row[2..].as_chunks::<4>().0.iter().map(|wall| wall.map(|v| v as f32));
        let walls =
            walls.map(|[a, b, c, d]| Wall { low: [a, b], high: [c, d] }).filter(|&wall| wall != Wall::default());
        Self::new(row[0] as f32, row[1] as f32, walls)
    }

    /// Returns whether a disc touches a wall.
    pub fn touches(&self, center: Position, radius: f32) -> bool {
        self.walls().iter().any(|wall| wall.distance_squared(center) <= radius * radius)
    }

    /// Returns the position after a step with an action, which is clipped.
    pub fn advance(&self, from: Position, action: [f32; 2]) -> Position {
        let next: Position = std::array::from_fn(|i| from[i] + self.speed * action[i].clamp(-MAX_ACTION, MAX_ACTION));
        let next = if self.touches(next, self.radius) { from } else { next };
        next.map(|v| v.clamp(0.0, SIZE))
    }
}

/// Returns the Euclidean distance between two positions, in single precision.
pub fn distance(a: Position, b: Position) -> f32 {
    let [dx, dy] = [a[0] - b[0], a[1] - b[1]];
    (dx * dx + dy * dy).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn layout() -> Layout {
        Layout::new(0.1, 1.0, [Wall { low: [2.0, 2.0], high: [3.0, 3.5] }, Wall { low: [0.05, 4.0], high: [1.0, 5.0] }])
    }

    #[test]
    fn walls_stop_the_disc_and_positions_are_clipped_to_the_square() {
        let layout = layout();
        assert_eq!(layout.advance([1.8, 2.5], [0.05, 0.05]), [1.8499999, 2.55], "no wall is near");
        assert_eq!(layout.advance([1.8, 2.5], [0.15, 0.0]), [1.8, 2.5], "the rim of the disc would touch the wall");
        assert_eq!(layout.advance([1.8, 1.8], [0.12, 0.12]), [1.92, 1.92], "a round disc fits beside the corner");
        assert_eq!(layout.advance([1.8, 1.8], [0.14, 0.14]), [1.8, 1.8], "the disc would touch the corner");
        assert_eq!(layout.advance([0.1, 0.1], [-0.2, 0.9]), [0.0, 0.3], "position and action are clipped");
    }

    #[test]
    fn step_out_of_the_square_may_end_in_a_wall_at_the_border() {
        // As in the reference: the end of the step is outside, clear of the wall, and is then clipped.
        assert_eq!(layout().advance([0.0, 3.8], [-0.2, 0.2]), [0.0, 4.0]);
        assert_eq!(layout().advance([0.0, 3.8], [0.0, 0.2]), [0.0, 3.8]);
    }

    #[test]
    fn layout_column_round_trips() {
        let row: Vec<f64> = layout().to_row().iter().map(|&v| f64::from(v)).collect();
        assert_eq!(Layout::from_row(&row), layout());
    }
}
