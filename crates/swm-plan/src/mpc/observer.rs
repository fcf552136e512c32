//! [`PlanObserver`]: reads the searches of a policy. [`BetweenIterations`]: all that happens between two iterations.

use std::ops::ControlFlow;
use swm_core::run::Interrupt;
use swm_core::{Iteration, Result, SearchObserver};

/// Reads the searches of a policy.
pub trait PlanObserver: SearchObserver + Send {
    /// Begins a search for the environments in `slots`.
    ///
    /// # Errors
    /// An error ends the search before it starts.
    fn begin(&self, slots: &[usize]) -> Result<()>;

    /// Ends the search.
    ///
    /// # Errors
    /// An error discards the plan.
    fn end(&self) -> Result<()>;
}

/// What happens between two iterations of a search: it may be interrupted, then an observer reads the iteration.
#[derive(Clone, Copy)]
pub struct BetweenIterations<'a> {
    /// Interrupts the search.
    pub interrupt: Option<&'a dyn Interrupt>,
    /// Reads the iterations.
    pub observer: Option<&'a dyn SearchObserver>,
}

impl BetweenIterations<'_> {
    /// This as the observer of a problem; `None` if nothing happens between iterations.
    pub fn observer(&self) -> Option<&dyn SearchObserver> {
        (self.interrupt.is_some() || self.observer.is_some()).then_some(self as _)
    }
}

impl SearchObserver for BetweenIterations<'_> {
    fn iteration(&self, iteration: &Iteration<'_>) -> Result<ControlFlow<()>> {
        self.interrupt.map_or(Ok(()), |interrupt| interrupt.check())?;
        self.observer.map_or(Ok(ControlFlow::Continue(())), |observer| observer.iteration(iteration))
    }
}
