//! [`DispatchEnv`]: environments in worker processes, which all receive a call before the pool waits for any result.

use crate::{Action, ResetOptions};

/// A call that an environment will receive next.
#[derive(Clone, Copy, Debug)]
pub enum PendingCall<'a> {
    /// [`crate::Env::reset`].
    Reset(u64, &'a ResetOptions),
    /// [`crate::Env::step`].
    Step(Action<'a>),
}

/// An environment that can start to execute a call before the caller waits for its result, such as one in a worker
/// process.
pub trait DispatchEnv {
    /// Starts to execute `call` and returns whether it started. The call itself, which follows, then only waits for the
    /// result.
    ///
    /// The caller makes exactly that call next, with no other call in between. Invalid arguments are reported by
    /// that call, not by this method.
    fn dispatch(&mut self, call: PendingCall<'_>) -> bool;
}
