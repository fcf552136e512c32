//! Where two boxes touch, as MuJoCo 3.3.2 decides and computes it.
//!
//! Later versions take faces for nearest where edges are so by a hair, and the contact's normal then jumps by a tenth of a
//! degree; and where an edge lies on a face they let the face beside it touch as well. Both send a block elsewhere within
//! 40 actions. What is done here: separating axes decide whether [`faces`] or [`edges`] touch.
//!
//! The distance of a contact on a face is half of how deep the boxes overlap there: a slip of that version, kept because its
//! numbers are the yardstick.

mod edges;
mod faces;

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

    fn new(normal: Vector) -> Self {
        Self { normal, places: [([0.0; 3], 0.0); MOST], count: 0 }
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

/// What lies across the axis along which two boxes overlap least.
enum Nearest {
    /// A face of one of them.
    Face(Face),
    /// An edge of each.
    Edges(Edges),
}

/// A face of a box.
struct Face {
    /// Whether it is the second box's.
    of_second: bool,
    axis: usize,
    /// At which end of the axis.
    positive: bool,
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

/// Finds where the boxes overlap least; none where they are further apart than `margin`.
fn nearest(a: &Solid, b: &Solid, margin: f64) -> Option<Nearest> {
    let apart = add(b.at, a.at, -1.0);
    let (from_a, from_b) = (a.local(apart), b.local(apart.map(|x| -x)));
    // Axes of the second box as the first one sees them.
    let axes: [Vector; 3] = std::array::from_fn(|j| a.local(b.axis(j)));
    let mut least = margin + 3.0 * (a.half.iter().sum::<f64>() + b.half.iter().sum::<f64>());
    let mut found = None;
    for axis in 0..3 {
        let shadow_b: f64 = (0..3).map(|j| axes[j][axis].abs() * b.half[j]).sum();
        let shadow_a: f64 = (0..3).map(|j| axes[axis][j].abs() * a.half[j]).sum();
        for (of_second, size, offset) in
            [(false, a.half[axis] + shadow_b, from_a[axis]), (true, b.half[axis] + shadow_a, from_b[axis])]
        {
            let overlap = size - offset.abs();
            if overlap < -margin {
                return None;
            }
            if overlap < least {
                least = overlap;
                found = Some(Nearest::Face(Face { of_second, axis, positive: offset >= 0.0 }));
            }
        }
    }
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
            found = Some(Nearest::Edges(Edges { along: [i, j], sides, normal, inward }));
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

/// The contacts of two boxes; `None` where they are further apart than `margin`.
pub fn touch(a: &Solid, b: &Solid, margin: f64) -> Option<Touch> {
    let mut touch = match nearest(a, b, margin)? {
        Nearest::Face(face) if face.of_second => faces::touch(b, a, &face, margin),
        Nearest::Face(face) => faces::touch(a, b, &face, margin),
        Nearest::Edges(edges) => edges::touch(a, b, &edges, margin)?,
    };
    touch.tidy(a, b, margin);
    Some(touch)
}

/// The sign of a side.
fn sign(positive: bool) -> f64 {
    if positive { 1.0 } else { -1.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two boxes, the margin, and the contacts that MuJoCo 3.3.2 found: the normal, places and distances. Two blocks on the edge of a
    /// table, a block on the table, and the edge of a finger on the block.
    #[rustfmt::skip]
    #[allow(clippy::type_complexity)]
    fn recorded() -> [(Solid, Solid, f64, Vector, Vec<(Vector, f64)>); 4] { [
        (
            Solid { at: [1.3, 0.75, 0.2], turn: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0], half: [0.25, 0.35, 0.2] },
            Solid { at: [1.2098408181413325, 0.4, 0.4078042959382722], turn: [0.9974973873577402, 0.04987876660607153, -0.05011058627016791, -0.054836995979690564, 0.993167823810557, -0.10300765806155457, 0.04463032698072352, 0.10549778381207725, 0.9934175111826518], half: [0.025, 0.025, 0.025] },
            0.0, [0.0, -0.10562926270422757, 0.9944055806664409],
            vec![([1.1860559068584318, 0.4009750744986419, 0.3908205406514098], -0.01846220400822407), ([1.187403117279295, 0.42795157745965096, 0.39224527228974493], -0.015596709956229297), ([1.237277986647182, 0.42532824742324815, 0.39336103046426296], -0.013352639335124539)],
        ),
        (
            Solid { at: [1.3, 0.75, 0.2], turn: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0], half: [0.25, 0.35, 0.2] },
            Solid { at: [1.4164430384293576, 1.1, 0.4114707546179414], turn: [-0.3864484694242245, -0.2594499628646019, 0.8850668320806239, -0.8405484329027533, 0.4940818743172233, -0.22217433113639767, -0.37965235732759556, -0.8298004689325842, -0.4090174438026617], half: [0.025, 0.025, 0.025] },
            0.0, [0.0, 0.859223235547094, 0.5116008517350057],
            vec![([1.4271603686242562, 1.0883804844570448, 0.39308147894215306], -0.02704655801249752), ([1.4224222484241524, 1.0928919888784758, 0.37524126765781535], -0.016545202288432415)],
        ),
        (
            Solid { at: [1.3, 0.75, 0.2], turn: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0], half: [0.25, 0.35, 0.2] },
            Solid { at: [1.2522102998042224, 0.7702269802615085, 0.42412199066107115], turn: [0.6244192627192344, -0.7810867332806334, 0.0020247069309812715, 0.7810888251280729, 0.6244137129798248, -0.0027860909524674046, 0.0009119239082154915, 0.0033211648163572536, 0.9999940691119362], half: [0.025, 0.025, 0.025] },
            0.0, [0.0, 0.0, 1.0],
            vec![([1.2560763688949828, 0.7351590690826227, 0.39950815585757926], -0.0004918441424208008), ([1.2872973320309447, 0.7742135103390264, 0.3995309539552846], -0.00046904604471541354), ([1.217022032230951, 0.766379754731614, 0.3995911849779882], -0.00040881502201186947), ([1.248242995366913, 0.8054341959880176, 0.3996139830756935], -0.0003860169243064822)],
        ),
        (
            Solid { at: [1.2981355815759374, 0.7817980743833232, 0.4478617801368972], turn: [-0.024432287090184756, 0.0012092323250069352, 0.9997007557788119, -0.00603830827201627, 0.9999808483119846, -0.0013571449651957972, -0.9996832509253898, -0.006069659498572777, -0.02442451745309403], half: [0.0385, 0.007, 0.0135] },
            Solid { at: [1.2522102998042224, 0.7702269802615085, 0.42412199066107115], turn: [0.6244192627192344, -0.7810867332806334, 0.0020247069309812715, 0.7810888251280729, 0.6244137129798248, -0.0027860909524674046, 0.0009119239082154915, 0.0033211648163572536, 0.9999940691119362], half: [0.025, 0.025, 0.025] },
            0.001, [-0.6244192627192345, -0.7810888251280731, -0.0009119239082154917],
            vec![([1.2850048384727835, 0.7752634795796199, 0.4490697714390081], -0.0005657545304693188), ([1.284300257627332, 0.775346786424612, 0.40974708406991667], -0.0009764976355795055)],
        ),
    ] }

    #[test]
    fn boxes_touch_as_then() {
        let near = |a: &[f64], b: &[f64]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-12);
        for (a, b, margin, normal, places) in recorded() {
            let touch = touch(&a, &b, margin).expect("they touch");
            assert!(near(&touch.normal, &normal), "{:?}", touch.normal);
            assert_eq!(touch.places().len(), places.len());
            for (ours, theirs) in touch.places().iter().zip(&places) {
                assert!(near(&ours.0, &theirs.0) && near(&[ours.1], &[theirs.1]), "{ours:?}, not {theirs:?}");
            }
        }
    }

    #[test]
    fn boxes_apart_do_not_touch() {
        let flat = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
        let table = Solid { at: [0.0; 3], turn: flat, half: [1.0, 1.0, 0.2] };
        let block = |z| Solid { at: [0.1, 0.2, z], turn: flat, half: [0.1; 3] };
        assert!(touch(&table, &block(0.31), 0.001).is_none());
        let deep = touch(&table, &block(0.299), 0.0).expect("it stands in the table");
        assert_eq!(deep.places().len(), 4);
        assert!(deep.places().iter().all(|(_, distance)| (distance + 0.0005).abs() < 1e-12), "{:?}", deep.places());
    }
}
