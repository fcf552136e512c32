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
}

impl Era {
    /// For a model of Fetch.
    ///
    /// # Errors
    /// When the model is another one.
    pub fn new(model: &MjModel) -> Result<Self> {
        let base = place(model, MjtObjBase::mjOBJ_GEOM, "robot0:base_link")?;
        let whole = |number: i32| usize::try_from(number).unwrap_or(0);
        let first = whole(model.mesh_vertadr()[whole(model.geom_dataid()[base])]);
        Ok(Self {
            floor: place(model, MjtObjBase::mjOBJ_GEOM, "floor0")?,
            base,
            feet: FEET.map(|foot| model.mesh_vert()[first + foot].map(f64::from)),
        })
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
        let solid = |geom: usize| Solid { at: places[geom], turn: turns[geom], half: model.geom_size()[geom] };
        let is_box = |geom: usize| model.geom_type()[geom] == MjtGeomBase::mjGEOM_BOX;
        for pair in found.chunk_by(|a, b| a.geom == b.geom) {
            let [first, second] = pair[0].geom.map(|geom| usize::try_from(geom).unwrap_or(0));
            let margin = model.geom_margin()[first].max(model.geom_margin()[second]);
            let like = mjContact { includemargin: margin, ..pair[0].clone() };
            if [first, second] == [self.floor, self.base] {
                let (at, turn) = (places[self.base], turns[self.base]);
                for foot in self.feet {
                    let [x, y, z] =
                        std::array::from_fn(|r| at[r] + (0..3).map(|c| turn[3 * r + c] * foot[c]).sum::<f64>());
                    if z < margin {
                        contacts.push(mjContact { pos: [x, y, 0.5 * z], dist: z, ..like.clone() });
                    }
                }
            } else if !(is_box(first) && is_box(second)) {
                let near = pair.iter().filter(|contact| contact.dist < margin);
                contacts.extend(near.map(|contact| mjContact { includemargin: margin, ..contact.clone() }));
            } else if let Some(touch) = touch(&solid(first), &solid(second), margin) {
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
