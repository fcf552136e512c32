//! Resets, forward computations and time steps of [`Physics`].
#![allow(unsafe_code, reason = "calls of MuJoCo's functions on the model and data that `Physics` owns")]

use super::hooks::{EqualityRow, StepHooks};
use super::simulation::{Derivation, Physics};
use super::state_layout::copy_state;
use crate::ffi;
use mujoco_rs::mujoco_c::{mjContact, mjData, mjModel, mjtConstraint, mjtDisableBit, mjtIntegrator};
use std::sync::Arc;

impl Physics {
    /// Sets the model's initial state and clears the instability flag. Derived quantities are zero until
    /// [`Physics::forward`].
    pub fn reset(&mut self) {
        self.unstable = false;
        let (model, data) = self.pointers();
        // SAFETY: model and data are valid and belong together.
        self.guarded("resetting", || unsafe { ffi::mj_resetData(model, data) });
    }

    /// Computes all derived quantities (`mj_forward`) without advancing time.
    pub fn forward(&mut self) {
        self.set_derivation(Derivation::Forward);
        self.derive();
    }

    /// As [`Physics::forward`], with actuators disabled.
    pub fn forward_passive(&mut self) {
        self.set_derivation(Derivation::ForwardPassive);
        self.derive();
    }

    /// Advances `steps` time steps, at least one, each with `mj_step`: derived quantities lag the state by one step, as
    /// in Gymnasium.
    pub fn step(&mut self, steps: usize) {
        for _ in 1..steps {
            self.step_once();
        }
        self.set_derivation(Derivation::Step);
        self.derive();
        self.check_stability();
    }

    /// Advances `steps` time steps, at least one, as DeepMind Control does. The previous call has computed the first
    /// half of the first step, up to the controls; poses and velocities are up to date afterwards.
    pub fn step_control(&mut self, steps: usize) {
        // RK4 cannot be split into two halves.
        let whole_steps = self.model().opt().integrator == mjtIntegrator::mjINT_RK4 as i32;
        for i in 0..steps {
            if i + 1 == steps {
                self.set_derivation(Derivation::ControlStep);
            }
            let (model, data) = self.pointers();
            // SAFETY: model and data are valid and belong together.
            self.guarded("stepping", || unsafe {
                if i == 0 && !whole_steps {
                    ffi::mj_step2(model, data);
                } else {
                    ffi::mj_step(model, data);
                }
            });
        }
        let (model, data) = self.pointers();
        // SAFETY: model and data are valid and belong together.
        self.guarded("stepping", || unsafe { ffi::mj_step1(model, data) });
        self.check_stability();
    }

    /// Computes the external forces on bodies (`cfrc_ext`) of the last step. [`Physics::save`] does not store them.
    pub fn contact_forces(&mut self) {
        let (model, data) = self.pointers();
        // SAFETY: model and data are valid and belong together.
        self.guarded("computing contact forces", || unsafe { ffi::mj_rnePostConstraint(model, data) });
    }

    /// Stores the present state as the state from which `derivation` computes the derived quantities.
    pub(super) fn set_derivation(&mut self, derivation: Derivation) {
        copy_state(&self.data, &mut self.source_state);
        self.derivation = derivation;
    }

    /// Runs the stored derivation.
    pub(super) fn derive(&mut self) {
        let (model, data) = self.pointers();
        match self.derivation {
            Derivation::Forward => {
                // SAFETY: model and data are valid and belong together.
                self.guarded("computing derived quantities", || unsafe { ffi::mj_forward(model, data) })
            }
            Derivation::ForwardPassive => {
                let flags = self.data.model_opt().disableflags;
                self.data.model_opt_mut().disableflags = flags | mjtDisableBit::mjDSBL_ACTUATION as i32;
                let (model, data) = self.pointers();
                // SAFETY: model and data are valid and belong together.
                let done = self.guarded("computing derived quantities", || unsafe { ffi::mj_forward(model, data) });
                self.data.model_opt_mut().disableflags = flags;
                done
            }
            Derivation::Step => self.step_once(),
            // SAFETY: model and data are valid and belong together.
            Derivation::ControlStep => self.guarded("stepping", || unsafe {
                ffi::mj_step(model, data);
                ffi::mj_step1(model, data);
            }),
        };
    }

    /// Advances one time step, with the hooks if there are any. `None` after an error.
    fn step_once(&mut self) -> Option<()> {
        let (model, data) = self.pointers();
        let Some(hooks) = self.hooks.clone() else {
            // SAFETY: model and data are valid and belong together.
            return self.guarded("stepping", || unsafe { ffi::mj_step(model, data) });
        };
        // SAFETY: model and data are valid and belong together; the calls are those of `mj_step`, in its order.
        self.guarded("stepping", || unsafe {
            ffi::mj_checkPos(model, data);
            ffi::mj_checkVel(model, data);
        })?;
        self.forward_with_hooks(&hooks)?;
        // SAFETY: model and data are valid and belong together; the calls are those of `mj_step`, in its order.
        self.guarded("stepping", || unsafe {
            ffi::mj_checkAcc(model, data);
            ffi::mj_Euler(model, data);
        })
    }

    /// Runs the stages of `mj_forward` with the hooks between them.
    fn forward_with_hooks(&mut self, hooks: &Arc<dyn StepHooks>) -> Option<()> {
        let (model, data) = self.pointers();
        // SAFETY: model and data are valid and belong together; the calls are those of `mj_forward`, in its order.
        self.guarded("computing poses", || unsafe {
            ffi::mj_kinematics(model, data);
            ffi::mj_comPos(model, data);
            ffi::mj_camlight(model, data);
            ffi::mj_flex(model, data);
            ffi::mj_tendon(model, data);
            ffi::mj_makeM(model, data);
            ffi::mj_factorM(model, data);
            ffi::mj_collision(model, data);
        })?;
        self.contacts.clear();
        let poses = (self.data.geom_xpos(), self.data.geom_xmat());
        // SAFETY: `contact` points to `ncon` contacts, which stay unchanged during this borrow.
        let found = unsafe { array((*data).contact, (*data).ncon) };
        hooks.replace_contacts(self.data.model(), poses, found, &mut self.contacts);
        let contacts = std::mem::take(&mut self.contacts);
        let (model, data) = self.pointers();
        // SAFETY: model and data are valid and belong together, the hooks return contacts between geoms of this model, and
        // the reference accelerations are replaced when constraints and velocities are computed.
        let done = self.guarded("computing constraints", || unsafe {
            write_contacts(model, data, &contacts);
            ffi::mj_makeConstraint(model, data);
            ffi::mj_island(model, data);
            ffi::mj_projectConstraint(model, data);
            ffi::mj_transmission(model, data);
            ffi::mj_sensorPos(model, data);
            ffi::mj_fwdVelocity(model, data);
            ffi::mj_sensorVel(model, data);
            replace_reference_accelerations(data, &**hooks);
            ffi::mj_fwdActuation(model, data);
            ffi::mj_fwdAcceleration(model, data);
            ffi::mj_fwdConstraint(model, data);
            ffi::mj_sensorAcc(model, data);
        });
        self.contacts = contacts;
        done
    }
}

/// A slice over an array that MuJoCo owns.
///
/// # Safety
/// `first` must be null or point to `count` values that do not change while the slice is borrowed.
unsafe fn array<'a, T>(first: *const T, count: i32) -> &'a [T] {
    let count = usize::try_from(count).unwrap_or(0);
    // SAFETY: guaranteed by the caller; null pointers and empty arrays are not dereferenced.
    if first.is_null() || count == 0 { &[] } else { unsafe { std::slice::from_raw_parts(first, count) } }
}

/// Replaces the contacts that MuJoCo found: overwrites as many as were found, and adds further contacts, for which
/// MuJoCo allocates memory.
///
/// # Safety
/// Model and data must be valid and belong together, and the contacts must be between geoms of the model.
unsafe fn write_contacts(model: *const mjModel, data: *mut mjData, contacts: &[mjContact]) {
    // SAFETY: guaranteed by the caller; `contact` has room for the `ncon` contacts that were found, and `mj_addContact`
    // allocates behind the first `ncon`.
    unsafe {
        let found = usize::try_from((*data).ncon).unwrap_or(0);
        let (overwriting, further) = contacts.split_at(contacts.len().min(found));
        for (i, contact) in overwriting.iter().enumerate() {
            (*data).contact.add(i).write(contact.clone());
        }
        (*data).ncon = i32::try_from(overwriting.len()).unwrap_or(0);
        for contact in further {
            ffi::mj_addContact(model, data, contact);
        }
    }
}

/// Replaces the reference accelerations of all equality constraints.
///
/// # Safety
/// `data` must be valid, with its constraints and velocities computed.
unsafe fn replace_reference_accelerations(data: *mut mjData, hooks: &dyn StepHooks) {
    // SAFETY: guaranteed by the caller; all arrays have `nefc` rows, `efc_KBIP` with four values each.
    unsafe {
        for (row, kind) in array((*data).efc_type, (*data).nefc).iter().enumerate() {
            if *kind == mjtConstraint::mjCNSTR_EQUALITY as i32 {
                let at = |values: *mut f64| *values.add(row);
                let equality = EqualityRow {
                    kbip: *(*data).efc_KBIP.add(4 * row).cast(),
                    position: at((*data).efc_pos),
                    margin: at((*data).efc_margin),
                    velocity: at((*data).efc_vel),
                };
                *(*data).efc_aref.add(row) = hooks.reference_acceleration(&equality);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::compile_xml;
    use super::*;

    #[test]
    fn actuators_stay_enabled_after_an_error_in_forward_passive() {
        let xml = r#"<mujoco><worldbody><body><joint name="hinge"/><geom size="0.1" pos="1 0 0"/></body></worldbody>
            <equality><joint joint1="hinge"/></equality></mujoco>"#;
        let model = compile_xml("a test's model", xml, &[]).expect("compiling the model");
        let mut physics = Physics::new(Arc::new(model)).expect("allocating the state");
        let flags = physics.model().opt().disableflags;
        physics.model_mut().opt_mut().solver = 99;
        physics.forward_passive();
        assert!(physics.is_unstable(), "MuJoCo knows no solver 99");
        assert_eq!(physics.model().opt().disableflags, flags);
    }
}
