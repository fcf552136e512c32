//! Contacts of two boxes, as MuJoCo 3.3.2 computes them.
//!
//! Later versions prefer a face to an edge pair of nearly equal overlap, which turns the contact normal by a tenth of a
//! degree; and where an edge lies on a face, they add contacts of the adjacent face. Each of these differences
//! changes the path of a block within 40 actions. Here, the separating axis test selects face contacts ([`faces`]) or
//! edge contacts ([`edges`]).
//!
//! The distance of a contact on a face is half the overlap: a bug of MuJoCo 3.3.2, reproduced for equal results.

mod edges;
mod faces;

pub type Vector = [f64; 3];

/// Lengths below this count as zero.
const TINY: f64 = 1e-15;

/// Relative distance from the surface within which a point counts as neither inside nor outside.
const SLACK: f64 = 0.01;

/// The maximal number of contacts of two boxes: 16 intersections of the edges of two faces, and 8 corners.
const MAX_CONTACTS: usize = 24;

/// A box in world coordinates.
#[derive(Clone, Copy)]
pub struct OrientedBox {
    /// The centre, in metres.
    pub center: Vector,
    /// The row-major rotation matrix; its columns are the axes of the box.
    pub rotation: [f64; 9],
    /// Half the side lengths, in metres.
    pub half: Vector,
}

/// The contacts of two boxes.
pub struct BoxContacts {
    /// The unit normal from the first box to the second.
    pub normal: Vector,
    points: [(Vector, f64); MAX_CONTACTS],
    count: usize,
}

impl BoxContacts {
    /// Contact points and their distances in metres (negative: overlap).
    pub fn points(&self) -> &[(Vector, f64)] {
        &self.points[..self.count]
    }

    fn new(normal: Vector) -> Self {
        Self { normal, points: [([0.0; 3], 0.0); MAX_CONTACTS], count: 0 }
    }

    /// Removes points that are outside one box and not inside the other by more than [`SLACK`].
    fn remove_outside(&mut self, a: &OrientedBox, b: &OrientedBox, margin: f64) {
        let mut count = 0;
        for i in 0..self.count {
            let (point, _) = self.points[i];
            let depths = [a, b].map(|solid| solid.relative_depth(point, margin));
            let outside = |first: f64, second: f64| first > 1.0 + SLACK && second >= 1.0 - SLACK;
            if !outside(depths[0], depths[1]) && !outside(depths[1], depths[0]) {
                self.points[count] = self.points[i];
                count += 1;
            }
        }
        self.count = count;
    }

    fn add(&mut self, point: Vector, distance: f64) {
        if let Some(free) = self.points.get_mut(self.count) {
            *free = (point, distance);
            self.count += 1;
        }
    }
}

/// `a + scale * b`.
fn add(a: Vector, b: Vector, scale: f64) -> Vector {
    std::array::from_fn(|i| a[i] + scale * b[i])
}

fn dot(a: Vector, b: Vector) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn cross(a: Vector, b: Vector) -> Vector {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

impl OrientedBox {
    fn axis(&self, i: usize) -> Vector {
        [self.rotation[i], self.rotation[3 + i], self.rotation[6 + i]]
    }

    /// The distance of a point from the centre in the maximum norm, relative to the surface (1), which `margin` moves
    /// outwards.
    fn relative_depth(&self, point: Vector, margin: f64) -> f64 {
        let local = self.local_direction(add(point, self.center, -1.0));
        (0..3).map(|i| local[i].abs() / (self.half[i] + margin)).fold(0.0, f64::max)
    }

    /// Rotates a direction from world axes to the axes of the box.
    fn local_direction(&self, v: Vector) -> Vector {
        std::array::from_fn(|i| dot(self.axis(i), v))
    }

    /// Rotates a direction from the axes of the box to world axes.
    fn world_direction(&self, v: Vector) -> Vector {
        std::array::from_fn(|r| dot([self.rotation[3 * r], self.rotation[3 * r + 1], self.rotation[3 * r + 2]], v))
    }
}

/// The features of the boxes on the axis of least overlap.
enum LeastOverlap {
    /// A face of one box.
    Face(Face),
    /// An edge of each box.
    Edges(Edges),
}

/// A face of a box.
struct Face {
    /// Whether the face belongs to the second box.
    of_second: bool,
    axis: usize,
    /// Whether the face is at the positive end of the axis.
    positive: bool,
}

/// The two edges between which the boxes overlap least.
struct Edges {
    /// For each box, the axis parallel to its edge.
    along: [usize; 2],
    /// For each box, whether its edge lies at the positive end of each of the two other axes.
    sides: [[bool; 3]; 2],
    /// The unit vector perpendicular to both edges, in the axes of the first box.
    normal: Vector,
    /// Whether the normal points to the first box.
    inward: bool,
}

/// Finds the axis of least overlap; `None` where the boxes are further apart than `margin` metres.
fn least_overlap(a: &OrientedBox, b: &OrientedBox, margin: f64) -> Option<LeastOverlap> {
    let apart = add(b.center, a.center, -1.0);
    let (from_a, from_b) = (a.local_direction(apart), b.local_direction(apart.map(|x| -x)));
    // The axes of the second box in the axes of the first.
    let axes: [Vector; 3] = std::array::from_fn(|j| a.local_direction(b.axis(j)));
    let mut least = margin + 3.0 * (a.half.iter().sum::<f64>() + b.half.iter().sum::<f64>());
    let mut found = None;
    for axis in 0..3 {
        let extent_b: f64 = (0..3).map(|j| axes[j][axis].abs() * b.half[j]).sum();
        let extent_a: f64 = (0..3).map(|j| axes[axis][j].abs() * a.half[j]).sum();
        for (of_second, size, offset) in
            [(false, a.half[axis] + extent_b, from_a[axis]), (true, b.half[axis] + extent_a, from_b[axis])]
        {
            let overlap = size - offset.abs();
            if overlap < -margin {
                return None;
            }
            if overlap < least {
                least = overlap;
                found = Some(LeastOverlap::Face(Face { of_second, axis, positive: offset >= 0.0 }));
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
        let extent_a: f64 = (0..3).filter(|&k| k != i).map(|k| a.half[k] * normal[k].abs()).sum();
        let extent_b: f64 = (0..3).filter(|&k| k != j).map(|k| b.half[k] * axes[3 - k - j][i].abs() / length).sum();
        let overlap = extent_a + extent_b - offset.abs();
        if overlap < -margin {
            return None;
        }
        if overlap < least * (1.0 - 1e-12) {
            least = overlap;
            let inward = offset < 0.0;
            let side_a = |k: usize| k != i && (normal[k] > 0.0) != inward;
            let side_b = |k: usize| k != j && ((axes[3 - k - j][i] > 0.0) != inward) != ((k + 3 - j) % 3 == 1);
            let sides = [std::array::from_fn(side_a), std::array::from_fn(side_b)];
            found = Some(LeastOverlap::Edges(Edges { along: [i, j], sides, normal, inward }));
        }
    }
    found
}

/// Rotates directions so that the face at the positive or negative end of an axis points along `z`.
fn to_face_frame(axis: usize, positive: bool, v: Vector) -> Vector {
    match (axis, positive) {
        (0, true) => [-v[2], v[1], v[0]],
        (1, true) => [v[0], -v[2], v[1]],
        (2, true) => v,
        (0, false) => [v[2], v[1], -v[0]],
        (1, false) => [v[0], v[2], -v[1]],
        (_, _) => [-v[0], v[1], -v[2]],
    }
}

/// The inverse of [`to_face_frame`].
fn from_face_frame(axis: usize, positive: bool, v: Vector) -> Vector {
    match (axis, positive) {
        (0, true) => [v[2], v[1], -v[0]],
        (1, true) => [v[0], v[2], -v[1]],
        (2, true) => v,
        (0, false) => [-v[2], v[1], v[0]],
        (1, false) => [v[0], -v[2], v[1]],
        (_, _) => [-v[0], v[1], -v[2]],
    }
}

/// The contacts of two boxes; `None` where they are further apart than `margin` metres.
pub fn box_contacts(a: &OrientedBox, b: &OrientedBox, margin: f64) -> Option<BoxContacts> {
    let mut contacts = match least_overlap(a, b, margin)? {
        LeastOverlap::Face(face) if face.of_second => faces::face_contacts(b, a, &face, margin),
        LeastOverlap::Face(face) => faces::face_contacts(a, b, &face, margin),
        LeastOverlap::Edges(edges) => edges::edge_contacts(a, b, &edges, margin)?,
    };
    contacts.remove_outside(a, b, margin);
    Some(contacts)
}

/// 1 for the positive side, -1 for the negative side.
fn sign(positive: bool) -> f64 {
    if positive { 1.0 } else { -1.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two boxes, the margin, and the contacts that MuJoCo 3.3.2 computed: normal, points and distances. The cases: two
    /// blocks on the edge of a table, a block on the table, and the edge of a finger on the block.
    #[rustfmt::skip]
    #[allow(clippy::type_complexity, reason = "a table of recorded values")]
    fn recorded() -> [(OrientedBox, OrientedBox, f64, Vector, Vec<(Vector, f64)>); 4] { [
        (
            OrientedBox { center: [1.3, 0.75, 0.2], rotation: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0], half: [0.25, 0.35, 0.2] },
            OrientedBox { center: [1.2098408181413325, 0.4, 0.4078042959382722], rotation: [0.9974973873577402, 0.04987876660607153, -0.05011058627016791, -0.054836995979690564, 0.993167823810557, -0.10300765806155457, 0.04463032698072352, 0.10549778381207725, 0.9934175111826518], half: [0.025, 0.025, 0.025] },
            0.0, [0.0, -0.10562926270422757, 0.9944055806664409],
            vec![([1.1860559068584318, 0.4009750744986419, 0.3908205406514098], -0.01846220400822407), ([1.187403117279295, 0.42795157745965096, 0.39224527228974493], -0.015596709956229297), ([1.237277986647182, 0.42532824742324815, 0.39336103046426296], -0.013352639335124539)],
        ),
        (
            OrientedBox { center: [1.3, 0.75, 0.2], rotation: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0], half: [0.25, 0.35, 0.2] },
            OrientedBox { center: [1.4164430384293576, 1.1, 0.4114707546179414], rotation: [-0.3864484694242245, -0.2594499628646019, 0.8850668320806239, -0.8405484329027533, 0.4940818743172233, -0.22217433113639767, -0.37965235732759556, -0.8298004689325842, -0.4090174438026617], half: [0.025, 0.025, 0.025] },
            0.0, [0.0, 0.859223235547094, 0.5116008517350057],
            vec![([1.4271603686242562, 1.0883804844570448, 0.39308147894215306], -0.02704655801249752), ([1.4224222484241524, 1.0928919888784758, 0.37524126765781535], -0.016545202288432415)],
        ),
        (
            OrientedBox { center: [1.3, 0.75, 0.2], rotation: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0], half: [0.25, 0.35, 0.2] },
            OrientedBox { center: [1.2522102998042224, 0.7702269802615085, 0.42412199066107115], rotation: [0.6244192627192344, -0.7810867332806334, 0.0020247069309812715, 0.7810888251280729, 0.6244137129798248, -0.0027860909524674046, 0.0009119239082154915, 0.0033211648163572536, 0.9999940691119362], half: [0.025, 0.025, 0.025] },
            0.0, [0.0, 0.0, 1.0],
            vec![([1.2560763688949828, 0.7351590690826227, 0.39950815585757926], -0.0004918441424208008), ([1.2872973320309447, 0.7742135103390264, 0.3995309539552846], -0.00046904604471541354), ([1.217022032230951, 0.766379754731614, 0.3995911849779882], -0.00040881502201186947), ([1.248242995366913, 0.8054341959880176, 0.3996139830756935], -0.0003860169243064822)],
        ),
        (
            OrientedBox { center: [1.2981355815759374, 0.7817980743833232, 0.4478617801368972], rotation: [-0.024432287090184756, 0.0012092323250069352, 0.9997007557788119, -0.00603830827201627, 0.9999808483119846, -0.0013571449651957972, -0.9996832509253898, -0.006069659498572777, -0.02442451745309403], half: [0.0385, 0.007, 0.0135] },
            OrientedBox { center: [1.2522102998042224, 0.7702269802615085, 0.42412199066107115], rotation: [0.6244192627192344, -0.7810867332806334, 0.0020247069309812715, 0.7810888251280729, 0.6244137129798248, -0.0027860909524674046, 0.0009119239082154915, 0.0033211648163572536, 0.9999940691119362], half: [0.025, 0.025, 0.025] },
            0.001, [-0.6244192627192345, -0.7810888251280731, -0.0009119239082154917],
            vec![([1.2850048384727835, 0.7752634795796199, 0.4490697714390081], -0.0005657545304693188), ([1.284300257627332, 0.775346786424612, 0.40974708406991667], -0.0009764976355795055)],
        ),
    ] }

    #[test]
    fn contacts_equal_those_of_mujoco_332() {
        let near = |a: &[f64], b: &[f64]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-12);
        for (a, b, margin, normal, points) in recorded() {
            let contacts = box_contacts(&a, &b, margin).expect("the boxes touch");
            assert!(near(&contacts.normal, &normal), "{:?}", contacts.normal);
            assert_eq!(contacts.points().len(), points.len());
            for (ours, theirs) in contacts.points().iter().zip(&points) {
                assert!(near(&ours.0, &theirs.0) && near(&[ours.1], &[theirs.1]), "{ours:?}, not {theirs:?}");
            }
        }
    }

    #[test]
    fn separated_boxes_have_no_contacts() {
        let flat = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
        let table = OrientedBox { center: [0.0; 3], rotation: flat, half: [1.0, 1.0, 0.2] };
        let block = |z| OrientedBox { center: [0.1, 0.2, z], rotation: flat, half: [0.1; 3] };
        assert!(box_contacts(&table, &block(0.31), 0.001).is_none());
        let deep = box_contacts(&table, &block(0.299), 0.0).expect("the boxes overlap");
        assert_eq!(deep.points().len(), 4);
        assert!(deep.points().iter().all(|(_, distance)| (distance + 0.0005).abs() < 1e-12), "{:?}", deep.points());
    }
}
