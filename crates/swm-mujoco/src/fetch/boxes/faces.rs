//! Boxes of which one touches with a face: what of the other lies along that face, clipped by it. That is a face of the other
//! one, or an edge or a corner where it stands steep: an axis is along the face up to 30 degrees.

use super::{Face, Solid, TINY, Touch, Vector, add, facing, sign, unfacing};

/// How far the direction of an axis may point out of the face.
const STEEP: f64 = 0.5;

/// The contacts on a face of `flat`. The normal points from the first box to the second, whichever has the face.
pub fn touch(flat: &Solid, other: &Solid, face: &Face, margin: f64) -> Touch {
    let &Face { of_second, axis, positive } = face;
    let view = |v| facing(axis, positive, flat.local(v));
    // From here on the face is the plane z = 0, with the other box above it, and its rectangle is around the origin.
    let [lx, ly, height] = facing(axis, positive, flat.half).map(f64::abs);
    let size = [lx, ly];
    let axes: [Vector; 3] = std::array::from_fn(|k| view(other.axis(k)));
    // The deepest corner, and the sides that go from it along the face.
    let mut corner = view(add(other.at, flat.at, -1.0));
    corner[2] -= height;
    let (mut sides, mut count) = ([[0.0; 3]; 2], 0);
    for (axis, half) in axes.into_iter().zip(other.half) {
        let up = sign(axis[2] >= 0.0);
        corner = add(corner, axis, -up * half);
        if axis[2].abs() < STEEP && count < 2 {
            sides[count] = axis.map(|x| x * 2.0 * up * half);
            count += 1;
        }
    }
    let [along, across] = sides;
    let (beside, behind) = (add(corner, along, 1.0), add(corner, across, 1.0));

    let mut touch = Touch::new(flat.world(unfacing(axis, positive, [0.0, 0.0, sign(!of_second)])));
    let mut put = |[x, y, z]: Vector| {
        if z <= margin {
            let place = unfacing(axis, positive, [x, y, 0.5 * z + height]);
            touch.add(add(flat.world(place), flat.at, 1.0), 0.5 * z);
        }
    };
    // Where edges cross the rectangle's sides.
    let lines = [(corner, along), (corner, across), (beside, across), (behind, along)];
    for (start, way) in &lines[..[0, 1, 4][count]] {
        for (q, side) in [(0, -1.0), (0, 1.0), (1, -1.0), (1, 1.0)] {
            if way[q].abs() <= TINY {
                continue;
            }
            let part = (size[q] * side - start[q]) * (1.0 / way[q]);
            let at = add(*start, *way, part);
            if (0.0..=1.0).contains(&part) && at[1 - q].abs() <= size[1 - q] {
                put(at);
            }
        }
    }
    // The rectangle's corners in the other box's face.
    if count == 2 {
        let area = along[0] * across[1] - across[0] * along[1];
        for (cx, cy) in [(-lx, -ly), (-lx, ly), (lx, -ly), (lx, ly)] {
            let (x, y) = (cx - corner[0], cy - corner[1]);
            let u = (x * across[1] - y * across[0]) * (1.0 / area);
            let v = (y * along[0] - x * along[1]) * (1.0 / area);
            if u > 0.0 && v > 0.0 && u < 1.0 && v < 1.0 {
                put([cx, cy, corner[2] + u * along[2] + v * across[2]]);
            }
        }
    }
    // The other box's corners over the rectangle, the deepest one wherever it is.
    put(corner);
    for at in &[beside, behind, add(beside, across, 1.0)][..[0, 1, 3][count]] {
        if (0..2).all(|q| at[q].abs() < size[q]) {
            put(*at);
        }
    }
    touch
}
