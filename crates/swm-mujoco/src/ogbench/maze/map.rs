//! The maps of the mazes with their tasks, and shortest paths through them. Maps and tasks are OGBench's
//! (`locomaze/maze.py`).

use std::collections::VecDeque;

/// Side of a cell, in metres.
pub const UNIT: f64 = 4.0;
/// Radius of a teleport, in metres.
pub const TELEPORT_RADIUS: f64 = 1.0;
/// Distance of the first cell's centre from the origin along both axes, in the negative direction, in metres.
const OFFSET: f64 = 4.0;

/// A point in the plane, in metres.
pub type Xy = [f64; 2];
/// The row and the column of a cell.
pub type Cell = (usize, usize);

/// The map of a maze.
pub struct Map {
    /// The name, a value of the option `maze_type`.
    pub name: &'static str,
    /// Rows of cells; `#` is a wall, `.` is free.
    pub rows: &'static [&'static str],
    /// Start and goal cell of each task.
    pub tasks: &'static [(Cell, Cell)],
    /// Entrance cells and exit cells of teleports.
    pub teleports: (&'static [Cell], &'static [Cell]),
}

/// Every maze; the first is the default.
pub static MAPS: [Map; 5] = [
    Map {
        name: "large",
        rows: &[
            "############",
            "#....#.....#",
            "#.##.#.#.#.#",
            "#......#...#",
            "#.####.###.#",
            "#..#.#.....#",
            "##.#.#.#.###",
            "#..#...#...#",
            "############",
        ],
        tasks: &[((1, 1), (7, 10)), ((5, 4), (7, 1)), ((7, 4), (1, 10)), ((3, 8), (5, 4)), ((1, 1), (5, 4))],
        teleports: (&[], &[]),
    },
    Map {
        name: "arena",
        rows: &["########", "#......#", "#......#", "#......#", "#......#", "#......#", "#......#", "########"],
        tasks: &[((1, 1), (6, 6))],
        teleports: (&[], &[]),
    },
    Map {
        name: "medium",
        rows: &["########", "#..##..#", "#..#...#", "##...###", "#..#...#", "#.#..#.#", "#...#..#", "########"],
        tasks: &[((1, 1), (6, 6)), ((6, 1), (1, 6)), ((5, 3), (4, 2)), ((6, 5), (6, 1)), ((2, 6), (1, 1))],
        teleports: (&[], &[]),
    },
    Map {
        name: "giant",
        rows: &[
            "################",
            "#.#......##....#",
            "#.#.##.#.#..##.#",
            "#...#..#...#...#",
            "#.###.######.#.#",
            "#...#...#....#.#",
            "###.#.#..#.#.###",
            "#...#..#...#...#",
            "#.#.#.######.#.#",
            "#.###...#...##.#",
            "#.....#...#....#",
            "################",
        ],
        tasks: &[((1, 1), (10, 14)), ((1, 14), (10, 1)), ((8, 14), (1, 1)), ((8, 3), (5, 12)), ((5, 9), (3, 8))],
        teleports: (&[], &[]),
    },
    Map {
        name: "teleport",
        rows: &[
            "############",
            "#.....#.#..#",
            "##.#...#..##",
            "##.###.....#",
            "#....#.#.#.#",
            "#.##.#.#.#.#",
            "#.##.#.#.#.#",
            "#....#...#.#",
            "############",
        ],
        tasks: &[((1, 10), (7, 1)), ((1, 1), (7, 10)), ((5, 6), (7, 10)), ((7, 1), (7, 10)), ((5, 6), (7, 1))],
        teleports: (&[(4, 6), (5, 1)], &[(1, 7), (6, 1), (6, 10)]),
    },
];

/// The centre of a cell, in metres.
pub fn center((row, column): Cell) -> Xy {
    [column as f64 * UNIT - OFFSET, row as f64 * UNIT - OFFSET]
}

/// The distance of two points, in metres.
pub fn distance(a: Xy, b: Xy) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

impl Map {
    /// The counts of columns and rows, as floating-point values.
    pub fn extent(&self) -> [f64; 2] {
        let (rows, columns) = self.size();
        [columns as f64, rows as f64]
    }

    /// The target point of OGBench's camera, in metres.
    pub fn camera_center(&self) -> Xy {
        self.extent().map(|cells| 2.0 * (cells - 3.0))
    }

    /// The number of rows and columns.
    pub fn size(&self) -> (usize, usize) {
        (self.rows.len(), self.rows[0].len())
    }

    /// Every cell, row by row.
    pub fn cells(&self) -> impl Iterator<Item = Cell> {
        let (rows, columns) = self.size();
        (0..rows).flat_map(move |row| (0..columns).map(move |column| (row, column)))
    }

    /// Whether a cell is inside the map and not a wall.
    pub fn is_free(&self, (row, column): Cell) -> bool {
        self.rows.get(row).and_then(|cells| cells.as_bytes().get(column)) == Some(&b'.')
    }

    /// The cell of a point; the nearest cell for a point outside the map.
    pub fn cell(&self, [x, y]: Xy) -> Cell {
        let (rows, columns) = self.size();
        let at = |v: f64, n: usize| (((v + OFFSET) / UNIT + 0.5).max(0.0) as usize).min(n - 1);
        (at(y, rows), at(x, columns))
    }

    /// The free cells among a cell and its four neighbours, in this order.
    fn neighbours(&self, (row, column): Cell) -> impl Iterator<Item = Cell> {
        let offsets = [(0, 0), (-1, 0), (0, -1), (1, 0), (0, 1)];
        let step = move |(i, j): (isize, isize)| Some((row.checked_add_signed(i)?, column.checked_add_signed(j)?));
        offsets.into_iter().filter_map(step).filter(|&cell| self.is_free(cell))
    }
}

/// Shortest paths to a goal.
pub struct ShortestPaths {
    map: &'static Map,
    goal: Xy,
    /// Steps from each cell to the goal's cell; `None` where there is no path.
    steps: Vec<Option<u16>>,
}

impl ShortestPaths {
    /// The shortest paths to a point.
    pub fn new(map: &'static Map, goal: Xy) -> Self {
        let (rows, columns) = map.size();
        let mut paths = Self { map, goal, steps: vec![None; rows * columns] };
        paths.set_goal(goal);
        paths
    }

    /// Changes the goal and recomputes the paths by breadth-first search.
    pub fn set_goal(&mut self, goal: Xy) {
        self.goal = goal;
        self.steps.fill(None);
        let start = self.map.cell(goal);
        let mut next = VecDeque::from([(start, 0)]);
        while let Some((cell, steps)) = next.pop_front() {
            let index = self.index(cell);
            if self.steps[index].is_none() {
                self.steps[index] = Some(steps);
                next.extend(self.map.neighbours(cell).map(|neighbour| (neighbour, steps + 1)));
            }
        }
    }

    fn index(&self, (row, column): Cell) -> usize {
        row * self.map.size().1 + column
    }

    /// Whether there is a path from a point to the goal.
    pub fn is_reachable(&self, from: Xy) -> bool {
        self.steps[self.index(self.map.cell(from))].is_some()
    }

    /// The next point on the path: the goal if `from` is in the goal's cell, otherwise the centre of the neighbouring
    /// cell nearest to the goal.
    pub fn next(&self, from: Xy) -> Xy {
        let cell = self.map.cell(from);
        if cell == self.map.cell(self.goal) {
            return self.goal;
        }
        let steps = |&cell: &Cell| self.steps[self.index(cell)].unwrap_or(u16::MAX);
        self.map.neighbours(cell).min_by_key(steps).map_or(self.goal, center)
    }

    /// The length of the path through the centres of cells, in metres.
    pub fn length(&self, from: Xy) -> f64 {
        let cell = self.map.cell(from);
        if cell == self.map.cell(self.goal) {
            return distance(from, self.goal);
        }
        let last = distance(center(self.map.cell(self.goal)), self.goal);
        let through = |cell: Cell| {
            let steps = self.steps[self.index(cell)]?;
            Some(distance(from, center(cell)) + UNIT * f64::from(steps) + last)
        };
        let lengths = self.map.neighbours(cell).filter_map(through);
        lengths.min_by(f64::total_cmp).unwrap_or_else(|| distance(from, self.goal))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_task_has_a_path() {
        for map in &MAPS {
            assert!(map.rows.iter().all(|row| row.len() == map.size().1), "{}", map.name);
            for &(start, goal) in map.tasks {
                assert!(map.is_free(start) && map.is_free(goal), "{}: {start:?} to {goal:?}", map.name);
                let paths = ShortestPaths::new(map, center(goal));
                let (mut at, mut left) = (center(start), paths.length(center(start)));
                assert!(paths.is_reachable(at), "{}: {start:?} to {goal:?}", map.name);
                while at != center(goal) {
                    at = paths.next(at);
                    assert!(paths.length(at) < left, "{}: the path must get shorter with every cell", map.name);
                    left = paths.length(at);
                }
                assert_eq!(left, 0.0);
            }
        }
    }

    #[test]
    fn points_map_to_the_cell_that_contains_them() {
        let map = &MAPS[0];
        for cell in map.cells() {
            let [x, y] = center(cell);
            assert_eq!(map.cell([x + 1.9, y - 1.9]), cell);
        }
        assert_eq!(map.cell([-99.0, 99.0]), (8, 0));
    }
}
