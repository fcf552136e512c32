//! Reading, writing, saving and restoring the state of [`Physics`].

use super::simulation::{Derivation, Physics};
use super::state_layout::{STATE_FIELDS, check_finite, copy_state};
use swm_core::{Error, Result};

impl Physics {
    /// The length of the vector that [`Physics::state`] writes.
    pub fn state_len(&self) -> usize {
        self.source_state.len()
    }

    /// Writes the state: time, `qpos`, `qvel`, `act`, `qacc_warmstart`, `ctrl`, `eq_active`, `mocap_pos`, `mocap_quat`.
    ///
    /// # Shapes
    /// `into`: `[state_len]`.
    ///
    /// # Panics
    /// When `into` is shorter than [`Physics::state_len`].
    pub fn state(&self, into: &mut [f64]) {
        copy_state(&self.data, into);
    }

    /// Sets a state that [`Physics::state`] wrote and computes the derived quantities.
    ///
    /// # Errors
    /// When the length differs, or a value is not finite.
    pub fn set_state(&mut self, state: &[f64]) -> Result<()> {
        self.write_state(state)?;
        self.forward();
        Ok(())
    }

    /// Sets the state without the derived quantities.
    fn write_state(&mut self, state: &[f64]) -> Result<()> {
        if state.len() != self.state_len() {
            let (given, expected) = (format!("{} values", state.len()), self.state_len().to_string());
            return Err(Error::mismatch("restoring a MuJoCo state", given, expected));
        }
        check_finite("a MuJoCo state", state)?;
        self.reset();
        self.data.set_state(state, STATE_FIELDS).map_err(|error| Error::external("restoring a MuJoCo state", error))
    }

    /// The length of `qpos` and `qvel` together.
    pub fn pose_len(&self) -> usize {
        self.data.qpos().len() + self.data.qvel().len()
    }

    /// Sets `qpos` and `qvel`, keeps the other fields of the state, and computes the derived quantities.
    ///
    /// # Errors
    /// When the length differs, or a value is not finite.
    pub fn set_pose(&mut self, pose: &[f64]) -> Result<()> {
        if pose.len() != self.pose_len() {
            let (given, expected) = (format!("{} values", pose.len()), self.pose_len().to_string());
            return Err(Error::mismatch("setting qpos and qvel", given, expected));
        }
        check_finite("a MuJoCo state", pose)?;
        copy_state(&self.data, &mut self.source_state);
        self.source_state[1..=pose.len()].copy_from_slice(pose);
        self.reset();
        let set = self.data.set_state(&self.source_state, STATE_FIELDS);
        set.map_err(|error| Error::external("setting qpos and qvel", error))?;
        self.forward();
        Ok(())
    }

    /// The number of values that [`Physics::save`] appends.
    pub fn saved_len(&self) -> usize {
        self.source_state.len() + 2
    }

    /// Appends the state and the kind of call that computed the derived quantities, so that [`Physics::load`] restores
    /// the state and the derived quantities bit for bit.
    pub fn save(&self, into: &mut Vec<f64>) {
        into.push(f64::from(u8::from(self.unstable)));
        into.push(f64::from(self.derivation as u8));
        into.extend(&self.source_state);
    }

    /// The state in the values that [`Physics::save`] wrote, from which the derived quantities were computed.
    pub(crate) fn saved_state(saved: &[f64]) -> &[f64] {
        saved.get(2..).unwrap_or_default()
    }

    /// Restores the values that [`Physics::save`] wrote, on the same model with the same edits.
    ///
    /// # Errors
    /// When the values were not written by [`Physics::save`].
    pub fn load(&mut self, saved: &[f64]) -> Result<()> {
        let kinds = [Derivation::Forward, Derivation::ForwardPassive, Derivation::Step, Derivation::ControlStep];
        let split = saved.split_first_chunk::<2>();
        let decoded = split.and_then(|(&[unstable, kind], state)| {
            let derivation = kinds.into_iter().find(|&known| f64::from(known as u8) == kind)?;
            Some((unstable != 0.0, derivation, state))
        });
        let Some((unstable, derivation, state)) = decoded else {
            return Err(Error::mismatch("restoring a MuJoCo state", format!("{saved:?}"), "values that `save` wrote"));
        };
        self.write_state(state)?;
        self.set_derivation(derivation);
        self.derive();
        self.check_stability();
        self.unstable |= unstable;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::super::compile_xml;
    use super::*;
    use std::sync::Arc;

    /// A model with every field that a state has.
    const MODEL: &str = r#"<mujoco><worldbody>
        <body name="led" mocap="true" pos="1 2 3" quat="0 1 0 0"/>
        <body name="free"><freejoint/><geom size="0.1"/></body>
        <body name="arm" pos="0 0 1"><joint name="hinge"/><geom size="0.1" pos="1 0 0"/></body>
    </worldbody>
    <equality><weld body1="led" body2="free" active="false"/><joint joint1="hinge"/></equality>
    <actuator><general joint="hinge" dyntype="integrator"/><motor joint="hinge"/></actuator></mujoco>"#;

    #[test]
    fn state_equals_that_of_mj_get_state() {
        let model = compile_xml("a test's model", MODEL, &[]).expect("compiling the model");
        let mut physics = Physics::new(Arc::new(model)).expect("allocating the state");
        physics.data_mut().ctrl_mut().copy_from_slice(&[0.5, -0.25]);
        physics.step(3);
        let (mut ours, mut theirs) = (vec![f64::NAN; physics.state_len()], vec![0.0; physics.state_len()]);
        physics.state(&mut ours);
        assert_eq!(physics.data().read_state_into(STATE_FIELDS, &mut theirs), ours.len());
        assert_eq!(ours, theirs);
        assert!(
            [1, 2].map(|from_end| ours[ours.len() - 7 - from_end]) == [1.0, 0.0],
            "`eq_active` must be 0, 1: {ours:?}"
        );
    }
}
