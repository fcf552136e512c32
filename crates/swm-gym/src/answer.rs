//! Waiting for a worker's answer, with a message when it takes long.

use std::io::{self, ErrorKind, Read as _};
use std::os::unix::net::UnixStream;
use std::time::Duration;

/// How long an answer may take until a message names what is waited for.
const SLOW: Duration = Duration::from_secs(10);
/// The bytes before the text of an answer: its kind, and the length of the text.
pub type Head = [u8; 5];

/// Prepares a socket for [`head`] with the time limit `limit`.
///
/// # Errors
/// When the system refuses the timeout.
pub fn prepare(socket: &UnixStream, limit: Duration) -> io::Result<()> {
    socket.set_read_timeout(Some(SLOW.min(limit)))
}

/// Reads the head of an answer from a socket that [`prepare`] prepared. Calls `report` when it takes long.
///
/// # Errors
/// When there is no answer within the limit, or the connection ends.
pub fn head(socket: &mut UnixStream, limit: Duration, report: impl FnOnce()) -> io::Result<Head> {
    head_after(socket, [SLOW, limit], report)
}

fn head_after(socket: &mut UnixStream, [slow, limit]: [Duration; 2], report: impl FnOnce()) -> io::Result<Head> {
    let (mut head, mut filled) = ([0; 5], 0);
    let answer = fill(socket, &mut head, &mut filled);
    if limit <= slow || !answer.as_ref().is_err_and(|error| error.kind() == ErrorKind::WouldBlock) {
        return answer.map(|()| head);
    }
    report();
    socket.set_read_timeout(Some(limit.saturating_sub(slow)))?;
    let answer = fill(socket, &mut head, &mut filled);
    socket.set_read_timeout(Some(slow))?;
    answer.map(|()| head)
}

/// Reads until all of `head` is filled. After an error, the first `filled` bytes are there.
fn fill(socket: &mut UnixStream, head: &mut Head, filled: &mut usize) -> io::Result<()> {
    while *filled < head.len() {
        match socket.read(&mut head[*filled..]) {
            Ok(0) => return Err(ErrorKind::UnexpectedEof.into()),
            Ok(count) => *filled += count,
            Err(error) if error.kind() == ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write as _;

    #[test]
    fn the_message_comes_once_and_only_if_the_answer_is_late() {
        let (mut socket, mut worker) = UnixStream::pair().expect("a connection");
        let times = [1, 2].map(Duration::from_millis);
        socket.set_read_timeout(Some(times[0])).expect("a timeout");
        let mut reports = 0;
        let late = head_after(&mut socket, times, || reports += 1).expect_err("no answer");
        assert_eq!((late.kind(), reports), (ErrorKind::WouldBlock, 1));
        let short = head_after(&mut socket, [times[1], times[1]], || reports += 1).expect_err("no answer");
        assert_eq!((short.kind(), reports), (ErrorKind::WouldBlock, 1));
        worker.write_all(b".0000").expect("an answer");
        assert_eq!(&head_after(&mut socket, times, || reports += 1).expect("an answer"), b".0000");
        assert_eq!(reports, 1);
        // An answer whose rest comes after the message.
        worker.write_all(b"x1").expect("a part of an answer");
        let rest = || worker.write_all(b"234").expect("the rest");
        assert_eq!(&head_after(&mut socket, [times[0], Duration::from_secs(9)], rest).expect("late"), b"x1234");
        drop(worker);
        let ended = head_after(&mut socket, times, || ()).expect_err("the end of the connection");
        assert_eq!(ended.kind(), ErrorKind::UnexpectedEof);
    }
}
