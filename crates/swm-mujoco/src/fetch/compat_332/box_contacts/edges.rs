//! Contacts of two boxes that touch at their edges. For each box, one of the two faces at its edge is selected: the
//! face that is more parallel to the edge of the other box. The face of the second box is projected along the normal
//! onto the face of the first box and clipped by it.

use super::{BoxContacts, Edges, OrientedBox, TINY, Vector, add, dot, from_face_frame, sign, to_face_frame};

/// The two axes other than `i`. Of two equally parallel faces, MuJoCo selects the second.
fn other_axes(i: usize) -> [usize; 2] {
    [[1, 2], [0, 2], [1, 0]][i]
}

/// The contacts of two boxes at these edges; `None` if the normal is parallel to the face of the first box.
#[allow(clippy::too_many_lines, reason = "follows one function of MuJoCo 3.3.2 statement by statement")]
pub fn edge_contacts(a: &OrientedBox, b: &OrientedBox, edges: &Edges, margin: f64) -> Option<BoxContacts> {
    let &Edges { along: [i, j], sides, normal, inward } = edges;
    let axes: [Vector; 3] = std::array::from_fn(|k| a.local_direction(b.axis(k)));
    // Orders two faces by the angle to the other box's edge: the more parallel face is the second.
    let flat = |pair: [usize; 2], steep: &dyn Fn(usize) -> f64| {
        if steep(pair[0]) < steep(pair[1]) { [pair[1], pair[0]] } else { pair }
    };
    let [_, face] = flat(other_axes(i), &|k| axes[j][k].abs());
    let [wide, up] = flat(other_axes(j), &|k| axes[k][i].abs());
    let outward = sides[0][face];
    let view = |v| to_face_frame(face, outward, v);

    // From here on, the first box's face is the plane z = 0, and its rectangle is centred at the origin.
    let [lx, ly, height] = view(a.half).map(f64::abs);
    let size = [lx, ly];
    let viewed_normal = view(normal);
    if viewed_normal[2].abs() < TINY {
        return None;
    }
    let along_normal = sign(!inward) / viewed_normal[2];
    let viewed: [Vector; 3] = axes.map(view);
    let mut middle = view(a.local_direction(add(b.center, a.center, -1.0)));
    middle[2] -= height;
    let corner = |across: bool, end: f64| {
        let at = add(middle, viewed[wide], b.half[wide] * sign(across));
        add(add(at, viewed[up], b.half[up] * sign(sides[1][up])), viewed[j], b.half[j] * end)
    };
    let near = sides[1][wide];
    let corners = [corner(near, 1.0), corner(near, -1.0), corner(!near, 1.0), corner(!near, -1.0)];
    // The second face, projected along the normal onto the plane of the first face.
    let projected = corners.map(|at| add(at, viewed_normal, -at[2] / viewed_normal[2]));
    let [along, across] = [1, 2].map(|k| add(projected[k], projected[0], -1.0));
    let [edge_along, edge_across] = [1, 2].map(|k| add(corners[k], corners[0], -1.0));

    let toward = a.world_direction(from_face_frame(face, outward, viewed_normal));
    let mut contacts = BoxContacts::new(toward.map(|x| x * sign(!inward)));
    let add_contact = |contacts: &mut BoxContacts, mut at: Vector, distance: f64| {
        at[2] += height;
        contacts.add(add(a.world_direction(from_face_frame(face, outward, at)), a.center, 1.0), distance);
    };

    // Intersections of the edges of the second box's face with the sides of the first box's rectangle.
    let lines = [
        (projected[0], along, corners[0], edge_along),
        (projected[0], across, corners[0], edge_across),
        (add(projected[0], along, 1.0), across, add(corners[0], edge_along, 1.0), edge_across),
        (add(projected[0], across, 1.0), along, add(corners[0], edge_across, 1.0), edge_along),
    ];
    for (projected_start, projected_edge, start, edge) in lines {
        for (q, side) in [(0, -1.0), (0, 1.0), (1, -1.0), (1, 1.0)] {
            if projected_edge[q].abs() <= TINY {
                continue;
            }
            let limit = size[q] * side;
            let fraction = (limit - projected_start[q]) * (1.0 / projected_edge[q]);
            let cross_coordinate = projected_start[1 - q] + projected_edge[1 - q] * fraction;
            let distance = (start[2] + edge[2] * fraction) * along_normal;
            if !(0.0..=1.0).contains(&fraction) || cross_coordinate.abs() > size[1 - q] || distance > margin {
                continue;
            }
            let mut at = add(start, edge, fraction).map(|x| 0.5 * x);
            at[q] += 0.5 * limit;
            at[1 - q] += 0.5 * cross_coordinate;
            add_contact(&mut contacts, at, distance);
        }
    }
    let crossings = contacts.count;

    // Corners of the rectangle inside the second face. The divisor is the area for the first corner, and later the
    // squared distance of the last accepted corner: a bug of MuJoCo 3.3.2, reproduced for equal results.
    let mut divisor = along[0] * across[1] - across[0] * along[1];
    for (cx, cy) in [(-lx, -ly), (-lx, ly), (lx, -ly), (lx, ly)] {
        let (x, y) = (cx - projected[0][0], cy - projected[0][1]);
        let u = (x * across[1] - y * across[0]) * (1.0 / divisor);
        let v = (y * along[0] - x * along[1]) * (1.0 / divisor);
        let outside = |fraction: f64| !(0.0..=1.0).contains(&fraction);
        if if crossings == 0 { outside(u) && outside(v) } else { outside(u) || outside(v) } {
            continue;
        }
        let (u, v) = (u.clamp(0.0, 1.0), v.clamp(0.0, 1.0));
        let over = add(add(corners[0].map(|p| p * (1.0 - u - v)), corners[1], u), corners[2], v);
        let gap = add([cx, cy, 0.0], over, -1.0);
        divisor = dot(gap, gap);
        if over[2] > 0.0 && divisor > margin * margin {
            continue;
        }
        add_contact(
            &mut contacts,
            add([cx, cy, 0.0], over, 1.0).map(|p| 0.5 * p),
            divisor.sqrt() * sign(over[2] >= 0.0),
        );
    }
    let with_corners = contacts.count;

    // Corners of the second face over the rectangle.
    for (at, below) in corners.into_iter().zip(projected) {
        let outside: [bool; 2] = std::array::from_fn(|q| below[q].abs() > size[q]);
        let skip = if crossings > 0 { outside[0] || outside[1] } else { with_corners > 0 && outside[0] && outside[1] };
        if skip {
            continue;
        }
        let inside: [f64; 2] = std::array::from_fn(|q| below[q].clamp(-size[q], size[q]));
        let beyond: f64 = (0..2).map(|q| (below[q] - inside[q]) * (below[q] - inside[q])).sum();
        let square = beyond + (at[2] * along_normal) * (at[2] * along_normal);
        if at[2] > 0.0 && square > margin * margin {
            continue;
        }
        let point = add([inside[0], inside[1], 0.0], at, 1.0).map(|p| 0.5 * p);
        add_contact(&mut contacts, point, square.sqrt() * sign(at[2] >= 0.0));
    }
    Some(contacts)
}
