//! [`Controller`]: the expert of every classic-control environment.

use super::task::ControlTask;
use std::marker::PhantomData;
use swm_core::columns::{GOAL_STATE, STATE};
use swm_core::policy::Expert;
use swm_core::{Key, Result, RowRef};

/// An expert that acts by [`ControlTask::control`]. It reads only the columns `state`, `goal_state` and `physics`.
pub struct Controller<T>(PhantomData<fn() -> T>);

impl<T> Controller<T> {
    /// Makes a controller.
    pub fn new() -> Self {
        Self(PhantomData)
    }
}

impl<T: ControlTask> Expert for Controller<T> {
    fn begin(&mut self, _key: Key) {}

    fn act(&mut self, row: RowRef<'_>, action: &mut [f64]) -> Result<()> {
        let task = T::new(row.get::<f32>("physics")?);
        let state = T::parse_state(STATE, &row.to_f64(STATE)?)?;
        let goal = T::parse_state(GOAL_STATE, &row.to_f64(GOAL_STATE)?)?;
        action[0] = task.control(&state, &goal);
        Ok(())
    }
}
