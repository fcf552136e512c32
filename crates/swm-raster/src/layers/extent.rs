//! The size of geoms on the screen: the region they touch, and the detail that a mesh needs.

use super::Region;
use crate::mesh::Mesh;
use crate::scene::{Assets, Geom, Shape};
use crate::vector::{add, length, rotate, scale};
use crate::view::View;

/// Largest side of a merged mesh cell in frames, in pixels.
const FRAME_CELL: f32 = 0.6;

/// Largest side of a merged mesh cell in shadow maps, in texels.
const SHADOW_MAP_CELL: f32 = 2.0;

/// Returns the largest side of a mesh cell, in local units, at which merging its vertices is not visible.
pub(crate) fn mesh_cell(mesh: &Mesh, geom: &Geom, view: &View, caster: bool) -> f32 {
    let (low, high) = mesh.bounds();
    let reach = 0.5 * length([high[0] - low[0], high[1] - low[1], high[2] - low[2]]);
    let middle = add(geom.position, rotate(&geom.rotation, scale(add(low, high), 0.5)));
    let nearest = view.project(middle).1 - reach;
    (if caster { SHADOW_MAP_CELL } else { FRAME_CELL }) / view.pixels_at(nearest)
}

/// Returns the region of a frame that a geom can touch, or `None` if the geom is out of sight or invalid.
pub(crate) fn touched(geom: &Geom, assets: &Assets, view: &View) -> Option<Region> {
    if !geom.position.iter().chain(&geom.rotation).all(|x| x.is_finite()) {
        return None;
    }
    let (middle, halves) = match geom.shape {
        Shape::Mesh(mesh) => {
            let (low, high) = assets.meshes.get(mesh)?.bounds();
            (scale(add(low, high), 0.5), std::array::from_fn(|k| 0.5 * (high[k] - low[k])))
        }
        shape => shape.bounds(),
    };
    if !halves.iter().all(|half| half.is_finite() && *half >= 0.0) || halves == [0.0; 3] {
        return None;
    }
    let middle = add(geom.position, rotate(&geom.rotation, middle));
    let sides = std::array::from_fn(|k| {
        let mut side = [0.0; 3];
        side[k] = halves[k];
        rotate(&geom.rotation, side)
    });
    view.touched(middle, sides)
}
