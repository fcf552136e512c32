//! [`Mesh`]: triangles with detail levels for small frames.
//!
//! A detail level merges the vertices in each cell of a cubic grid. A level whose cells are smaller than a pixel
//! looks like the original, and a robot of 100,000 triangles needs only some thousands of them in a small frame.

use crate::vector::{V3, add, scale, sub, unit};
use std::collections::HashMap;

/// Cells along the longest side at the finest merged level.
const FINEST: f32 = 512.0;

/// Cells along the longest side at the coarsest level.
const COARSEST: f32 = 7.0;

/// Largest ratio of unmatched edges to triangles of a mesh that counts as closed: meshes of robot parts have holes
/// at the joints.
const OPEN: f32 = 0.1;

/// A mesh, prepared once.
#[derive(Clone, Debug)]
pub struct Mesh {
    /// Detail levels, from fine to coarse.
    levels: Vec<DetailLevel>,
    /// Whether nearly all edges belong to two triangles, so that the mesh has an inside.
    closed: bool,
    low: V3,
    high: V3,
}

/// One detail level.
#[derive(Clone, Debug, Default)]
pub(crate) struct DetailLevel {
    /// Side of the cells whose vertices were merged, in local units; 0 for the mesh without merging.
    pub cell: f32,
    /// Positions of vertices.
    pub positions: Vec<V3>,
    /// Unit normals, indexed by `corners`.
    pub normals: Vec<V3>,
    /// Texture coordinates, indexed by `corners`.
    pub coordinates: Vec<[f32; 2]>,
    /// Triangles, counterclockwise seen from outside: indices into `positions`.
    pub faces: Vec<[u32; 3]>,
    /// Indices into `normals` and `coordinates`.
    pub corners: Vec<[u32; 3]>,
}

/// A corner of a triangle.
#[derive(Clone, Copy, Debug, Default)]
pub struct Corner {
    /// Position in local coordinates.
    pub position: V3,
    /// Normal of the surface.
    pub normal: V3,
    /// Texture coordinates.
    pub coordinates: [f32; 2],
}

impl Mesh {
    /// Builds a mesh of triangles that are counterclockwise seen from outside. Triangles with values that are not
    /// finite are left out.
    pub fn new(triangles: impl IntoIterator<Item = [Corner; 3]>) -> Self {
        let mut level = DetailLevel::default();
        let (mut positions, mut corner_ids) = (HashMap::new(), HashMap::new());
        let index = |i: usize| u32::try_from(i).unwrap_or(u32::MAX);
        for triangle in triangles {
            if triangle.iter().any(|c| c.position.iter().chain(&c.normal).chain(&c.coordinates).any(|x| !x.is_finite()))
            {
                continue;
            }
            level.faces.push(triangle.map(|corner| {
                *positions.entry(corner.position.map(f32::to_bits)).or_insert_with(|| {
                    level.positions.push(corner.position);
                    index(level.positions.len() - 1)
                })
            }));
            level.corners.push(triangle.map(|corner| {
                let key = (corner.normal.map(f32::to_bits), corner.coordinates.map(f32::to_bits));
                *corner_ids.entry(key).or_insert_with(|| {
                    level.normals.push(unit(corner.normal));
                    level.coordinates.push(corner.coordinates);
                    index(level.normals.len() - 1)
                })
            }));
        }
        let fold = |with: fn(f32, f32) -> f32, from: f32| {
            level.positions.iter().fold([from; 3], |a, b| std::array::from_fn(|k| with(a[k], b[k])))
        };
        let (low, high) = match level.positions.is_empty() {
            true => ([0.0; 3], [0.0; 3]),
            false => (fold(f32::min, f32::INFINITY), fold(f32::max, f32::NEG_INFINITY)),
        };
        let mut levels = vec![level];
        let side = sub(high, low).into_iter().fold(0.0, f32::max);
        let mut cells = FINEST;
        while cells >= COARSEST && side > 0.0 {
            let coarser = levels[0].merged(low, side / cells);
            // A level is stored only if it has less than 4/5 of the triangles of the previous level.
            if levels.last().is_some_and(|last| coarser.faces.len() * 5 < last.faces.len() * 4) {
                levels.push(coarser);
            }
            cells *= std::f32::consts::FRAC_1_SQRT_2;
        }
        let closed = levels[0].is_closed();
        Self { levels, closed, low, high }
    }

    /// Whether the back sides of the triangles are visible only from inside or through small holes.
    pub(crate) fn is_closed(&self) -> bool {
        self.closed
    }

    /// Returns the lowest and highest corner of the bounding box.
    pub(crate) fn bounds(&self) -> (V3, V3) {
        (self.low, self.high)
    }

    /// Returns the index of the coarsest level whose cells are at most `cell` large.
    pub(crate) fn level_for(&self, cell: f32) -> usize {
        self.levels.iter().rposition(|level| level.cell <= cell).unwrap_or(0)
    }

    /// Returns a level by its index.
    pub(crate) fn level(&self, index: usize) -> &DetailLevel {
        &self.levels[index.min(self.levels.len() - 1)]
    }

    /// Returns the number of triangles of every level, from fine to coarse.
    pub fn triangles(&self) -> impl Iterator<Item = usize> + '_ {
        self.levels.iter().map(|level| level.faces.len())
    }
}

impl DetailLevel {
    /// Whether nearly all edges are used once in each direction.
    fn is_closed(&self) -> bool {
        let mut passed = HashMap::new();
        for [a, b, c] in &self.faces {
            for (from, to) in [(a, b), (b, c), (c, a)] {
                *passed.entry((from.min(to), from.max(to))).or_insert(0_i32) += if from < to { 1 } else { -1 };
            }
        }
        let open: u32 = passed.values().map(|sum| sum.unsigned_abs()).sum();
        open as f32 <= OPEN * self.faces.len() as f32
    }

    /// Merges the vertices in each cell of side `cell` into their mean. Normals are merged only with normals that point
    /// in a similar direction, so that thin plates keep both sides.
    fn merged(&self, low: V3, cell: f32) -> Self {
        let index = |i: usize| u32::try_from(i).unwrap_or(u32::MAX);
        let key = |position: V3| {
            position.map(|x| x).iter().zip(low).map(|(x, low)| ((x - low) / cell) as i32).collect::<Vec<_>>()
        };
        let (mut cells, mut sums) = (HashMap::new(), Vec::<(V3, f32)>::new());
        let merged: Vec<u32> = self
            .positions
            .iter()
            .map(|&position| {
                let at = *cells.entry(key(position)).or_insert_with(|| {
                    sums.push(([0.0; 3], 0.0));
                    index(sums.len() - 1)
                });
                let sum = &mut sums[at as usize];
                *sum = (add(sum.0, position), sum.1 + 1.0);
                at
            })
            .collect();
        let mut new = Self { cell, ..Self::default() };
        new.positions = sums.iter().map(|(sum, count)| scale(*sum, 1.0 / count)).collect();
        let (mut corner_ids, mut directions) = (HashMap::new(), Vec::<(V3, [f32; 2], f32)>::new());
        let mut seen = std::collections::HashSet::new();
        for (face, corners) in self.faces.iter().zip(&self.corners) {
            let face = face.map(|position| merged[position as usize]);
            let [a, b, c] = face;
            if a == b || b == c || a == c {
                continue;
            }
            let first = (0..3).min_by_key(|&k| face[k]).unwrap_or(0);
            let rotated = [face[first], face[(first + 1) % 3], face[(first + 2) % 3]];
            if !seen.insert(rotated) {
                continue;
            }
            new.faces.push(face);
            new.corners.push(std::array::from_fn(|k| {
                let (normal, coordinates) = (self.normals[corners[k] as usize], self.coordinates[corners[k] as usize]);
                // Six directions: the axis that the normal is closest to, and its sign.
                let axis = (0..3).max_by(|&i, &j| normal[i].abs().total_cmp(&normal[j].abs())).unwrap_or(0);
                let at = *corner_ids.entry((face[k], axis, normal[axis] > 0.0)).or_insert_with(|| {
                    directions.push(([0.0; 3], [0.0; 2], 0.0));
                    index(directions.len() - 1)
                });
                let sum = &mut directions[at as usize];
                *sum = (add(sum.0, normal), [sum.1[0] + coordinates[0], sum.1[1] + coordinates[1]], sum.2 + 1.0);
                at
            }));
        }
        new.normals = directions.iter().map(|(normal, ..)| unit(*normal)).collect();
        new.coordinates = directions.iter().map(|(_, sum, count)| sum.map(|x| x / count)).collect();
        new
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fine_mesh_has_coarser_levels() {
        let mut triangles = vec![];
        let corner = |i: u8, j: u8| Corner {
            position: [f32::from(i), f32::from(j), 0.0],
            normal: [0.0, 0.0, 1.0],
            coordinates: [0.0; 2],
        };
        for i in 0..100 {
            for j in 0..100 {
                triangles.push([corner(i, j), corner(i + 1, j), corner(i, j + 1)]);
                triangles.push([corner(i + 1, j), corner(i + 1, j + 1), corner(i, j + 1)]);
            }
        }
        let mesh = Mesh::new(triangles);
        let counts: Vec<usize> = mesh.triangles().collect();
        assert_eq!(counts[0], 20_000);
        assert!(
            counts.windows(2).all(|pair| pair[1] < pair[0]) && *counts.last().expect("a mesh has a level") < 300,
            "{counts:?}"
        );
        assert_eq!(mesh.level_for(0.0), 0);
        assert!(mesh.level_for(100.0) == counts.len() - 1);
        for index in 0..counts.len() {
            let level = mesh.level(index);
            assert!(level.faces.iter().flatten().all(|&i| (i as usize) < level.positions.len()));
            assert!(level.corners.iter().flatten().all(|&i| (i as usize) < level.normals.len()));
        }
    }

    #[test]
    fn empty_mesh_is_valid() {
        assert_eq!(Mesh::new([]).triangles().collect::<Vec<_>>(), [0]);
    }
}
