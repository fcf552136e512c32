//! Contacts of two boxes that touch at their edges: the face of the first box that is most parallel to both edges, and
//! the face of the second box likewise; the second face is clipped by the first, along the normal.

use super::{BoxContacts, Edges, OrientedBox, TINY, Vector, add, dot, from_face_frame, sign, to_face_frame};

/// The two axes other than `i`, in the order in which MuJoCo resolves ties.
fn others(i: usize) -> [usize; 2] {
    [[1, 2], [0, 2], [1, 0]][i]
}

/// The contacts of two boxes at these edges; `None` where an edge is perpendicular to the faces.
#[allow(clippy::too_many_lines, reason = "follows one function of MuJoCo 3.3.2 statement by statement")]
pub fn edge_contacts(a: &OrientedBox, b: &OrientedBox, edges: &Edges, margin: f64) -> Option<BoxContacts> {
    let &Edges { along: [i, j], sides, normal, inward } = edges;
    let axes: [Vector; 3] = std::array::from_fn(|k| a.local_direction(b.axis(k)));
    // Of the two faces at each edge, the one that is more parallel to the other edge.
    let flat = |pair: [usize; 2], steep: &dyn Fn(usize) -> f64| {
        if steep(pair[0]) < steep(pair[1]) { [pair[1], pair[0]] } else { pair }
    };
    let [_, face] = flat(others(i), &|k| axes[j][k].abs());
    let [wide, up] = flat(others(j), &|k| axes[k][i].abs());
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
    let solid = [corner(near, 1.0), corner(near, -1.0), corner(!near, 1.0), corner(!near, -1.0)];
    // The second face, projected along the normal onto the plane of the first.
    let shadow = solid.map(|at| add(at, viewed_normal, -at[2] / viewed_normal[2]));
    let [along, across] = [1, 2].map(|k| add(shadow[k], shadow[0], -1.0));
    let [solid_along, solid_across] = [1, 2].map(|k| add(solid[k], solid[0], -1.0));

    let toward = a.world_direction(from_face_frame(face, outward, viewed_normal));
    let mut contacts = BoxContacts::new(toward.map(|x| x * sign(!inward)));
    let put = |contacts: &mut BoxContacts, mut at: Vector, distance: f64| {
        at[2] += height;
        contacts.add(add(a.world_direction(from_face_frame(face, outward, at)), a.center, 1.0), distance);
    };

    // Intersections of the second face's edges with the sides of the rectangle.
    let lines = [
        (shadow[0], along, solid[0], solid_along),
        (shadow[0], across, solid[0], solid_across),
        (add(shadow[0], along, 1.0), across, add(solid[0], solid_along, 1.0), solid_across),
        (add(shadow[0], across, 1.0), along, add(solid[0], solid_across, 1.0), solid_along),
    ];
    for (start, way, solid_start, solid_way) in lines {
        for (q, side) in [(0, -1.0), (0, 1.0), (1, -1.0), (1, 1.0)] {
            if way[q].abs() <= TINY {
                continue;
            }
            let limit = size[q] * side;
            let part = (limit - start[q]) * (1.0 / way[q]);
            let other = start[1 - q] + way[1 - q] * part;
            let distance = (solid_start[2] + solid_way[2] * part) * along_normal;
            if !(0.0..=1.0).contains(&part) || other.abs() > size[1 - q] || distance > margin {
                continue;
            }
            let mut at = add(solid_start, solid_way, part).map(|x| 0.5 * x);
            at[q] += 0.5 * limit;
            at[1 - q] += 0.5 * other;
            put(&mut contacts, at, distance);
        }
    }
    let crossings = contacts.count;

    // Corners of the rectangle inside the second face. The divisor is the area at first, and the squared distance of
    // the last accepted corner afterwards: a bug of MuJoCo 3.3.2, reproduced for equal results.
    let mut divisor = along[0] * across[1] - across[0] * along[1];
    for (cx, cy) in [(-lx, -ly), (-lx, ly), (lx, -ly), (lx, ly)] {
        let (x, y) = (cx - shadow[0][0], cy - shadow[0][1]);
        let u = (x * across[1] - y * across[0]) * (1.0 / divisor);
        let v = (y * along[0] - x * along[1]) * (1.0 / divisor);
        let outside = |part: f64| !(0.0..=1.0).contains(&part);
        if if crossings == 0 { outside(u) && outside(v) } else { outside(u) || outside(v) } {
            continue;
        }
        let (u, v) = (u.clamp(0.0, 1.0), v.clamp(0.0, 1.0));
        let over = add(add(solid[0].map(|p| p * (1.0 - u - v)), solid[1], u), solid[2], v);
        let gap = add([cx, cy, 0.0], over, -1.0);
        divisor = dot(gap, gap);
        if over[2] > 0.0 && divisor > margin * margin {
            continue;
        }
        put(&mut contacts, add([cx, cy, 0.0], over, 1.0).map(|p| 0.5 * p), divisor.sqrt() * sign(over[2] >= 0.0));
    }
    let with_corners = contacts.count;

    // Corners of the second face over the rectangle.
    for (at, below) in solid.into_iter().zip(shadow) {
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
        put(&mut contacts, point, square.sqrt() * sign(at[2] >= 0.0));
    }
    Some(contacts)
}
