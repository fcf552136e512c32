//! [`Layers`]: the depth buffer, which holds the nearest geom or triangle and its depth for every sample.

mod extent;
mod outline;
mod triangles;

pub(crate) use extent::{mesh_cell, touched};
pub(crate) use triangles::{TRIANGLE, Triangle};

use crate::cast::{PosedShape, Samples};
use crate::scene::{Assets, Geom, Shape};
use crate::view::View;
use outline::Outline;
use std::ops::Range;
use swm_simd::LANES;

/// The id of samples that no geom covers.
pub(crate) const NOTHING: u32 = u32::MAX >> 1;

/// Returns the positions of samples within a pixel.
pub(crate) fn pattern(samples: usize) -> &'static [[f32; 2]] {
    const EIGHTHS: f32 = 0.125;
    const ONE: [[f32; 2]; 1] = [[0.5, 0.5]];
    const TWO: [[f32; 2]; 2] = [[6.0 * EIGHTHS, 6.0 * EIGHTHS], [2.0 * EIGHTHS, 2.0 * EIGHTHS]];
    // The rotated square of graphics cards, flipped vertically, because their rows begin at the bottom.
    const FOUR: [[f32; 2]; 4] = [
        [3.0 * EIGHTHS, 7.0 * EIGHTHS],
        [7.0 * EIGHTHS, 5.0 * EIGHTHS],
        [1.0 * EIGHTHS, 3.0 * EIGHTHS],
        [5.0 * EIGHTHS, 1.0 * EIGHTHS],
    ];
    match samples {
        0 | 1 => &ONE,
        2 | 3 => &TWO,
        _ => &FOUR,
    }
}

/// Returns the mean position of covered samples; `covered` has a bit per sample. The mean lies inside a convex shape
/// even at the shape's edge. For a fully covered pixel, the function returns the pixel's centre.
fn centre_of(pattern: &[[f32; 2]], covered: usize) -> [f32; 2] {
    let count = covered.count_ones() as usize;
    if count == 0 || count >= pattern.len() {
        return [0.5, 0.5];
    }
    let mut sum = [0.0; 2];
    for (_, offset) in pattern.iter().enumerate().filter(|(sample, _)| covered >> sample & 1 == 1) {
        sum = [sum[0] + offset[0], sum[1] + offset[1]];
    }
    sum.map(|sum| sum / count as f32)
}

/// The depth buffer of some rows of a frame. Samples of a pixel are neighbours, so that one vector holds all samples
/// that a small triangle touches. The content of a sample does not depend on which rows are drawn together.
#[derive(Default)]
pub(crate) struct Layers {
    pub width: usize,
    /// The rows of the frame that are drawn.
    pub rows: Range<usize>,
    pub samples: usize,
    /// The number of samples from one row to the next: the samples of a row's pixels, and [`LANES`] more for the last
    /// vector.
    stride: usize,
    /// Positions of samples within a pixel.
    pub pattern: &'static [[f32; 2]],
    /// The smallest and largest coordinates in `pattern`.
    reach: [[f32; 2]; 2],
    /// The depth of each sample; the far plane if no geom covers the sample.
    pub depths: Vec<f32>,
    /// The id of each sample: the index of a geom, [`TRIANGLE`] plus the index of a triangle, or [`NOTHING`].
    pub ids: Vec<u32>,
    /// Triangles that were drawn.
    pub triangles: Vec<Triangle>,
    /// The geom of each triangle.
    owners: Vec<u32>,
    /// The coordinates of every sample of a row: x from the left of the frame, y from the upper edge of the row.
    at: [Vec<f32>; 2],
    /// The first [`LANES`] of `at`.
    lanes: [[f32; LANES]; 2],
    /// For every mask of covered samples, the mean position of these samples within the pixel.
    pub centres: [[f32; 2]; 16],
    /// A floor depth in front of all geoms for every sample of a row, used if no floor is given.
    free: Vec<f32>,
    /// Scratch: the leftmost and rightmost x of a shape in each row.
    outline: [Vec<f32>; 2],
    /// Scratch: vertices of a mesh in pixels, with `w` and depth.
    vertices: Vec<[f32; 4]>,
}

/// A copy of the content of layers.
#[derive(Default)]
pub(crate) struct LayersSnapshot {
    depths: Vec<f32>,
    ids: Vec<u32>,
    triangles: Vec<Triangle>,
    owners: Vec<u32>,
}

/// A rectangle of pixels, `[x0, y0, x1, y1]`, without column `x1` and row `y1`.
pub(crate) type Region = [usize; 4];

impl Layers {
    /// Prepares the layers for rows of a frame and removes all triangles. Depths and ids are unspecified until
    /// [`Layers::clear`].
    pub fn start(&mut self, width: usize, rows: Range<usize>, pattern: &'static [[f32; 2]]) {
        let stride = width * pattern.len() + LANES;
        if (stride, pattern) != (self.stride, self.pattern) {
            self.place_samples(stride, pattern);
        }
        self.depths.resize(rows.len() * stride, 0.0);
        self.ids.resize(rows.len() * stride, NOTHING);
        (self.width, self.rows) = (width, rows);
        self.clear_triangles();
    }

    /// Computes the positions of the samples of a row.
    fn place_samples(&mut self, stride: usize, pattern: &'static [[f32; 2]]) {
        (self.stride, self.samples, self.pattern) = (stride, pattern.len(), pattern);
        let reach = |with: fn(f32, f32) -> f32, from: f32| {
            pattern.iter().fold([from; 2], |a, b| [with(a[0], b[0]), with(a[1], b[1])])
        };
        self.reach = [reach(f32::min, 1.0), reach(f32::max, 0.0)];
        for (axis, at) in self.at.iter_mut().enumerate() {
            let pixel = |i: usize| if axis == 0 { (i / pattern.len()) as f32 } else { 0.0 };
            at.clear();
            at.extend((0..stride).map(|i| pixel(i) + pattern[i % pattern.len()][axis]));
            self.lanes[axis].copy_from_slice(&at[..LANES]);
        }
        self.free.resize(stride, f32::NEG_INFINITY);
        for (covered, centre) in self.centres.iter_mut().enumerate() {
            *centre = centre_of(pattern, covered);
        }
    }

    /// Removes all triangles.
    pub fn clear_triangles(&mut self) {
        self.triangles.clear();
        self.owners.clear();
    }

    /// Copies the content into a snapshot.
    pub fn save(&self, into: &mut LayersSnapshot) {
        into.depths.clone_from(&self.depths);
        into.ids.clone_from(&self.ids);
        into.triangles.clone_from(&self.triangles);
        into.owners.clone_from(&self.owners);
    }

    /// Restores a snapshot of layers with the same rows and samples.
    pub fn restore(&mut self, from: &LayersSnapshot) {
        self.depths.clone_from(&from.depths);
        self.ids.clone_from(&from.ids);
        self.triangles.clone_from(&from.triangles);
        self.owners.clone_from(&from.owners);
    }

    /// Clears depths and ids; `far` is the far plane.
    pub fn clear(&mut self, far: f32) {
        self.depths.fill(far);
        self.ids.fill(NOTHING);
    }

    /// Returns the indices of the samples of pixels `x0..x1` of a row.
    #[inline]
    pub fn span(&self, y: usize, x0: usize, x1: usize) -> Range<usize> {
        let first = (y - self.rows.start) * self.stride;
        first + x0 * self.samples..first + x1 * self.samples
    }

    /// Returns the part of a region within the rows; it is empty if the region does not overlap the rows.
    pub fn clip_to_rows(&self, [x0, y0, x1, y1]: Region) -> Region {
        let y0 = y0.clamp(self.rows.start, self.rows.end);
        [x0, y0, x1, y1.clamp(y0, self.rows.end)]
    }

    /// Draws a geom in the samples in which it is nearer than the content and farther than `floor`, if given. Geoms in
    /// shadow maps (`caster`) are drawn with less detail and with both sides of open meshes. Returns the region of the
    /// frame that the geom can touch.
    pub fn draw(
        &mut self,
        index: u32,
        geom: &Geom,
        (assets, view): (&Assets, &View),
        floor: Option<&[f32]>,
        caster: bool,
    ) -> Option<Region> {
        let region = touched(geom, assets, view)?;
        let clipped = self.clip_to_rows(region);
        if clipped[1] == clipped[3] {
            return Some(region);
        }
        match geom.shape {
            Shape::Mesh(mesh) => {
                let mesh = assets.meshes.get(mesh)?;
                let level_index = mesh.level_for(mesh_cell(mesh, geom, view, caster));
                let level = mesh.level(level_index);
                let level_id = u32::try_from(level_index).unwrap_or(0);
                let both_sides = caster && !mesh.is_closed();
                self.draw_mesh((index, level_id), geom, level, (view, clipped[1]..clipped[3]), floor, both_sides);
            }
            shape => {
                let (_, halves) = shape.bounds();
                let outline = Outline::new(geom, halves, view);
                self.draw_shape(index, &PosedShape::new(geom, view)?, clipped, &outline, floor);
            }
        }
        Some(region)
    }

    fn draw_shape(
        &mut self,
        index: u32,
        pose: &PosedShape,
        [left, y0, right, y1]: Region,
        outline: &Outline,
        floor: Option<&[f32]>,
    ) {
        let [mut lows, mut highs] = std::mem::take(&mut self.outline);
        outline.reach(y0..y1, &mut lows, &mut highs);
        for (y, (&low, &high)) in (y0..y1).zip(lows.iter().zip(&highs)) {
            // The margin of 0.01 pixels covers rounding errors.
            let (low, high) = ((low - 0.01).max(left as f32), (high + 0.01).min(right as f32));
            if low >= high {
                continue;
            }
            let (x0, x1) = (low as usize, (high as usize + 1).min(right));
            let (span, columns) = (self.span(y, x0, x1), x0 * self.samples..x1 * self.samples);
            let samples = Samples {
                at: self.at.each_ref().map(|at| &at[columns.clone()]),
                floor: floor.map_or(&self.free[columns], |floor| &floor[span.clone()]),
                depths: &mut self.depths[span.clone()],
                ids: &mut self.ids[span],
            };
            pose.enter(&pose.row(y), index, samples);
        }
        self.outline = [lows, highs];
    }

    /// Returns the geom that an id belongs to.
    #[inline]
    pub fn geom(&self, id: u32) -> u32 {
        match id & TRIANGLE {
            0 => id,
            _ => self.owners[(id & !TRIANGLE) as usize],
        }
    }
}
