//! The layout of a state vector: its fields and their order.

use mujoco_rs::mujoco_c::mjtState;
use mujoco_rs::wrappers::{MjData, MjModel};
use swm_core::{Error, Result};

/// The fields of a state, in this order: time, `qpos`, `qvel`, `act`, `qacc_warmstart`, `ctrl`, `eq_active`,
/// `mocap_pos`, `mocap_quat`. This is MuJoCo's integration state without applied forces, which no environment uses.
pub(super) const STATE_FIELDS: u32 = mjtState::mjSTATE_TIME as u32
    | mjtState::mjSTATE_QPOS as u32
    | mjtState::mjSTATE_QVEL as u32
    | mjtState::mjSTATE_ACT as u32
    | mjtState::mjSTATE_WARMSTART as u32
    | mjtState::mjSTATE_CTRL as u32
    | mjtState::mjSTATE_EQ_ACTIVE as u32
    | mjtState::mjSTATE_MOCAP_POS as u32
    | mjtState::mjSTATE_MOCAP_QUAT as u32;

/// The length of a state vector of this model ([`Physics::state`](super::Physics::state)).
pub fn state_len(model: &MjModel) -> usize {
    model.state_size(STATE_FIELDS)
}

/// Copies the fields of [`STATE_FIELDS`] to `into`. MuJoCo's `mj_getState` visits every possible field, which takes 2 %
/// of a step of a small model.
pub(super) fn copy_state(data: &MjData<Box<MjModel>>, into: &mut [f64]) {
    let mut rest = into;
    let mut append = |values: &[f64]| {
        let (target, after) = std::mem::take(&mut rest).split_at_mut(values.len());
        target.copy_from_slice(values);
        rest = after;
    };
    append(&[data.time()]);
    append(data.qpos());
    append(data.qvel());
    append(data.act());
    append(data.qacc_warmstart());
    append(data.ctrl());
    data.eq_active().iter().for_each(|&active| append(&[f64::from(u8::from(active))]));
    append(data.mocap_pos().as_flattened());
    append(data.mocap_quat().as_flattened());
}

/// Returns an error if a value is NaN or infinite. `what` names the vector in the error.
///
/// # Errors
/// When a value is not finite.
pub(crate) fn check_finite(what: &str, values: &[f64]) -> Result<()> {
    match values.iter().position(|value| !value.is_finite()) {
        None => Ok(()),
        Some(index) => Err(Error::NotFinite {
            what: what.to_owned(),
            given: format!("{} at index {index}", values[index]),
            fix: "take it from the `state` column of a recorded row".to_owned(),
        }),
    }
}
