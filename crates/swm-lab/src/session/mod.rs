//! A live environment behind a WebSocket.
//!
//! The environment lives on a thread of its own, which ends when the socket closes. Frames go through a slot that holds the
//! newest one only, and at most [`IN_FLIGHT`] frames are sent before the page says that it has shown one, so that a slow page
//! drops frames and takes no memory.

pub mod messages;
mod player;
mod recorder;
mod socket;

pub use socket::run;

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use swm_core::{EnvChoice, Error, Result};

/// Frames that are sent before the page has shown one.
const IN_FLIGHT: usize = 2;
/// Environments that run at the same time.
const MOST: usize = 32;
/// The longest message of a page, in bytes.
pub const MOST_BYTES: usize = 16 << 10;
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

/// The number of environments that run.
#[derive(Clone, Default)]
pub struct Running(Arc<AtomicUsize>);

/// Counts one environment for as long as it lives.
pub struct Counted(Arc<AtomicUsize>);

impl Running {
    /// The number of environments.
    pub fn count(&self) -> usize {
        self.0.load(Ordering::SeqCst)
    }

    /// Counts another environment.
    ///
    /// # Errors
    /// When too many run.
    fn start(&self) -> Result<Counted> {
        let counted = Counted(Arc::clone(&self.0));
        if self.0.fetch_add(1, Ordering::SeqCst) >= MOST {
            let problem = format!("{MOST} environments run already");
            return Err(Error::config("a live environment", problem, "close other pages of the lab"));
        }
        Ok(counted)
    }
}

impl Drop for Counted {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::SeqCst);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn environments_are_counted_and_limited() {
        let running = Running::default();
        let all: Vec<Counted> = (0..MOST).map(|_| running.start().expect("one more")).collect();
        assert!(running.start().is_err());
        assert_eq!(running.count(), MOST);
        drop(all);
        assert_eq!(running.count(), 0);
    }
}
