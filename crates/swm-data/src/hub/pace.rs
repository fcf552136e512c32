//! [`Pace`]: says how much of an answer has come, and gives up an answer that comes too slowly.

use std::time::{Duration, Instant};
use swm_core::{Error, Result};

/// The time after which a message says how much came, and the time until the next one.
const FIRST_MESSAGE: Duration = Duration::from_secs(3);
const BETWEEN_MESSAGES: Duration = Duration::from_secs(30);
/// The time in which [`LEAST`] bytes must come.
const WINDOW: Duration = Duration::from_secs(60);
/// The fewest bytes of a [`WINDOW`]: about a kilobyte per second.
const LEAST: u64 = 64 << 10;

/// The bytes of an answer, counted as they come.
pub(super) struct Pace {
    start: Instant,
    received: u64,
    next_message: Duration,
    /// When the present window began, and what had come until then.
    window: (Duration, u64),
}

impl Pace {
    pub fn new() -> Self {
        Self { start: Instant::now(), received: 0, next_message: FIRST_MESSAGE, window: (Duration::ZERO, 0) }
    }

    /// Counts `bytes` that came now from the server `name`. Returns a message if one is due; `expected` is the size of the whole
    /// answer, if it is known.
    ///
    /// # Errors
    /// When fewer than [`LEAST`] bytes came within [`WINDOW`].
    pub fn add(&mut self, bytes: usize, name: &str, expected: Option<u64>) -> Result<Option<String>> {
        self.add_at(self.start.elapsed(), bytes, name, expected)
    }

    fn add_at(&mut self, now: Duration, bytes: usize, name: &str, expected: Option<u64>) -> Result<Option<String>> {
        self.received += bytes as u64;
        let (began, before) = self.window;
        if now.saturating_sub(began) >= WINDOW {
            let came = self.received - before;
            if came < LEAST {
                let seconds = now.saturating_sub(began).as_secs();
                let problem = format!("sent {came} bytes in {seconds} s, fewer than {LEAST} in {} s", WINDOW.as_secs());
                let fix = "check the network connection, then run it again to continue";
                return Err(Error::external(name.to_owned(), format!("{problem}; {fix}")));
            }
            self.window = (now, self.received);
        }
        if now < self.next_message {
            return Ok(None);
        }
        self.next_message = now + BETWEEN_MESSAGES;
        let of = expected.map_or_else(String::new, |size| format!(" of {}", in_units(size)));
        Ok(Some(format!("{name}: {}{of} after {} s", in_units(self.received), now.as_secs())))
    }
}

/// A number of bytes in words.
fn in_units(bytes: u64) -> String {
    match bytes {
        0..10_000 => format!("{bytes} bytes"),
        10_000..1_000_000 => format!("{:.0} kB", bytes as f64 / 1e3),
        _ => format!("{:.1} MB", bytes as f64 / 1e6),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn answers_that_come_slowly_are_reported_and_given_up() {
        let mut pace = Pace::new();
        let seconds = Duration::from_secs_f64;
        for tick in 1..10 {
            let said = pace.add_at(seconds(0.3 * f64::from(tick)), 8, "the hub (h)", Some(636_000)).expect("a start");
            assert_eq!(said, None, "within three seconds");
        }
        let said = pace.add_at(seconds(3.1), 8, "the hub (h)", Some(636_000)).expect("a start").expect("a message");
        assert_eq!(said, "the hub (h): 80 bytes of 636 kB after 3 s");
        assert_eq!(pace.add_at(seconds(30.0), 8, "the hub (h)", None).expect("a start"), None);
        let error = pace.add_at(seconds(60.5), 8, "the hub (h)", None).expect_err("too slow").to_string();
        assert!(error.contains("sent 96 bytes in 60 s") && error.contains("run it again"), "{error}");
    }

    #[test]
    fn slow_connections_that_bring_enough_are_waited_for() {
        let mut pace = Pace::new();
        let said: Vec<String> = (1..300)
            .filter_map(|second| pace.add_at(Duration::from_secs(second), 2000, "the hub (h)", None).expect("enough"))
            .collect();
        assert_eq!(said.len(), 10, "{said:?}");
        assert_eq!(said[1], "the hub (h): 66 kB after 33 s");
    }
}
