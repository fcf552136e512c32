//! [`DispatchEnv`]: an environment that runs in a worker process. The pool dispatches a call to all worker processes
//! before it waits for the first result.

use crate::{Action, ResetOptions};

/// A call that an environment will receive next.
#[derive(Clone, Copy, Debug)]
pub enum PendingCall<'a> {
    /// A call of [`crate::Env::reset`].
    Reset(u64, &'a ResetOptions),
    /// A call of [`crate::Env::step`].
    Step(Action<'a>),
}

/// An environment that can start to execute a call before the caller waits for the result, such as an environment in a
/// worker process.
pub trait DispatchEnv {
    /// Starts to execute `call` and returns whether the execution started. If it started, the following call of
    /// [`crate::Env::reset`] or [`crate::Env::step`] only waits for the result.
    ///
    /// The caller makes exactly that call next. That call, not this method, reports invalid arguments.
    fn dispatch(&mut self, call: PendingCall<'_>) -> bool;
}
