//! Lighting of planes and boxes at the corners of a grid, between which colours are interpolated, as OpenGL's fixed
//! pipeline lights vertices.

use super::Lane;
use super::batch::{Batch, ShadingContext};
use crate::light::Material;
use crate::scalar::nearest;
use crate::scene::{Axis, Geom, Shape};
use crate::vector::{V3, add, dot, rotate, sub, unrotate};
use crate::view::View;
use swm_simd::{F32x8, Kernel, LANES, dispatch_avx2, vectorize};

/// Cells along the side of a box, at whose corners lighting is computed.
const QUADS: usize = 4;

/// Cells up to this size, in pixels, are lit per fragment, because interpolation would look the same.
const COARSE: f32 = 6.0;

/// Light at the corners of the grids of planes and boxes, computed at first use.
#[derive(Default)]
pub(super) struct LightGrids {
    /// The index of each geom's first corner; `u32::MAX` before the first use.
    pub starts: Vec<u32>,
    /// The colour of each corner and pass.
    pub colours: Vec<V3>,
    /// Whether each colour has been computed.
    pub known: Vec<bool>,
}

impl Batch {
    /// Whether a geom is lit at grid corners and its cells are large enough for that to be visible.
    pub(super) fn is_coarse(&self, geom: &Geom, view: &View) -> bool {
        let cell = match geom.shape {
            Shape::Plane(x, y) => x.step.max(y.step).max(x.pad).max(y.pad),
            Shape::Box(halves) => 0.5 * halves.into_iter().fold(0.0, f32::max),
            _ => return false,
        };
        let depth = |i: usize| dot(sub(self.position.each_ref().map(|l| l[i]), view.position), view.forward);
        cell * view.pixels_at(depth(0).min(depth(self.n - 1))) > COARSE
    }

    /// Returns the grid cell of a fragment.
    fn grid(&self, geom: &Geom, i: usize) -> GridCell {
        GridCell::at(geom, self.local.each_ref().map(|l| l[i]), self.normal.each_ref().map(|l| l[i]))
    }

    /// Computes the grid cell of every fragment.
    pub(super) fn cells(&mut self, geom: &Geom) {
        if let Shape::Plane(x, y) = geom.shape {
            let n = self.n;
            let [u, v] = &mut self.within;
            let (u, v) = (&mut u[..n], &mut v[..n]);
            return plane_cells(x, y, &self.local[0][..n], &self.local[1][..n], &mut self.cell[..n], u, v);
        }
        for i in 0..self.n {
            let grid = self.grid(geom, i);
            self.cell[i] = u32::try_from(grid.first).unwrap_or(0);
            [self.within[0][i], self.within[1][i]] = grid.within;
        }
    }

    /// Interpolates the light of a pass from the corners of every fragment's cell.
    pub(super) fn light_of_corners(
        &mut self,
        grids: &mut LightGrids,
        start: usize,
        (pass, passes): (usize, usize),
        geom: &Geom,
        material: &Material,
        context: &ShadingContext<'_>,
    ) {
        let row = match geom.shape {
            Shape::Plane(x, _) => x.cells + 1,
            _ => QUADS + 1,
        };
        let mut begin = 0;
        while begin < self.n {
            // Neighbouring fragments are mostly in the same cell, so each run in one cell is interpolated at once.
            let cell = self.cell[begin];
            let same = self.cell[begin..self.n].iter().take_while(|other| **other == cell).count();
            let mut corners = [[0.0; 3]; 4];
            for (colour, step) in corners.iter_mut().zip([0, 1, row, row + 1]) {
                let corner = start + (cell as usize + step) * passes + pass;
                if !grids.known[corner] {
                    grids.known[corner] = true;
                    let corner_pose = self.grid(geom, begin).corner(geom, step);
                    grids.colours[corner] = corner_light(corner_pose, pass, material, context);
                }
                *colour = grids.colours[corner];
            }
            let run = [begin, begin + same];
            dispatch_avx2(Interpolation { corners, run, within: &self.within, colours: &mut self.pass });
            begin += same;
        }
    }
}

/// Computes the light of a pass at a grid corner.
fn corner_light((position, normal): (V3, V3), pass: usize, material: &Material, context: &ShadingContext<'_>) -> V3 {
    let light = match pass {
        0 => context.lights.plain.iter().fold(material.base_colour(context.scene), |sum, light| {
            add(sum, light.at(material, context.view.position, position, normal))
        }),
        pass => context.lights.shadowed[pass - 1].at(material, context.view.position, position, normal),
    };
    light.map(|x| x.min(1.0))
}

/// The grid cell of a position.
struct GridCell {
    axes: [Axis; 2],
    /// Column and row of the cell.
    cell: [f32; 2],
    /// Index of its first corner.
    first: usize,
    /// Corners per row of the grid.
    row: usize,
    /// Position within the cell, from 0 to 1.
    within: [f32; 2],
    /// For a box: the axis normal to its side, and the coordinate of the side on that axis.
    side: (usize, f32),
}

impl GridCell {
    /// Returns the cell of a local position on a plane or a box; `normal` is the surface normal in world coordinates.
    #[inline]
    fn at(geom: &Geom, position: V3, normal: V3) -> Self {
        let (axes, side, at, begin) = match geom.shape {
            Shape::Box(halves) => {
                let normal = unrotate(&geom.rotation, normal);
                let side = if normal[0].abs() > 0.5 {
                    0
                } else if normal[1].abs() > 0.5 {
                    1
                } else {
                    2
                };
                let (u, v) = ((side + 1) % 3, (side + 2) % 3);
                let up = normal[side] > 0.0;
                let begin = (2 * side + usize::from(up)) * (QUADS + 1) * (QUADS + 1);
                let axes = [Axis::even(halves[u], QUADS), Axis::even(halves[v], QUADS)];
                (axes, (side, if up { halves[side] } else { -halves[side] }), [position[u], position[v]], begin)
            }
            Shape::Plane(x, y) => ([x, y], (2, 0.0), [position[0], position[1]], 0),
            _ => ([Axis::even(1.0, 1); 2], (2, 0.0), [0.0; 2], 0),
        };
        let ((i, s), (j, t)) = (axes[0].cell(at[0]), axes[1].cell(at[1]));
        let row = axes[0].cells + 1;
        Self {
            axes,
            cell: [i, j],
            first: begin + nearest(j) as usize * row + nearest(i) as usize,
            row,
            within: [s, t],
            side,
        }
    }

    /// Returns the position and normal of a corner of the cell in the world.
    fn corner(&self, geom: &Geom, step: usize) -> (V3, V3) {
        let one = |yes: bool| if yes { 1.0 } else { 0.0 };
        let (i, j) = (self.cell[0] + one(step % self.row == 1), self.cell[1] + one(step >= self.row));
        let (side, at) = self.side;
        let (mut position, mut normal) = ([0.0; 3], [0.0; 3]);
        position[side] = at;
        position[(side + 1) % 3] = self.axes[0].line(i);
        position[(side + 2) % 3] = self.axes[1].line(j);
        normal[side] = if at < 0.0 { -1.0 } else { 1.0 };
        (add(geom.position, rotate(&geom.rotation, position)), rotate(&geom.rotation, normal))
    }
}

impl LightGrids {
    /// Returns the index of a geom's first corner, adding its corners at first use.
    pub fn of(&mut self, index: u32, geom: &Geom, passes: usize) -> usize {
        let start = &mut self.starts[index as usize];
        if *start == u32::MAX {
            let corners = match geom.shape {
                Shape::Plane(x, y) => (x.cells + 1) * (y.cells + 1),
                _ => 6 * (QUADS + 1) * (QUADS + 1),
            };
            *start = u32::try_from(self.colours.len()).unwrap_or(0);
            self.colours.resize(self.colours.len() + corners * passes, [0.0; 3]);
            self.known.resize(self.colours.len(), false);
        }
        *start as usize
    }
}

/// Bilinear interpolation between the colours of four corners, for the fragments of a run. Lanes after the run may
/// be overwritten.
struct Interpolation<'a> {
    corners: [V3; 4],
    run: [usize; 2],
    within: &'a [Lane; 2],
    colours: &'a mut [Lane; 3],
}

impl Kernel for Interpolation<'_> {
    type Output = ();

    #[inline(always)]
    fn run<L: swm_simd::Level>(self) {
        let simd = L::f32x8();
        let Self { corners: [a, b, c, d], run: [begin, end], within: [u, v], colours } = self;
        for from in (begin..end).step_by(LANES) {
            let (Some(u), Some(v)) = (u[from..].first_chunk(), v[from..].first_chunk()) else { return };
            let (u, v) = (simd.load(u), simd.load(v));
            for (k, lane) in colours.iter_mut().enumerate() {
                let between = |a: f32, b: f32| simd.add(simd.splat(a), simd.mul(u, simd.splat(b - a)));
                let (low, high) = (between(a[k], b[k]), between(c[k], d[k]));
                let colour = simd.add(low, simd.mul(v, simd.sub(high, low)));
                if let Some(to) = lane[from..].first_chunk_mut() {
                    simd.store(colour, to);
                }
            }
        }
    }
}

vectorize! {
    /// Computes the cells of positions on a plane, and the positions within them.
    fn plane_cells(
        x: Axis, y: Axis, px: &[f32], py: &[f32], cells: &mut [u32], u: &mut [f32], v: &mut [f32],
    ) {
        let n = px.len();
        let (py, cells, u, v) = (&py[..n], &mut cells[..n], &mut u[..n], &mut v[..n]);
        let row = x.cells as u32 + 1;
        for i in 0..n {
            let ((column, s), (line, t)) = (x.cell(px[i]), y.cell(py[i]));
            cells[i] = nearest(line) * row + nearest(column);
            (u[i], v[i]) = (s, t);
        }
    }
}
