//! Contacts of two boxes of which one touches with a face: the part of the other box that is parallel to the face,
//! clipped by it. That part is a face, an edge or a corner; an axis counts as parallel up to 30 degrees.

use super::{BoxContacts, Face, OrientedBox, TINY, Vector, add, from_face_frame, sign, to_face_frame};

/// The largest normal component of a unit axis that counts as parallel to the face: sin 30°.
const STEEP: f64 = 0.5;

/// The contacts on a face of the box `flat`. The normal points from the first box of the pair to the second.
pub fn face_contacts(flat: &OrientedBox, other: &OrientedBox, face: &Face, margin: f64) -> BoxContacts {
    let &Face { of_second, axis, positive } = face;
    let view = |v| to_face_frame(axis, positive, flat.local_direction(v));
    // From here on, the face is the plane z = 0 with the other box above it, and its rectangle is centred at the
    // origin.
    let [lx, ly, height] = to_face_frame(axis, positive, flat.half).map(f64::abs);
    let size = [lx, ly];
    let axes: [Vector; 3] = std::array::from_fn(|k| view(other.axis(k)));
    // The deepest corner, and the sides that lead from it parallel to the face.
    let mut corner = view(add(other.center, flat.center, -1.0));
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
    let (along_end, across_end) = (add(corner, along, 1.0), add(corner, across, 1.0));

    let mut contacts =
        BoxContacts::new(flat.world_direction(from_face_frame(axis, positive, [0.0, 0.0, sign(!of_second)])));
    let mut put = |[x, y, z]: Vector| {
        if z <= margin {
            let point = from_face_frame(axis, positive, [x, y, 0.5 * z + height]);
            contacts.add(add(flat.world_direction(point), flat.center, 1.0), 0.5 * z);
        }
    };
    // Intersections of the sides with those of the rectangle.
    let lines = [(corner, along), (corner, across), (along_end, across), (across_end, along)];
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
    // Corners of the rectangle inside the other box's face.
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
    // Corners of the other box over the rectangle; the deepest one wherever it is.
    put(corner);
    for at in &[along_end, across_end, add(along_end, across, 1.0)][..[0, 1, 3][count]] {
        if (0..2).all(|q| at[q].abs() < size[q]) {
            put(*at);
        }
    }
    contacts
}
