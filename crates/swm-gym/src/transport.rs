//! [`Transport`]: sends requests to an environment and holds the memory that the environment writes results into.

use crate::Description;
use swm_core::Error;

/// A request to an environment. The environment writes the results into [`Transport::memory`].
#[derive(Clone, Copy, Debug)]
pub enum Request<'a> {
    /// Start an episode; the arguments of `Bridge.reset` as JSON.
    Reset(&'a str),
    /// Take the action in the memory.
    Step,
    /// Take the action in the memory and render.
    StepAndRender,
    /// Render.
    Render,
}

impl<'a> Request<'a> {
    /// The first argument of `Bridge.handle`.
    pub fn op(self) -> u8 {
        match self {
            Self::Reset(_) => b'r',
            Self::Step => b's',
            Self::StepAndRender => b'd',
            Self::Render => b'p',
        }
    }

    /// The second argument of `Bridge.handle`.
    pub fn payload(self) -> &'a [u8] {
        match self {
            Self::Reset(arguments) => arguments.as_bytes(),
            _ => &[],
        }
    }
}

/// The reason for which a request failed.
#[derive(Debug)]
pub enum Failure {
    /// A repeated request would fail in the same way, for example because the id is unknown or a package is missing.
    Refused(Error),
    /// The environment raised an exception; the text is the traceback. A repeated request would raise it again.
    Raised(String),
    /// The worker process is lost; the text describes its end and contains its last output. A new worker may succeed.
    Lost(String),
}

/// The number of lines at the end of a traceback that an error shows.
const LINES: usize = 12;

impl Failure {
    /// Converts the failure into an error. `id` names the environment and `what` the failed call; `lost` is the number of
    /// replaced workers.
    pub(crate) fn explain(self, id: &str, what: &str, lost: usize) -> Error {
        match self {
            Self::Refused(error) => error,
            Self::Raised(traceback) => {
                let lines: Vec<&str> = traceback.trim_end().lines().collect();
                let end = &lines[lines.len().saturating_sub(LINES)..];
                Error::external(format!("{id}: {what} raised"), end.join("\n"))
            }
            Self::Lost(how) if lost == 0 => Error::external(format!("{id}: {what} failed"), how),
            Self::Lost(how) => Error::external(format!("{id}: {what} failed in {} workers in a row", lost + 1), how),
        }
    }
}

/// The connection to one environment.
pub trait Transport: Send {
    /// Discards the environment in any state, and starts to make a new one without waiting for it.
    ///
    /// # Errors
    /// When no worker can be started.
    fn restart(&mut self) -> Result<(), Failure>;

    /// Waits until the environment is made and returns its description. Called once for a new transport and after each
    /// restart.
    ///
    /// # Errors
    /// When the environment cannot be made.
    fn describe(&mut self) -> Result<Description, Failure>;

    /// Whether the environment runs in another process, in parallel with the caller.
    fn runs_in_parallel(&self) -> bool {
        false
    }

    /// Sends a request without waiting, if the environment runs in parallel, and returns whether it was sent.
    /// [`Transport::call`] with the same request follows and waits for the answer. Until then [`Transport::memory`] is
    /// empty.
    fn dispatch(&mut self, _request: Request<'_>) -> bool {
        false
    }

    /// Sends a request, unless it was dispatched, and waits for the answer.
    ///
    /// # Errors
    /// When the environment raises, or its worker is lost.
    fn call(&mut self, request: Request<'_>) -> Result<(), Failure>;

    /// The buffer of the bridge, [`Description::size`] bytes; empty before [`Transport::describe`], after a loss, and
    /// while a dispatched request runs.
    fn memory(&self) -> &[u8];

    /// The buffer of the bridge, for writing actions.
    fn memory_mut(&mut self) -> &mut [u8];
}
