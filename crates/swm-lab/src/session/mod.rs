//! A live environment behind a WebSocket.
//!
//! The environment lives on a thread of its own, which ends when the socket closes. Frames go through a slot that holds the
//! newest one only, and at most [`IN_FLIGHT`] frames are sent before the page says that it has shown one, so that a slow page
//! drops frames and takes no memory.

pub mod messages;
mod player;
mod recorder;
mod socket;

pub use player::Player;
pub use socket::run;

use crate::Lab;
use messages::Reply;
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc::Receiver;
use swm_core::{EnvChoice, Error, Result};
use tokio::sync::{mpsc, watch};

/// Frames that are sent before the page has shown one.
const IN_FLIGHT: usize = 2;
/// Environments that run at the same time.
const MOST: usize = 32;
/// Environments that are planned in at the same time: each may hold a model and a tree of steps.
const MOST_PLANS: usize = 8;
/// The longest message of a page, in bytes.
pub const MOST_BYTES: usize = 16 << 10;
/// The largest seed, which every dataset can store.
const LARGEST_SEED: u64 = i64::MAX as u64;
/// Malformed messages after which a socket is closed.
const MOST_MALFORMED: usize = 64;

/// A frame and what it shows.
#[derive(Clone, Debug, Default)]
pub struct Frame {
    /// The length of the header as a little-endian `u32`, the header as JSON, then the frame as JPEG.
    pub bytes: Vec<u8>,
}

/// What a session plays.
#[derive(Clone)]
pub struct Setup {
    /// The environment.
    pub env: EnvChoice,
    /// The side of frames in pixels.
    pub side: usize,
}

/// What a page and its environment do over a socket.
pub trait Session: 'static {
    /// A message of the page.
    type Request: DeserializeOwned + Send + 'static;
    /// Whether it plans.
    const IS_PLAN: bool;

    /// How the socket treats a message.
    fn kind(request: &Self::Request) -> Kind;

    /// Answers messages on this thread, until the page is gone.
    ///
    /// # Errors
    /// When the session cannot start.
    fn play(lab: &Lab, setup: Setup, out: Out, requests: &Receiver<Self::Request>) -> Result<()>;
}

/// How a socket treats a message of the page.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// It waits for its turn.
    Ordered,
    /// It waits for its turn, unless too many do: the next one replaces it.
    Replaceable,
    /// The page has shown a frame. The session does not receive it.
    Shown,
    /// It ends the search that is under way at once. The session does not receive it.
    EndsSearch,
}

/// The ways out of the thread of a session, and what reaches it outside of the order of messages.
#[derive(Clone)]
pub struct Out {
    /// The newest frame.
    pub frames: watch::Sender<Arc<Frame>>,
    /// Replies as JSON, in order.
    pub replies: mpsc::Sender<String>,
    /// Whether the page is gone.
    pub gone: Arc<AtomicBool>,
    /// Whether the page asks to end the search that is under way.
    pub enough: Arc<AtomicBool>,
}

impl Out {
    /// Sends a reply; one that the page does not take in time is dropped, and the next frame shows the state.
    pub fn reply(&self, reply: &impl Serialize) {
        self.replies.try_send(serde_json::to_string(reply).unwrap_or_default()).ok();
    }

    /// Sends a reply that must not be lost: waits until the page takes it or is gone.
    pub fn send(&self, reply: String) {
        self.replies.blocking_send(reply).ok();
    }

    /// Says why a request failed.
    pub fn failed(&self, error: &Error) {
        self.reply(&Reply::Failed { message: error.to_string() });
    }
}

/// Checks the seed of a reset.
///
/// # Errors
/// When no dataset can store it.
pub fn check_seed(seed: u64) -> Result<()> {
    if seed <= LARGEST_SEED {
        return Ok(());
    }
    Err(Error::config("seed", seed.to_string(), format!("choose at most {LARGEST_SEED}")))
}

/// The numbers of environments that run.
#[derive(Clone, Default)]
pub struct Running {
    all: Arc<AtomicUsize>,
    plans: Arc<AtomicUsize>,
}

/// Counts one environment for as long as it lives.
pub struct Counted(Vec<Arc<AtomicUsize>>);

impl Running {
    /// The number of environments.
    pub fn count(&self) -> usize {
        self.all.load(Ordering::SeqCst)
    }

    /// The number of environments that are planned in.
    pub fn plans(&self) -> usize {
        self.plans.load(Ordering::SeqCst)
    }

    /// Counts another environment, which may be planned in.
    ///
    /// # Errors
    /// When too many run.
    fn start(&self, is_plan: bool) -> Result<Counted> {
        let mut counted = Counted(vec![]);
        let kinds = [(&self.all, MOST, "environments run"), (&self.plans, MOST_PLANS, "pages of plans are open")];
        for (count, most, what) in kinds.into_iter().take(1 + usize::from(is_plan)) {
            counted.0.push(Arc::clone(count));
            if count.fetch_add(1, Ordering::SeqCst) >= most {
                let problem = format!("{most} {what} already");
                return Err(Error::config("a live environment", problem, "close other pages of the lab"));
            }
        }
        Ok(counted)
    }
}

impl Drop for Counted {
    fn drop(&mut self) {
        for count in &self.0 {
            count.fetch_sub(1, Ordering::SeqCst);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn environments_are_counted_and_limited() {
        let running = Running::default();
        let plans: Vec<Counted> = (0..MOST_PLANS).map(|_| running.start(true).expect("one more")).collect();
        assert!(running.start(true).is_err());
        assert_eq!((running.count(), running.plans()), (MOST_PLANS, MOST_PLANS));
        let others: Vec<Counted> = (MOST_PLANS..MOST).map(|_| running.start(false).expect("one more")).collect();
        assert!(running.start(false).is_err());
        assert_eq!(running.count(), MOST);
        drop((plans, others));
        assert_eq!((running.count(), running.plans()), (0, 0));
    }
}
