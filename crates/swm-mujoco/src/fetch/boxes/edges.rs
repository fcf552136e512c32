//! Boxes that touch with edges: of the first box the face that lies along both edges, of the second one likewise; the second
//! clipped by the first, seen along the normal.

use super::{Edges, Solid, TINY, Touch, Vector, add, dot, facing, sign, unfacing};

/// The two axes that are not `i`, in the order in which ties are broken.
fn others(i: usize) -> [usize; 2] {
    [[1, 2], [0, 2], [1, 0]][i]
}

/// The contacts of two boxes that touch with these edges; `None` where the edges are across every face.
pub fn touch(a: &Solid, b: &Solid, edges: &Edges, margin: f64) -> Option<Touch> {
    let &Edges { along: [i, j], sides, normal, inward } = edges;
    let axes: [Vector; 3] = std::array::from_fn(|k| a.local(b.axis(k)));
    // Of the two faces at each edge, the one the other edge lies along.
    let flat = |pair: [usize; 2], steep: &dyn Fn(usize) -> f64| {
        if steep(pair[0]) < steep(pair[1]) { [pair[1], pair[0]] } else { pair }
    };
    let [_, face] = flat(others(i), &|k| axes[j][k].abs());
    let [wide, up] = flat(others(j), &|k| axes[k][i].abs());
    let outward = sides[0][face];
    let view = |v| facing(face, outward, v);

    // From here on the first box's face is the plane z = 0, and its rectangle is around the origin.
    let [lx, ly, height] = view(a.half).map(f64::abs);
    let size = [lx, ly];
    let normal_seen = view(normal);
    if normal_seen[2].abs() < TINY {
        return None;
    }
    let along_normal = sign(!inward) / normal_seen[2];
    let seen: [Vector; 3] = axes.map(view);
    let mut middle = view(a.local(add(b.at, a.at, -1.0)));
    middle[2] -= height;
    let corner = |across: bool, end: f64| {
        let at = add(middle, seen[wide], b.half[wide] * sign(across));
        add(add(at, seen[up], b.half[up] * sign(sides[1][up])), seen[j], b.half[j] * end)
    };
    let near = sides[1][wide];
    let solid = [corner(near, 1.0), corner(near, -1.0), corner(!near, 1.0), corner(!near, -1.0)];
    // The second face along the normal on the first one's plane.
    let shadow = solid.map(|at| add(at, normal_seen, -at[2] / normal_seen[2]));
    let [along, across] = [1, 2].map(|k| add(shadow[k], shadow[0], -1.0));
    let [solid_along, solid_across] = [1, 2].map(|k| add(solid[k], solid[0], -1.0));

    let toward = a.world(unfacing(face, outward, normal_seen));
    let mut touch = Touch::new(toward.map(|x| x * sign(!inward)));
    let put = |touch: &mut Touch, mut at: Vector, distance: f64| {
        at[2] += height;
        touch.add(add(a.world(unfacing(face, outward, at)), a.at, 1.0), distance);
    };

    // Where the second face's edges cross the rectangle's sides.
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
            put(&mut touch, at, distance);
        }
    }
    let crossings = touch.count;

    // The rectangle's corners in the second face. Its area divides, at first; after a corner was measured, the square of that
    // distance does: a slip of that version, kept because its numbers are the yardstick.
    let mut divisor = along[0] * across[1] - across[0] * along[1];
    for (cx, cy) in [(-lx, -ly), (-lx, ly), (lx, -ly), (lx, ly)] {
        let (x, y) = (cx - shadow[0][0], cy - shadow[0][1]);
        let u = (x * across[1] - y * across[0]) * (1.0 / divisor);
        let v = (y * along[0] - x * along[1]) * (1.0 / divisor);
        let out = |part: f64| !(0.0..=1.0).contains(&part);
        if if crossings == 0 { out(u) && out(v) } else { out(u) || out(v) } {
            continue;
        }
        let (u, v) = (u.clamp(0.0, 1.0), v.clamp(0.0, 1.0));
        let over = add(add(solid[0].map(|p| p * (1.0 - u - v)), solid[1], u), solid[2], v);
        let gap = add([cx, cy, 0.0], over, -1.0);
        divisor = dot(gap, gap);
        if over[2] > 0.0 && divisor > margin * margin {
            continue;
        }
        put(&mut touch, add([cx, cy, 0.0], over, 1.0).map(|p| 0.5 * p), divisor.sqrt() * sign(over[2] >= 0.0));
    }
    let with_corners = touch.count;

    // The second face's corners over the rectangle.
    for (at, below) in solid.into_iter().zip(shadow) {
        let out: [bool; 2] = std::array::from_fn(|q| below[q].abs() > size[q]);
        let skip = if crossings > 0 { out[0] || out[1] } else { with_corners > 0 && out[0] && out[1] };
        if skip {
            continue;
        }
        let inside: [f64; 2] = std::array::from_fn(|q| below[q].clamp(-size[q], size[q]));
        let beside: f64 = (0..2).map(|q| (below[q] - inside[q]) * (below[q] - inside[q])).sum();
        let square = beside + (at[2] * along_normal) * (at[2] * along_normal);
        if at[2] > 0.0 && square > margin * margin {
            continue;
        }
        put(&mut touch, add([inside[0], inside[1], 0.0], at, 1.0).map(|p| 0.5 * p), square.sqrt() * sign(at[2] >= 0.0));
    }
    Some(touch)
}
