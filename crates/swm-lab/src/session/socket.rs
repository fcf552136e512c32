//! The socket of a session: requests in, replies and frames out, and the end of both.

use super::messages::Reply;
use super::{Counted, Frame, IN_FLIGHT, Kind, MOST_BYTES, MOST_MALFORMED, Out, Running, Session, Setup};
use crate::Lab;
use futures::stream::{SplitSink, SplitStream};
use futures::{SinkExt as _, StreamExt as _};
use hyper::upgrade::Upgraded;
use hyper_util::rt::TokioIo;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::thread::Builder;
use std::time::Duration;
use swm_core::Error;
use swm_core::text::one_line;
use tokio::sync::{Semaphore, mpsc, watch};
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::Error as WsError;
use tokio_tungstenite::tungstenite::protocol::{Message, Role, WebSocketConfig};

/// The connection of a page.
type Stream = WebSocketStream<TokioIo<Upgraded>>;

/// Requests and replies that wait.
const QUEUE: usize = 64;
/// The time between two pings.
const PING: Duration = Duration::from_secs(20);
/// A page that sends nothing for this long, not even an answer to a ping, is gone.
const SILENCE: Duration = Duration::from_secs(65);

/// Says to the thread of a session that its page is gone, when it is dropped.
struct Leaving(Arc<AtomicBool>);

impl Drop for Leaving {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// Plays a session for the page behind a connection, until the page is gone or `stop` is set.
pub async fn run<S: Session>(
    connection: Upgraded,
    lab: Arc<Lab>,
    setup: Setup,
    running: Running,
    stop: watch::Receiver<bool>,
) {
    let mut config = WebSocketConfig::default();
    config.max_message_size = Some(MOST_BYTES);
    config.max_frame_size = Some(MOST_BYTES);
    let io = TokioIo::new(connection);
    let stream: Stream = WebSocketStream::from_raw_socket(io, Role::Server, Some(config)).await;
    let (mut sink, source) = stream.split();
    let (frames, newest) = watch::channel(Arc::new(Frame::default()));
    let (replies, to_send) = mpsc::channel(QUEUE);
    let (requests, taken) = sync_channel(QUEUE);
    let leaving = Leaving(Arc::default());
    let enough = Arc::<AtomicBool>::default();
    let out = Out { frames, replies: replies.clone(), gone: Arc::clone(&leaving.0), enough: Arc::clone(&enough) };
    if let Err(error) = start::<S>(lab, setup, &running, out, taken) {
        sink.send(Message::text(failed(error.to_string()))).await.ok();
        sink.close().await.ok();
        return;
    }
    let credits = Arc::new(Semaphore::new(IN_FLIGHT));
    let is_alive = Arc::new(AtomicBool::new(true));
    let page = Page { credits: Arc::clone(&credits), is_alive: Arc::clone(&is_alive), enough };
    let reading = read::<S>(source, requests, replies, page);
    let writing = write(sink, to_send, newest, credits, is_alive);
    // The first of the three that ends drops the others, and with them the channel that the thread waits on.
    tokio::select! {
        () = reading => {}
        () = writing => {}
        () = stopped(stop) => {}
    }
}

/// Waits until the server stops.
async fn stopped(mut stop: watch::Receiver<bool>) {
    stop.wait_for(|stop| *stop).await.ok();
}

/// Starts the thread of the environment. It ends when `requests` closes.
fn start<S: Session>(
    lab: Arc<Lab>,
    setup: Setup,
    running: &Running,
    out: Out,
    requests: Receiver<S::Request>,
) -> swm_core::Result<()> {
    let counted = running.start(S::IS_PLAN)?;
    let (replies, frames) = (out.replies.clone(), out.frames.clone());
    let play = move || {
        let _counted: Counted = counted;
        let played = catch_unwind(AssertUnwindSafe(|| S::play(&lab, setup, out, &requests)));
        let played = played.unwrap_or_else(|panic| Err(Error::panicked("the environment panicked", &*panic)));
        if let Err(error) = played {
            replies.try_send(failed(error.to_string())).ok();
        }
        // The slot closes after the last reply.
        drop(frames);
    };
    let thread = Builder::new().name("swm-lab".to_owned()).spawn(play);
    thread.map(drop).map_err(|error| Error::external("starting the thread of an environment", error))
}

/// What the page tells outside of the order of messages.
struct Page {
    /// Frames that may be sent.
    credits: Arc<Semaphore>,
    /// Whether the page sent anything since the last ping.
    is_alive: Arc<AtomicBool>,
    /// Whether it asks to end a search.
    enough: Arc<AtomicBool>,
}

/// Takes requests until the page is gone, sends too many malformed ones, or its environment has ended.
async fn read<S: Session>(
    mut source: SplitStream<Stream>,
    requests: SyncSender<S::Request>,
    replies: mpsc::Sender<String>,
    page: Page,
) {
    let mut malformed = 0;
    loop {
        let message = match source.next().await {
            Some(Ok(message)) => message,
            Some(Err(error)) => {
                match error {
                    WsError::Capacity(error) => tracing::warn!("a page sent an oversized message ({error})"),
                    error => tracing::debug!("the socket of a page failed: {error}"),
                }
                return;
            }
            None => return,
        };
        page.is_alive.store(true, Ordering::Relaxed);
        let text = match &message {
            Message::Text(text) => text.as_str(),
            Message::Close(_) => return,
            Message::Ping(_) | Message::Pong(_) => continue,
            _ => "",
        };
        let problem = match serde_json::from_str::<S::Request>(text) {
            Ok(request) => match take::<S>(request, &requests, &page) {
                Taken::Yes => continue,
                Taken::Busy => "the environment is busy; try again".to_owned(),
                // `write` sends the reply that says why the environment has ended, and closes the socket.
                Taken::Ended => std::future::pending().await,
            },
            Err(error) => {
                malformed += 1;
                // It quotes the message.
                let error = one_line(&error.to_string());
                tracing::warn!("a page sent a malformed message ({error})");
                format!("malformed message: {error}")
            }
        };
        replies.try_send(failed(problem)).ok();
        if malformed >= MOST_MALFORMED {
            return;
        }
    }
}

/// What became of a request.
enum Taken {
    Yes,
    Busy,
    Ended,
}

/// Hands a request to the thread of the session, or does at once what it asks for.
fn take<S: Session>(request: S::Request, requests: &SyncSender<S::Request>, page: &Page) -> Taken {
    let kind = S::kind(&request);
    match kind {
        Kind::Shown => {
            if page.credits.available_permits() < IN_FLIGHT {
                page.credits.add_permits(1);
            }
            return Taken::Yes;
        }
        Kind::EndsSearch => {
            page.enough.store(true, Ordering::Relaxed);
            return Taken::Yes;
        }
        Kind::Ordered | Kind::Replaceable => {}
    }
    match requests.try_send(request) {
        Ok(()) => Taken::Yes,
        // Requests of hands arrive faster than a slow environment takes them; the next one replaces them.
        Err(TrySendError::Full(_)) if kind == Kind::Replaceable => Taken::Yes,
        Err(TrySendError::Full(_)) => Taken::Busy,
        Err(TrySendError::Disconnected(_)) => Taken::Ended,
    }
}

/// Sends replies and the newest frames until the page takes no more.
async fn write(
    mut sink: SplitSink<Stream, Message>,
    mut replies: mpsc::Receiver<String>,
    mut newest: watch::Receiver<Arc<Frame>>,
    credits: Arc<Semaphore>,
    is_alive: Arc<AtomicBool>,
) {
    let mut pings = tokio::time::interval(PING);
    let mut silent = Duration::ZERO;
    loop {
        let message = tokio::select! {
            biased;
            reply = replies.recv() => match reply {
                Some(reply) => Message::text(reply),
                None => return,
            },
            frame = next_frame(&mut newest, &credits) => match frame {
                Some(frame) => Message::binary(frame.bytes.clone()),
                None => {
                    // The environment has ended; the last reply says why.
                    while let Ok(reply) = replies.try_recv() {
                        sink.send(Message::text(reply)).await.ok();
                    }
                    sink.close().await.ok();
                    return;
                }
            },
            _ = pings.tick() => {
                silent = if is_alive.swap(false, Ordering::Relaxed) { Duration::ZERO } else { silent + PING };
                if silent >= SILENCE {
                    return;
                }
                Message::Ping(vec![].into())
            }
        };
        if sink.send(message).await.is_err() {
            return;
        }
    }
}

/// Waits for a frame that the page has not received, and for its permission to send one.
async fn next_frame(newest: &mut watch::Receiver<Arc<Frame>>, credits: &Semaphore) -> Option<Arc<Frame>> {
    let credit = credits.acquire().await.ok()?;
    newest.changed().await.ok()?;
    credit.forget();
    Some(Arc::clone(&newest.borrow_and_update()))
}

/// The reply that a request failed, as JSON.
fn failed(message: String) -> String {
    serde_json::to_string(&Reply::Failed { message }).unwrap_or_default()
}
