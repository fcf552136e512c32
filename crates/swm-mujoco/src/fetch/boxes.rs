//! Where two boxes touch whose nearest parts are edges, as MuJoCo 3.3.2 decides and computes it.
//!
//! Later versions take faces for nearest where edges are so by a hair, and the contact's normal then jumps by a tenth of a
//! degree: enough to send a block elsewhere within 40 actions. What is done here: separating axes; the face of the first
//! box and the face of the second one that lie along the two edges; the second clipped by the first, seen along the normal.

pub type Vector = [f64; 3];

/// Below this a length is none.
const TINY: f64 = 1e-15;

/// How far from its surface, in parts of its size, a place is neither inside a box nor outside.
const SLACK: f64 = 0.01;

/// The most contacts of two boxes: two for each side of the rectangle on each edge, and all corners.
const MOST: usize = 24;

/// A box in the world.
#[derive(Clone, Copy)]
pub struct Solid {
    /// Its middle.
    pub at: Vector,
    /// Its orientation, row after row: columns are its axes.
    pub turn: [f64; 9],
    /// Half its sides.
    pub half: Vector,
}

/// The contacts of two boxes.
pub struct Touch {
    /// From the first box to the second.
    pub normal: Vector,
    places: [(Vector, f64); MOST],
    count: usize,
}

impl Touch {
    /// Where, and how far apart (negative: how deep).
    pub fn places(&self) -> &[(Vector, f64)] {
        &self.places[..self.count]
    }

    /// Drops places that are outside one box and not well inside the other.
    fn tidy(&mut self, a: &Solid, b: &Solid, margin: f64) {
        let mut kept = 0;
        for i in 0..self.count {
            let (place, _) = self.places[i];
            let depths = [a, b].map(|solid| solid.reach(place, margin));
            let bad = |one: f64, other: f64| one > 1.0 + SLACK && other >= 1.0 - SLACK;
            if !bad(depths[0], depths[1]) && !bad(depths[1], depths[0]) {
                self.places[kept] = self.places[i];
                kept += 1;
            }
        }
        self.count = kept;
    }

    fn add(&mut self, place: Vector, distance: f64) {
        if let Some(free) = self.places.get_mut(self.count) {
            *free = (place, distance);
            self.count += 1;
        }
    }
}

fn add(a: Vector, b: Vector, scale: f64) -> Vector {
    std::array::from_fn(|i| a[i] + scale * b[i])
}

fn dot(a: Vector, b: Vector) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn cross(a: Vector, b: Vector) -> Vector {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

impl Solid {
    fn axis(&self, i: usize) -> Vector {
        [self.turn[i], self.turn[3 + i], self.turn[6 + i]]
    }

    /// How far a place is from the middle: 1 on the surface, which `margin` moves outwards.
    fn reach(&self, place: Vector, margin: f64) -> f64 {
        let own = self.local(add(place, self.at, -1.0));
        (0..3).map(|i| own[i].abs() / (self.half[i] + margin)).fold(0.0, f64::max)
    }

    /// A direction of the world in the box's own axes.
    fn local(&self, v: Vector) -> Vector {
        std::array::from_fn(|i| dot(self.axis(i), v))
    }

    /// A direction of the box's own axes in the world.
    fn world(&self, v: Vector) -> Vector {
        std::array::from_fn(|r| dot([self.turn[3 * r], self.turn[3 * r + 1], self.turn[3 * r + 2]], v))
    }
}

/// The two edges between which the boxes overlap least.
struct Edges {
    /// The axis of the first box along its edge, and that of the second.
    along: [usize; 2],
    /// On which side of the boxes' other axes the edges lie.
    sides: [[bool; 3]; 2],
    /// Across both, in the first box's axes.
    normal: Vector,
    /// Whether the normal points to the first box.
    inward: bool,
}

/// The two axes that are not `i`, in the order in which ties are broken.
fn others(i: usize) -> [usize; 2] {
    [[1, 2], [0, 2], [1, 0]][i]
}

/// Finds the edges, if no face's axis separates as well; none where the boxes are further apart than `margin`.
fn edges(a: &Solid, b: &Solid, margin: f64) -> Option<Edges> {
    let apart = add(b.at, a.at, -1.0);
    let (from_a, from_b) = (a.local(apart), b.local(apart.map(|x| -x)));
    // Axes of the second box as the first one sees them.
    let axes: [Vector; 3] = std::array::from_fn(|j| a.local(b.axis(j)));
    let mut least = margin + 3.0 * (a.half.iter().sum::<f64>() + b.half.iter().sum::<f64>());
    for i in 0..3 {
        let shadow_b: f64 = (0..3).map(|j| axes[j][i].abs() * b.half[j]).sum();
        let shadow_a: f64 = (0..3).map(|j| axes[i][j].abs() * a.half[j]).sum();
        for overlap in [a.half[i] + shadow_b - from_a[i].abs(), b.half[i] + shadow_a - from_b[i].abs()] {
            if overlap < -margin {
                return None;
            }
            least = least.min(overlap);
        }
    }
    let mut found = None;
    for (i, j) in (0..3).flat_map(|i| (0..3).map(move |j| (i, j))) {
        let across = cross(std::array::from_fn(|k| f64::from(u8::from(k == i))), axes[j]);
        let length = dot(across, across).sqrt();
        if length < TINY {
            continue;
        }
        let normal = across.map(|x| x / length);
        let offset = dot(from_a, normal);
        let shadow_a: f64 = (0..3).filter(|&k| k != i).map(|k| a.half[k] * normal[k].abs()).sum();
        let shadow_b: f64 = (0..3).filter(|&k| k != j).map(|k| b.half[k] * axes[3 - k - j][i].abs() / length).sum();
        let overlap = shadow_a + shadow_b - offset.abs();
        if overlap < -margin {
            return None;
        }
        if overlap < least * (1.0 - 1e-12) {
            least = overlap;
            let inward = offset < 0.0;
            let side_a = |k: usize| k != i && (normal[k] > 0.0) != inward;
            let side_b = |k: usize| k != j && ((axes[3 - k - j][i] > 0.0) != inward) != ((k + 3 - j) % 3 == 1);
            let sides = [std::array::from_fn(side_a), std::array::from_fn(side_b)];
            found = Some(Edges { along: [i, j], sides, normal, inward });
        }
    }
    found
}

/// Turns directions so that the face at the positive or negative end of an axis looks along `z`.
fn facing(axis: usize, positive: bool, v: Vector) -> Vector {
    match (axis, positive) {
        (0, true) => [-v[2], v[1], v[0]],
        (1, true) => [v[0], -v[2], v[1]],
        (2, true) => v,
        (0, false) => [v[2], v[1], -v[0]],
        (1, false) => [v[0], v[2], -v[1]],
        (_, _) => [-v[0], v[1], -v[2]],
    }
}

/// Undoes [`facing`].
fn unfacing(axis: usize, positive: bool, v: Vector) -> Vector {
    match (axis, positive) {
        (0, true) => [v[2], v[1], -v[0]],
        (1, true) => [v[0], v[2], -v[1]],
        (2, true) => v,
        (0, false) => [-v[2], v[1], v[0]],
        (1, false) => [v[0], -v[2], v[1]],
        (_, _) => [-v[0], v[1], -v[2]],
    }
}

/// The contacts of two boxes that touch with edges; `None` where they touch with a face, or not at all.
pub fn touch(a: &Solid, b: &Solid, margin: f64) -> Option<Touch> {
    let Edges { along: [i, j], sides, normal, inward } = edges(a, b, margin)?;
    let axes: [Vector; 3] = std::array::from_fn(|k| a.local(b.axis(k)));
    let sign = |positive: bool| if positive { 1.0 } else { -1.0 };
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
    let mut touch = Touch { normal: toward.map(|x| x * sign(!inward)), places: [([0.0; 3], 0.0); MOST], count: 0 };
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
    touch.tidy(a, b, margin);
    Some(touch)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Boxes on the edge of a table and the contacts that MuJoCo 3.3.2 found: two boxes, the normal, places and distances.
    #[rustfmt::skip]
    #[allow(clippy::type_complexity)]
    fn recorded() -> [(Solid, Solid, Vector, Vec<(Vector, f64)>); 2] { [
        (
            Solid { at: [1.3, 0.75, 0.2], turn: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0], half: [0.25, 0.35, 0.2] },
            Solid { at: [1.2098408181413325, 0.4, 0.4078042959382722], turn: [0.9974973873577402, 0.04987876660607153, -0.05011058627016791, -0.054836995979690564, 0.993167823810557, -0.10300765806155457, 0.04463032698072352, 0.10549778381207725, 0.9934175111826518], half: [0.025, 0.025, 0.025] },
            [0.0, -0.10562926270422757, 0.9944055806664409],
            vec![([1.1860559068584318, 0.4009750744986419, 0.3908205406514098], -0.01846220400822407), ([1.187403117279295, 0.42795157745965096, 0.39224527228974493], -0.015596709956229297), ([1.237277986647182, 0.42532824742324815, 0.39336103046426296], -0.013352639335124539)],
        ),
        (
            Solid { at: [1.3, 0.75, 0.2], turn: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0], half: [0.25, 0.35, 0.2] },
            Solid { at: [1.4164430384293576, 1.1, 0.4114707546179414], turn: [-0.3864484694242245, -0.2594499628646019, 0.8850668320806239, -0.8405484329027533, 0.4940818743172233, -0.22217433113639767, -0.37965235732759556, -0.8298004689325842, -0.4090174438026617], half: [0.025, 0.025, 0.025] },
            [0.0, 0.859223235547094, 0.5116008517350057],
            vec![([1.4271603686242562, 1.0883804844570448, 0.39308147894215306], -0.02704655801249752), ([1.4224222484241524, 1.0928919888784758, 0.37524126765781535], -0.016545202288432415)],
        ),
    ] }

    #[test]
    fn edges_touch_as_then() {
        let near = |a: &[f64], b: &[f64]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-12);
        for (a, b, normal, places) in recorded() {
            let touch = touch(&a, &b, 0.0).expect("edges touch");
            assert!(near(&touch.normal, &normal), "{:?}", touch.normal);
            assert_eq!(touch.places().len(), places.len());
            for (ours, theirs) in touch.places().iter().zip(&places) {
                assert!(near(&ours.0, &theirs.0) && near(&[ours.1], &[theirs.1]), "{ours:?}, not {theirs:?}");
            }
        }
    }

    #[test]
    fn faces_are_left_to_others() {
        let flat = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
        let table = Solid { at: [0.0; 3], turn: flat, half: [1.0, 1.0, 0.2] };
        let block = |z| Solid { at: [0.1, 0.2, z], turn: flat, half: [0.1; 3] };
        assert!(touch(&table, &block(0.29), 0.0).is_none(), "it stands on a face");
        assert!(touch(&table, &block(0.31), 0.0).is_none(), "it is above");
    }
}
