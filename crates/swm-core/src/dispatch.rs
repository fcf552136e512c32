//! [`DispatchEnv`]: environments in other processes, which receive a call before the pool waits for any of them.

use crate::{Action, ResetOptions};

/// A call that an environment will receive next.
#[derive(Clone, Copy, Debug)]
pub enum PendingCall<'a> {
    /// [`crate::Env::reset`].
    Reset(u64, &'a ResetOptions),
    /// [`crate::Env::step`].
    Step(Action<'a>),
}

/// An environment that can start the work of a call before the call is made, such as one in a worker process.
pub trait DispatchEnv {
    /// Starts the work of `call` and returns whether it started, so that the call only has to wait for it.
    ///
    /// The caller makes exactly that call next, with no other call in between. Invalid arguments are errors of the call,
    /// not of this method.
    fn dispatch(&mut self, call: PendingCall<'_>) -> bool;
}
