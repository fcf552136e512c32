//! Connections to the lab, and how many of them it holds.
//!
//! A connection is unknown until it has sent a request with the token. For a new one, the oldest unknown one is closed if there are
//! too many, so that connections that send nothing, or half a request, keep no page from its answer.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};
use tokio::sync::{OnceCell, OwnedSemaphorePermit, Semaphore, oneshot};

/// Connections that have sent a request with the token; others wait for one of them to end.
const KNOWN: usize = 256;
/// Connections that have sent none.
const UNKNOWN: usize = 64;

/// All connections of a server.
#[derive(Clone)]
pub struct Connections {
    known: Arc<Semaphore>,
    unknown: Arc<Mutex<Unknown>>,
}

/// The unknown connections, the oldest first. Dropping a sender closes its connection.
#[derive(Default)]
struct Unknown {
    next: u64,
    open: VecDeque<(u64, oneshot::Sender<()>)>,
}

/// One of them, until this value is dropped.
pub struct Connection {
    id: u64,
    all: Connections,
    permit: OnceCell<Option<OwnedSemaphorePermit>>,
}

impl Connections {
    /// No connections.
    pub fn new() -> Self {
        Self { known: Arc::new(Semaphore::new(KNOWN)), unknown: Arc::default() }
    }

    /// Adds an unknown connection. The receiver has a value once the connection is known, and an error when it is to be closed.
    pub fn add(&self) -> (Connection, oneshot::Receiver<()>) {
        let (sender, receiver) = oneshot::channel();
        let mut unknown = self.unknown.lock().unwrap_or_else(PoisonError::into_inner);
        let id = unknown.next;
        unknown.next += 1;
        if unknown.open.len() >= UNKNOWN {
            unknown.open.pop_front();
        }
        unknown.open.push_back((id, sender));
        (Connection { id, all: self.clone(), permit: OnceCell::new() }, receiver)
    }

    /// Takes a connection out of the unknown ones; `None` if it is known or to be closed.
    fn take(&self, id: u64) -> Option<oneshot::Sender<()>> {
        let mut unknown = self.unknown.lock().unwrap_or_else(PoisonError::into_inner);
        let at = unknown.open.iter().position(|(other, _)| *other == id)?;
        unknown.open.remove(at).map(|(_, sender)| sender)
    }
}

impl Connection {
    /// Makes the connection a known one, because a request had the token. Waits while there are too many.
    pub async fn admit(&self) {
        let admitted = self.permit.get_or_init(|| async {
            let permit = Arc::clone(&self.all.known).acquire_owned().await.ok();
            if let Some(sender) = self.all.take(self.id) {
                sender.send(()).ok();
            }
            permit
        });
        admitted.await;
    }
}

impl Drop for Connection {
    fn drop(&mut self) {
        self.all.take(self.id);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tokio::sync::oneshot::error::TryRecvError;

    #[tokio::test]
    async fn the_oldest_unknown_connection_is_closed_for_a_new_one() {
        let all = Connections::new();
        let mut open: Vec<_> = (0..UNKNOWN).map(|_| all.add()).collect();
        open[0].0.admit().await;
        assert_eq!(open[0].1.try_recv(), Ok(()), "it is known");
        // There is room for one more, so the second of these closes a connection.
        let mut added = [all.add(), all.add()];
        assert_eq!(open[1].1.try_recv(), Err(TryRecvError::Closed));
        for (_, receiver) in open[2..].iter_mut().chain(&mut added) {
            assert_eq!(receiver.try_recv(), Err(TryRecvError::Empty), "it stays open");
        }
        drop(open);
        assert_eq!((all.unknown.lock().expect("the lock").open.len(), all.known.available_permits()), (2, KNOWN));
    }
}
