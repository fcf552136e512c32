//! The mazes, their tasks, and the way through them.

use std::collections::VecDeque;

/// Side of a cell, in metres.
pub const UNIT: f64 = 4.0;
/// How far the centre of the first cell is from the origin, back along both axes.
const OFFSET: f64 = 4.0;

/// A place in a plane.
pub type Xy = [f64; 2];
/// Row and column.
pub type Cell = (usize, usize);

/// A maze.
pub struct Map {
    /// Its name.
    pub name: &'static str,
    /// Rows of cells; `#` is a wall.
    pub rows: &'static [&'static str],
    /// Where tasks begin and end.
    pub tasks: &'static [(Cell, Cell)],
    /// Where one is taken from, and to.
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

/// The middle of a cell.
pub fn middle((row, column): Cell) -> Xy {
    [column as f64 * UNIT - OFFSET, row as f64 * UNIT - OFFSET]
}

fn apart(a: Xy, b: Xy) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

impl Map {
    /// Rows and columns.
    pub fn size(&self) -> (usize, usize) {
        (self.rows.len(), self.rows[0].len())
    }

    /// Every cell.
    pub fn cells(&self) -> impl Iterator<Item = Cell> {
        let (rows, columns) = self.size();
        (0..rows).flat_map(move |row| (0..columns).map(move |column| (row, column)))
    }

    /// Whether a cell is no wall.
    pub fn is_free(&self, (row, column): Cell) -> bool {
        self.rows.get(row).and_then(|cells| cells.as_bytes().get(column)) == Some(&b'.')
    }

    /// The cell of a place, the nearest one for places outside.
    pub fn cell(&self, [x, y]: Xy) -> Cell {
        let (rows, columns) = self.size();
        let at = |v: f64, n: usize| (((v + OFFSET) / UNIT + 0.5).max(0.0) as usize).min(n - 1);
        (at(y, rows), at(x, columns))
    }

    /// The cells beside a cell, itself first, that are no walls.
    fn around(&self, (row, column): Cell) -> impl Iterator<Item = Cell> {
        let beside = [(0, 0), (-1, 0), (0, -1), (1, 0), (0, 1)];
        let step = move |(i, j): (isize, isize)| Some((row.checked_add_signed(i)?, column.checked_add_signed(j)?));
        beside.into_iter().filter_map(step).filter(|&cell| self.is_free(cell))
    }
}

/// The ways to a goal: for every cell, how many steps from cell to cell it is away.
pub struct Ways {
    map: &'static Map,
    goal: Xy,
    steps: Vec<Option<u16>>,
}

impl Ways {
    /// The ways to a place.
    pub fn new(map: &'static Map, goal: Xy) -> Self {
        let (rows, columns) = map.size();
        let mut ways = Self { map, goal, steps: vec![None; rows * columns] };
        ways.aim(goal);
        ways
    }

    /// Changes the goal.
    pub fn aim(&mut self, goal: Xy) {
        self.goal = goal;
        self.steps.fill(None);
        let start = self.map.cell(goal);
        let mut next = VecDeque::from([(start, 0)]);
        while let Some((cell, steps)) = next.pop_front() {
            let place = self.place(cell);
            if self.steps[place].is_none() {
                self.steps[place] = Some(steps);
                next.extend(self.map.around(cell).map(|beside| (beside, steps + 1)));
            }
        }
    }

    fn place(&self, (row, column): Cell) -> usize {
        row * self.map.size().1 + column
    }

    /// Whether one can walk there.
    pub fn reach(&self, from: Xy) -> bool {
        self.steps[self.place(self.map.cell(from))].is_some()
    }

    /// Where to go next: the goal, if it is in this cell, else the middle of the cell beside that is nearer.
    pub fn next(&self, from: Xy) -> Xy {
        let cell = self.map.cell(from);
        if cell == self.map.cell(self.goal) {
            return self.goal;
        }
        let steps = |&cell: &Cell| self.steps[self.place(cell)].unwrap_or(u16::MAX);
        self.map.around(cell).min_by_key(steps).map_or(self.goal, middle)
    }

    /// How far it is to walk, through the middles of cells.
    pub fn length(&self, from: Xy) -> f64 {
        let cell = self.map.cell(from);
        if cell == self.map.cell(self.goal) {
            return apart(from, self.goal);
        }
        let last = apart(middle(self.map.cell(self.goal)), self.goal);
        let through = |cell: Cell| {
            let steps = self.steps[self.place(cell)]?;
            Some(apart(from, middle(cell)) + UNIT * f64::from(steps) + last)
        };
        self.map.around(cell).filter_map(through).min_by(f64::total_cmp).unwrap_or_else(|| apart(from, self.goal))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_task_has_a_way() {
        for map in &MAPS {
            assert!(map.rows.iter().all(|row| row.len() == map.size().1), "{}", map.name);
            for &(start, goal) in map.tasks {
                assert!(map.is_free(start) && map.is_free(goal), "{}: {start:?} to {goal:?}", map.name);
                let ways = Ways::new(map, middle(goal));
                let (mut place, mut left) = (middle(start), ways.length(middle(start)));
                assert!(ways.reach(place), "{}: {start:?} to {goal:?}", map.name);
                while place != middle(goal) {
                    place = ways.next(place);
                    assert!(ways.length(place) < left, "{}: nearer with every cell", map.name);
                    left = ways.length(place);
                }
                assert_eq!(left, 0.0);
            }
        }
    }

    #[test]
    fn cells_and_places_match() {
        let map = &MAPS[0];
        for cell in map.cells() {
            let [x, y] = middle(cell);
            assert_eq!(map.cell([x + 1.9, y - 1.9]), cell);
        }
        assert_eq!(map.cell([-99.0, 99.0]), (8, 0));
    }
}
