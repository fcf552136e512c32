//! Contacts of two boxes, one of which touches with a face. The contacts are those of the face, edge or corner of the
//! other box that is parallel to this face, clipped by this face. An axis counts as parallel up to 30 degrees.

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
    // The deepest corner of the other box, and the edges from this corner that are parallel to the face.
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
    let mut add_contact = |[x, y, z]: Vector| {
        if z <= margin {
            let point = from_face_frame(axis, positive, [x, y, 0.5 * z + height]);
            contacts.add(add(flat.world_direction(point), flat.center, 1.0), 0.5 * z);
        }
    };
    // Intersections of these edges, and of the edges opposite to them, with the sides of the rectangle.
    let lines = [(corner, along), (corner, across), (along_end, across), (across_end, along)];
    for (start, edge) in &lines[..[0, 1, 4][count]] {
        for (q, side) in [(0, -1.0), (0, 1.0), (1, -1.0), (1, 1.0)] {
            if edge[q].abs() <= TINY {
                continue;
            }
            let fraction = (size[q] * side - start[q]) * (1.0 / edge[q]);
            let at = add(*start, *edge, fraction);
            if (0.0..=1.0).contains(&fraction) && at[1 - q].abs() <= size[1 - q] {
                add_contact(at);
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
                add_contact([cx, cy, corner[2] + u * along[2] + v * across[2]]);
            }
        }
    }
    // Corners of the other box over the rectangle. The deepest corner is added also where it is beside the rectangle.
    add_contact(corner);
    for at in &[along_end, across_end, add(along_end, across, 1.0)][..[0, 1, 3][count]] {
        if (0..2).all(|q| at[q].abs() < size[q]) {
            add_contact(*at);
        }
    }
    contacts
}
