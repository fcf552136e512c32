//! [`Transport`]: how requests reach an environment, and the memory it answers in.

use crate::Description;
use swm_core::Error;

/// What is asked of an environment. Whatever it brings is in [`Transport::memory`] afterwards.
#[derive(Clone, Copy, Debug)]
pub enum Request<'a> {
    /// Start an episode; the arguments of `Bridge.reset` as JSON.
    Reset(&'a str),
    /// Take the action in the memory.
    Step,
    /// The same, and draw.
    DrawnStep,
    /// Draw.
    Render,
}

impl<'a> Request<'a> {
    /// The first argument of `Bridge.handle`.
    pub fn op(self) -> u8 {
        match self {
            Self::Reset(_) => b'r',
            Self::Step => b's',
            Self::DrawnStep => b'd',
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

/// Why a request brought nothing.
#[derive(Debug)]
pub enum Failure {
    /// It makes no sense to ask again: the id is unknown, a package is missing.
    Refused(Error),
    /// The environment raised; the traceback. Asking again would raise again.
    Raised(String),
    /// Whoever ran the environment is gone; how, and its last words. A new one may do better.
    Lost(String),
}

/// The way to one environment.
pub trait Transport: Send {
    /// Begins to make the environment anew, whatever became of the old one; need not wait for it.
    ///
    /// # Errors
    /// When there is nothing to make it with.
    fn restart(&mut self) -> Result<(), Failure>;

    /// What the environment is; waits until it is made. Called once after a new transport and after each restart.
    ///
    /// # Errors
    /// When it cannot be made.
    fn describe(&mut self) -> Result<Description, Failure>;

    /// Whether the environment works while nobody waits for it.
    fn apart(&self) -> bool {
        false
    }

    /// Asks without waiting, where the environment is apart; whether that went well. [`Transport::call`] with the same request
    /// follows and waits for the answer. Until then [`Transport::memory`] is empty.
    fn announce(&mut self, _request: Request<'_>) -> bool {
        false
    }

    /// Asks, unless that was announced, and waits for the answer.
    ///
    /// # Errors
    /// When the environment raises, or is gone.
    fn call(&mut self, request: Request<'_>) -> Result<(), Failure>;

    /// The buffer of the bridge, [`Description::size`] bytes; empty before [`Transport::describe`], after a loss, and while the
    /// environment works.
    fn memory(&self) -> &[u8];

    /// The same, to write actions into.
    fn memory_mut(&mut self) -> &mut [u8];
}
