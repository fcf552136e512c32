//! The dynamics: a disc moves by `action * speed`, stays where it is when it would touch a wall, and is held inside the
//! square.
//!
//! Constants and the order of the checks are the reference's (`simple_point_maze.py`); so is single precision. Only the
//! end of a step is checked, and before it is held inside: a step may jump a corner, and one that ends outside of the
//! square may be put back into a wall that touches the border. Lengths are in units of the world, y up.

/// Side of the square world.
pub const SIZE: f32 = 5.0;
/// The most walls there can be.
pub const MAX_WALLS: usize = 6;
/// Actions are cut to this along each axis.
pub const MAX_ACTION: f32 = 0.2;

/// A place: x to the right, y up.
pub type Point = [f32; 2];

/// A rectangle between two corners.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Wall {
    /// The least coordinates.
    pub low: Point,
    /// The greatest coordinates.
    pub high: Point,
}

impl Wall {
    /// The square of the distance to a place; 0 inside.
    fn distance_squared(&self, place: Point) -> f32 {
        let [dx, dy] = [0, 1].map(|i| place[i].clamp(self.low[i], self.high[i]) - place[i]);
        dx * dx + dy * dy
    }
}

/// What an episode's world is like, as far as moving in it goes.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Layout {
    walls: [Wall; MAX_WALLS],
    count: usize,
    /// The agent's radius.
    pub radius: f32,
    /// How much of its action the agent moves.
    pub speed: f32,
}

impl Layout {
    /// Numbers in a row of the `layout` column.
    pub const LEN: usize = 2 + 4 * MAX_WALLS;

    /// A world of these walls; those beyond [`MAX_WALLS`] are left out.
    pub fn new(radius: f32, speed: f32, walls: impl IntoIterator<Item = Wall>) -> Self {
        let mut layout = Self { radius, speed, ..Self::default() };
        for (place, wall) in layout.walls.iter_mut().zip(walls) {
            *place = wall;
            layout.count += 1;
        }
        layout
    }

    /// The walls.
    pub fn walls(&self) -> &[Wall] {
        &self.walls[..self.count]
    }

    /// The `layout` column: radius, speed, then the least and greatest x and y of every wall.
    pub fn to_row(self) -> [f32; Self::LEN] {
        let mut row = [0.0; Self::LEN];
        (row[0], row[1]) = (self.radius, self.speed);
        for (place, wall) in row[2..].as_chunks_mut::<4>().0.iter_mut().zip(self.walls()) {
            *place = [wall.low[0], wall.low[1], wall.high[0], wall.high[1]];
        }
        row
    }

    /// Reads what [`Layout::to_row`] wrote.
    #[allow(clippy::cast_possible_truncation)]
    pub fn from_row(row: &[f64]) -> Self {
        let numbers = |wall: &[f64; 4]| wall.map(|v| v as f32);
        let walls = row[2..].as_chunks::<4>().0.iter().map(numbers);
        let walls =
            walls.map(|[a, b, c, d]| Wall { low: [a, b], high: [c, d] }).filter(|&wall| wall != Wall::default());
        Self::new(row[0] as f32, row[1] as f32, walls)
    }

    /// Whether a disc touches a wall.
    pub fn touches(&self, center: Point, radius: f32) -> bool {
        self.walls().iter().any(|wall| wall.distance_squared(center) <= radius * radius)
    }

    /// Where an action takes the agent.
    pub fn advance(&self, from: Point, action: Point) -> Point {
        let next: Point = std::array::from_fn(|i| from[i] + self.speed * action[i].clamp(-MAX_ACTION, MAX_ACTION));
        let next = if self.touches(next, self.radius) { from } else { next };
        next.map(|v| v.clamp(0.0, SIZE))
    }
}

/// The distance between two places, in single precision.
pub fn distance(a: Point, b: Point) -> f32 {
    let [dx, dy] = [a[0] - b[0], a[1] - b[1]];
    (dx * dx + dy * dy).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn world() -> Layout {
        Layout::new(0.1, 1.0, [Wall { low: [2.0, 2.0], high: [3.0, 3.5] }, Wall { low: [0.05, 4.0], high: [1.0, 5.0] }])
    }

    #[test]
    fn walls_stop_the_disc_and_the_border_holds_it() {
        let world = world();
        assert_eq!(world.advance([1.8, 2.5], [0.05, 0.05]), [1.8499999, 2.55], "free");
        assert_eq!(world.advance([1.8, 2.5], [0.15, 0.0]), [1.8, 2.5], "its rim would touch");
        assert_eq!(world.advance([1.8, 1.8], [0.12, 0.12]), [1.92, 1.92], "the corner leaves room for a round disc");
        assert_eq!(world.advance([1.8, 1.8], [0.14, 0.14]), [1.8, 1.8], "but not for more");
        assert_eq!(world.advance([0.1, 0.1], [-0.2, 0.9]), [0.0, 0.3], "held, and actions are cut");
    }

    #[test]
    fn a_step_out_of_the_square_slips_past_walls_at_its_border() {
        // As in the reference: the end of the step is outside, clear of the wall, and is then put back inside.
        assert_eq!(world().advance([0.0, 3.8], [-0.2, 0.2]), [0.0, 4.0]);
        assert_eq!(world().advance([0.0, 3.8], [0.0, 0.2]), [0.0, 3.8]);
    }

    #[test]
    fn a_layout_survives_its_column() {
        let row: Vec<f64> = world().to_row().iter().map(|&v| f64::from(v)).collect();
        assert_eq!(Layout::from_row(&row), world());
    }
}
