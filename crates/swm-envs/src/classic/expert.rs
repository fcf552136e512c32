//! Every world's controller, as the expert of its registry row.

use super::World;
use std::marker::PhantomData;
use swm_core::policy::Expert;
use swm_core::{Key, Result, RowRef};

/// Acts as [`World::control`] says for the columns `state`, `goal_state` and `physics`, and nothing else.
pub struct Controller<W>(PhantomData<fn() -> W>);

impl<W> Controller<W> {
    pub fn new() -> Self {
        Self(PhantomData)
    }
}

impl<W: World> Expert for Controller<W> {
    fn begin(&mut self, _key: Key) {}

    fn act(&mut self, row: RowRef<'_>, action: &mut [f64]) -> Result<()> {
        let world = W::new(row.get::<f32>("physics")?);
        let state = W::parse("state", &row.to_f64("state")?)?;
        let goal = W::parse("goal_state", &row.to_f64("goal_state")?)?;
        action[0] = world.control(&state, &goal);
        Ok(())
    }
}
