//! The dynamics of MuJoCo 3.3.2, with which the reference's Fetch worlds were recorded, on the MuJoCo of today.
//!
//! Four things changed in between that show in these worlds within a few steps, and are changed back here between the
//! stages of a time step:
//!
//! 1. The reference acceleration of a weld now knows that its Jacobian turns. The gripper hangs on a weld.
//! 2. A mesh lying on a plane now touches it with four vertices, no longer three. The robot's base does.
//! 3. Boxes touch otherwise: see [`super::boxes`].
//! 4. Margins of two geoms are now added; the greater one counted.

use super::boxes::{Solid, touch};
use crate::physics::{Poses, Row, Stages, place};
use mujoco_rs::mujoco_c::mjContact;
use mujoco_rs::wrappers::MjModel;
use mujoco_rs::wrappers::mj_model::{MjtGeomBase, MjtObjBase};
use swm_core::Result;

/// The vertices of the base's mesh that touched the floor.
const FEET: [usize; 3] = [1751, 1782, 1806];

/// What is changed back.
pub struct Era {
    floor: usize,
    base: usize,
    feet: [[f64; 3]; 3],
    /// Every two boxes that can touch: their contact, but for where it is.
    boxes: Vec<mjContact>,
}

impl Era {
    /// For a model of Fetch.
    ///
    /// # Errors
    /// When the model is another one.
    pub fn new(model: &MjModel) -> Result<Self> {
        let base = place(model, MjtObjBase::mjOBJ_GEOM, "robot0:base_link")?;
        let first = whole(model.mesh_vertadr()[whole(model.geom_dataid()[base])]);
        let boxes =
            |geom: &usize| model.geom_type()[*geom] == MjtGeomBase::mjGEOM_BOX && model.geom_contype()[*geom] > 0;
        let boxes: Vec<usize> = (0..model.geom_type().len()).filter(boxes).collect();
        let pairs =
            boxes.iter().enumerate().flat_map(|(i, &first)| boxes[i + 1..].iter().map(move |&second| [first, second]));
        Ok(Self {
            floor: place(model, MjtObjBase::mjOBJ_GEOM, "floor0")?,
            base,
            feet: FEET.map(|foot| model.mesh_vert()[first + foot].map(f64::from)),
            boxes: pairs.filter(|&pair| meet(model, pair)).map(|pair| meeting(model, pair)).collect(),
        })
    }
}

fn whole(number: i32) -> usize {
    usize::try_from(number).unwrap_or(0)
}

/// Whether the model lets two geoms touch, in so far as it excludes pairs of bodies.
fn meet(model: &MjModel, pair: [usize; 2]) -> bool {
    let [first, second] = pair.map(|geom| model.geom_bodyid()[geom]);
    first != second && !model.exclude_signature().contains(&((first << 16) + second))
}

/// From how far on two geoms touch.
fn margin(model: &MjModel, pair: [usize; 2]) -> f64 {
    let [first, second] = pair.map(|geom| model.geom_margin()[geom]);
    first.max(second)
}

/// The contact of two geoms, but for where it is: the greater friction, and the mean of what the solver is told. The models give
/// all geoms the same priority and weight.
fn meeting(model: &MjModel, pair: [usize; 2]) -> mjContact {
    let [first, second] = pair;
    let mean = |a: f64, b: f64| 0.5 * (a + b);
    let friction = model.geom_friction();
    let [slide, spin, roll] = std::array::from_fn(|i| friction[first][i].max(friction[second][i]));
    let (references, impedances) = (model.geom_solref(), model.geom_solimp());
    let geom = pair.map(|geom| i32::try_from(geom).unwrap_or(-1));
    mjContact {
        dist: 0.0,
        pos: [0.0; 3],
        frame: [0.0; 9],
        includemargin: margin(model, pair),
        friction: [slide, slide, spin, roll, roll],
        solref: std::array::from_fn(|i| mean(references[first][i], references[second][i])),
        solreffriction: [0.0; 2],
        solimp: std::array::from_fn(|i| mean(impedances[first][i], impedances[second][i])),
        adhesion: 0.0,
        mu: 0.0,
        H: [0.0; 36],
        dim: model.geom_condim()[first].max(model.geom_condim()[second]),
        geom1: geom[0],
        geom2: geom[1],
        geom,
        flex: [-1; 2],
        elem: [-1; 2],
        vert: [-1; 2],
        exclude: 0,
        efc_address: -1,
    }
}

impl Stages for Era {
    fn collided(
        &self,
        model: &MjModel,
        (places, turns): Poses<'_>,
        found: &[mjContact],
        contacts: &mut Vec<mjContact>,
    ) {
        for pair in found.chunk_by(|a, b| a.geom == b.geom) {
            let geoms = pair[0].geom.map(whole);
            let margin = margin(model, geoms);
            if geoms == [self.floor, self.base] {
                let (at, turn) = (places[self.base], turns[self.base]);
                for foot in self.feet {
                    let [x, y, z] =
                        std::array::from_fn(|r| at[r] + (0..3).map(|c| turn[3 * r + c] * foot[c]).sum::<f64>());
                    if z < margin {
                        contacts.push(mjContact { pos: [x, y, 0.5 * z], dist: z, ..pair[0].clone() });
                    }
                }
            } else if geoms.iter().any(|&geom| model.geom_type()[geom] != MjtGeomBase::mjGEOM_BOX) {
                let near = pair.iter().filter(|contact| contact.dist < margin);
                contacts.extend(near.map(|contact| mjContact { includemargin: margin, ..contact.clone() }));
            }
        }
        // Boxes are looked at whether they were found to touch or not.
        let solid = |geom: usize| Solid { at: places[geom], turn: turns[geom], half: model.geom_size()[geom] };
        for like in &self.boxes {
            let [first, second] = like.geom.map(|geom| solid(whole(geom)));
            if let Some(touch) = touch(&first, &second, like.includemargin) {
                let frame = frame(touch.normal);
                let new = touch.places().iter().map(|&(pos, dist)| mjContact { pos, dist, frame, ..like.clone() });
                contacts.extend(new);
            }
        }
    }

    fn referred(&self, row: &Row) -> f64 {
        let [stiffness, damping, impedance, _] = row.kbip;
        -damping * row.velocity - stiffness * impedance * (row.position - row.margin)
    }
}

/// Axes of a contact: the normal, and two across it, chosen as MuJoCo does.
fn frame(x: [f64; 3]) -> [f64; 9] {
    let y = if x[1].abs() < 0.5 { [0.0, 1.0, 0.0] } else { [0.0, 0.0, 1.0] };
    let along: f64 = (0..3).map(|i| x[i] * y[i]).sum();
    let y: [f64; 3] = std::array::from_fn(|i| y[i] - along * x[i]);
    let length = y.iter().map(|v| v * v).sum::<f64>().sqrt();
    let y = y.map(|v| v / length);
    let z = [x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]];
    [x[0], x[1], x[2], y[0], y[1], y[2], z[0], z[1], z[2]]
}

#[cfg(test)]
mod tests {
    use super::super::kind::PUSH;
    use super::*;
    use crate::Physics;

    #[test]
    fn contacts_of_boxes_are_those_of_mujoco_but_for_their_places() {
        let setup = PUSH.setup().expect("the models");
        let mut physics = Physics::new(setup.model.clone()).expect("a state");
        physics.data_mut().qpos_mut().copy_from_slice(&setup.qpos);
        physics.forward();
        let era = Era::new(&setup.model).expect("Fetch");
        let found = physics.data().contact();
        let mut compared = 0;
        for ours in &era.boxes {
            for theirs in found.iter().filter(|contact| contact.geom == ours.geom) {
                let (dist, pos, frame) = (theirs.dist, theirs.pos, theirs.frame);
                let (mu, efc_address) = (theirs.mu, theirs.efc_address);
                let ours = mjContact { dist, pos, frame, mu, H: theirs.H, efc_address, ..ours.clone() };
                assert_eq!(format!("{ours:?}"), format!("{theirs:?}"));
                compared += 1;
            }
        }
        assert!(compared >= 4, "the block stands on the table: {compared}");
    }
}
