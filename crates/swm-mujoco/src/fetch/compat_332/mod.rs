//! Compatibility mode with MuJoCo 3.3.2, with which the reference's Fetch rollouts were recorded.
//!
//! Four later changes of MuJoCo become visible in these environments within a few steps. [`Compat332`] reverts them
//! between the stages of each time step:
//!
//! 1. The reference acceleration of a weld now includes the change of its Jacobian. The gripper is attached by a weld.
//! 2. A mesh on a plane now has four contact points instead of three. This concerns the base of the robot.
//! 3. Contacts of two boxes are computed differently: see [`box_contacts`].
//! 4. The margin of a pair of geoms is now the sum of their margins; in 3.3.2 it was the larger margin.

mod box_contacts;

use crate::physics::{EqualityRow, GeomPoses, StepHooks, index_of};
use box_contacts::{OrientedBox, box_contacts};
use mujoco_rs::mujoco_c::mjContact;
use mujoco_rs::wrappers::MjModel;
use mujoco_rs::wrappers::mj_model::{MjtGeomBase, MjtObjBase};
use swm_core::Result;

/// The vertices of the base's mesh that touch the floor in MuJoCo 3.3.2.
const BASE_VERTICES: [usize; 3] = [1751, 1782, 1806];

/// Step hooks that reproduce the dynamics of MuJoCo 3.3.2 for a model of Fetch.
pub struct Compat332 {
    floor: usize,
    base: usize,
    /// Positions of [`BASE_VERTICES`] in the frame of the base, in metres.
    base_vertices: [[f64; 3]; 3],
    /// A template contact for every pair of boxes that can collide; point, distance and frame are filled in per step.
    box_pairs: Vec<mjContact>,
}

impl Compat332 {
    /// Creates the hooks for a model of Fetch.
    ///
    /// # Errors
    /// When the model is not a model of Fetch.
    pub fn new(model: &MjModel) -> Result<Self> {
        let base = index_of(model, MjtObjBase::mjOBJ_GEOM, "robot0:base_link")?;
        let first = to_index(model.mesh_vertadr()[to_index(model.geom_dataid()[base])]);
        let is_box =
            |geom: &usize| model.geom_type()[*geom] == MjtGeomBase::mjGEOM_BOX && model.geom_contype()[*geom] > 0;
        let boxes: Vec<usize> = (0..model.geom_type().len()).filter(is_box).collect();
        let pairs =
            boxes.iter().enumerate().flat_map(|(i, &first)| boxes[i + 1..].iter().map(move |&second| [first, second]));
        Ok(Self {
            floor: index_of(model, MjtObjBase::mjOBJ_GEOM, "floor0")?,
            base,
            base_vertices: BASE_VERTICES.map(|vertex| model.mesh_vert()[first + vertex].map(f64::from)),
            box_pairs: pairs
                .filter(|&pair| can_collide(model, pair))
                .map(|pair| contact_template(model, pair))
                .collect(),
        })
    }
}

fn to_index(value: i32) -> usize {
    usize::try_from(value).unwrap_or(0)
}

/// Whether two geoms belong to different bodies that the model does not exclude from colliding.
fn can_collide(model: &MjModel, pair: [usize; 2]) -> bool {
    let [first, second] = pair.map(|geom| model.geom_bodyid()[geom]);
    first != second && !model.exclude_signature().contains(&((first << 16) + second))
}

/// The distance below which two geoms are in contact, in metres: the larger margin.
fn margin(model: &MjModel, pair: [usize; 2]) -> f64 {
    let [first, second] = pair.map(|geom| model.geom_margin()[geom]);
    first.max(second)
}

/// A contact of two geoms without point, distance and frame: the larger friction, and the mean of the solver
/// parameters. All geoms of the models have the same priority and mixing weight.
fn contact_template(model: &MjModel, pair: [usize; 2]) -> mjContact {
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

impl StepHooks for Compat332 {
    fn replace_contacts(
        &self,
        model: &MjModel,
        (positions, rotations): GeomPoses<'_>,
        found: &[mjContact],
        contacts: &mut Vec<mjContact>,
    ) {
        for pair in found.chunk_by(|a, b| a.geom == b.geom) {
            let geoms = pair[0].geom.map(to_index);
            let margin = margin(model, geoms);
            if geoms == [self.floor, self.base] {
                let (center, rotation) = (positions[self.base], rotations[self.base]);
                for vertex in self.base_vertices {
                    let [x, y, z] = std::array::from_fn(|r| {
                        center[r] + (0..3).map(|c| rotation[3 * r + c] * vertex[c]).sum::<f64>()
                    });
                    if z < margin {
                        contacts.push(mjContact { pos: [x, y, 0.5 * z], dist: z, ..pair[0].clone() });
                    }
                }
            } else if geoms.iter().any(|&geom| model.geom_type()[geom] != MjtGeomBase::mjGEOM_BOX) {
                let near = pair.iter().filter(|contact| contact.dist < margin);
                contacts.extend(near.map(|contact| mjContact { includemargin: margin, ..contact.clone() }));
            }
        }
        // Pairs of boxes are tested independently of the contacts that were found.
        let oriented = |geom: usize| OrientedBox {
            center: positions[geom],
            rotation: rotations[geom],
            half: model.geom_size()[geom],
        };
        for template in &self.box_pairs {
            let [first, second] = template.geom.map(|geom| oriented(to_index(geom)));
            if let Some(found) = box_contacts(&first, &second, template.includemargin) {
                let frame = contact_frame(found.normal);
                let new = found.points().iter().map(|&(pos, dist)| mjContact { pos, dist, frame, ..template.clone() });
                contacts.extend(new);
            }
        }
    }

    fn reference_acceleration(&self, row: &EqualityRow) -> f64 {
        let [stiffness, damping, impedance, _] = row.kbip;
        -damping * row.velocity - stiffness * impedance * (row.position - row.margin)
    }
}

/// The axes of a contact as rows: the normal, and two tangents chosen as MuJoCo does.
fn contact_frame(x: [f64; 3]) -> [f64; 9] {
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
    use super::super::config::PUSH;
    use super::*;
    use crate::Physics;

    #[test]
    fn contact_templates_of_boxes_have_the_parameters_of_mujoco() {
        let setup = PUSH.setup().expect("simulating the setup of FetchPush");
        let mut physics = Physics::new(setup.model.clone()).expect("allocating the state");
        physics.data_mut().qpos_mut().copy_from_slice(&setup.qpos);
        physics.forward();
        let compat = Compat332::new(&setup.model).expect("creating the step hooks");
        let found = physics.data().contact();
        let mut compared = 0;
        for ours in &compat.box_pairs {
            for theirs in found.iter().filter(|contact| contact.geom == ours.geom) {
                let (dist, pos, frame) = (theirs.dist, theirs.pos, theirs.frame);
                let (mu, efc_address) = (theirs.mu, theirs.efc_address);
                let ours = mjContact { dist, pos, frame, mu, H: theirs.H, efc_address, ..ours.clone() };
                assert_eq!(format!("{ours:?}"), format!("{theirs:?}"));
                compared += 1;
            }
        }
        assert!(compared >= 4, "the block on the table has four contacts: {compared}");
    }
}
