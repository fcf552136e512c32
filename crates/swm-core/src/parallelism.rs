//! [`Parallelism`]: decides whether dividing the work of several slots among threads saves time. The decision
//! affects the duration of the work only, not its result.
//!
//! Both ways are measured while the program runs, and the faster one is used: on the calling thread alone (serial), or
//! together with other threads (shared). The other way is tried again from time to time, so seldom that the trials cost
//! less than 1 % of the time. Work that is shorter than any hand-over between threads always stays serial.

use std::time::{Duration, Instant};

/// The calls of a trial's block, whose median counts: a single slow call says nothing of the others.
const BLOCK: usize = 5;
/// The calls of a block of the way in use, whose mean counts: it includes the calls that wait for a thread that the system
/// has stopped.
const STEADY: u32 = 256;
/// The calls of a trial: a block, and a first call, which wakes the threads and is not counted.
const TRIAL: u32 = BLOCK as u32 + 1;
/// The weights of a block of the way in use, and of a trial, in what is known of a way.
const STEADY_WEIGHT: f32 = 1.0 / 8.0;
const TRIAL_WEIGHT: f32 = 1.0 / 4.0;
/// The most doubts, and the blocks of normal use after which there is one less.
const MOST_DOUBTS: u32 = 6;
const CALM: u32 = 64;
/// Trials cost at most this part of the time.
const TRIAL_SHARE: f32 = 1.0 / 128.0;
/// The number of calls, of which one is measured, when work is much shorter than a hand-over.
const UNTIMED: u32 = 16;
/// The nanoseconds of a call that is known after one measurement, because a block of such calls would be slow.
const LONG: f32 = 1e6;
/// Different numbers of slots are measured separately: up to 1, 3, 7, .. slots.
const SIZES: usize = 12;

/// What is known of the duration of work, by the number of slots.
#[derive(Debug)]
pub(crate) struct Parallelism {
    /// The duration of all work, in nanoseconds, under which it is never shared.
    floor: f32,
    sizes: [Size; SIZES],
    /// The way that a test chooses.
    #[cfg(test)]
    forced: Option<bool>,
}

/// What is known of one number of slots.
#[derive(Clone, Copy, Debug, Default)]
struct Size {
    serial: Way,
    shared: Way,
    /// The calls left of the trial of the slower way.
    trial: u32,
    /// The nanoseconds since the last trial.
    since: f32,
    /// How often steady use contradicted a trial lately: each time doubles the time to the next trial.
    doubts: u32,
    /// The blocks of normal use since the last doubt.
    calm: u32,
    /// The calls since one was measured.
    untimed: u32,
    /// Whether work was shared before.
    started: bool,
}

/// The measured duration of one way, in nanoseconds for each slot.
#[derive(Clone, Copy, Debug, Default)]
struct Way {
    /// The duration; 0 if it is unknown.
    known: f32,
    block: [f32; BLOCK],
    filled: usize,
    sum: f32,
    count: u32,
}

impl Way {
    /// Records the duration of a call on `slots` slots, which belongs to a trial or to normal use. Returns whether a block of
    /// normal use is complete.
    fn record(&mut self, nanos: f32, slots: f32, is_trial: bool) -> bool {
        let each = nanos / slots;
        if self.is_known() && !is_trial {
            (self.sum, self.count) = (self.sum + each, self.count + 1);
            if self.count == STEADY {
                self.learn(self.sum / STEADY as f32, STEADY_WEIGHT);
                return true;
            }
            return false;
        }
        self.block[self.filled] = each;
        self.filled += 1;
        if self.filled == BLOCK {
            self.block.sort_unstable_by(f32::total_cmp);
            self.learn(self.block[BLOCK / 2], TRIAL_WEIGHT);
        } else if nanos > LONG && !self.is_known() {
            self.learn(each, 1.0);
        }
        false
    }

    /// Moves the known duration towards that of a block, by a share of the difference. A share below 1 keeps one call that
    /// waited for the system from deciding alone.
    fn learn(&mut self, nanos: f32, share: f32) {
        let known = if self.is_known() { self.known + share * (nanos - self.known) } else { nanos };
        // The smallest positive number stands for a duration below the resolution of the clock.
        self.known = known.max(f32::MIN_POSITIVE);
        (self.filled, self.sum, self.count) = (0, 0.0, 0);
    }

    fn is_known(&self) -> bool {
        self.known > 0.0
    }
}

impl Size {
    fn serial_is_faster(&self) -> bool {
        self.serial.known <= self.shared.known
    }

    /// Doubts trials after a block of normal use if the way in use is the slower one after all, and doubts less if not.
    fn weigh(&mut self, serial_was_faster: bool) {
        if serial_was_faster == self.serial_is_faster() {
            self.calm += 1;
            if self.calm == CALM {
                (self.calm, self.doubts) = (0, self.doubts.saturating_sub(1));
            }
        } else {
            (self.calm, self.doubts) = (0, (self.doubts + 1).min(MOST_DOUBTS));
        }
    }
}

impl Parallelism {
    /// Shares work that takes at least `floor` and is faster when it is shared.
    pub fn above(floor: Duration) -> Self {
        Self {
            floor: floor.as_nanos() as f32,
            sizes: [Size::default(); SIZES],
            #[cfg(test)]
            forced: None,
        }
    }

    fn size(slots: usize) -> usize {
        (usize::BITS - slots.max(1).leading_zeros()) as usize - 1
    }

    /// Whether the next work on `slots` slots runs on the calling thread alone.
    pub fn is_serial(&self, slots: usize) -> bool {
        #[cfg(test)]
        if let Some(forced) = self.forced {
            return forced;
        }
        let Size { serial, shared, trial, .. } = &self.sizes[Self::size(slots).min(SIZES - 1)];
        if !serial.is_known() || serial.known * (slots as f32) < self.floor {
            return true;
        }
        if !shared.is_known() {
            return false;
        }
        (serial.known <= shared.known) == (*trial == 0)
    }

    /// The clock for the next work on `slots` slots, if this work is to be recorded. Reading the clock takes as long as a
    /// small step, so very short work is measured now and then only.
    pub fn clock(&mut self, slots: usize) -> Option<Instant> {
        let floor = self.floor;
        let size = &mut self.sizes[Self::size(slots).min(SIZES - 1)];
        if size.serial.is_known() && size.serial.known * (slots as f32) < floor / 4.0 {
            size.untimed += 1;
            if size.untimed < UNTIMED {
                return None;
            }
            size.untimed = 0;
        }
        Some(Instant::now())
    }

    /// Records work on `slots` slots, which ran serially or was shared.
    pub fn record(&mut self, serial: bool, slots: usize, elapsed: Duration) {
        let nanos = elapsed.as_nanos() as f32;
        let size = &mut self.sizes[Self::size(slots).min(SIZES - 1)];
        // The first shared call starts the threads.
        let starts = !serial && !size.started;
        size.started |= !serial;
        if size.trial != TRIAL && !starts {
            let before = size.serial_is_faster();
            let way = if serial { &mut size.serial } else { &mut size.shared };
            let steady = way.record(nanos, slots.max(1) as f32, size.trial > 0);
            if steady {
                size.weigh(before);
            }
        }
        if size.trial > 0 {
            (size.trial, size.since) = (size.trial - 1, 0.0);
            return;
        }
        size.since += nanos;
        if size.serial.is_known() && size.shared.is_known() {
            let slower = size.serial.known.max(size.shared.known) * slots as f32;
            if slower * (TRIAL << size.doubts) as f32 <= size.since * TRIAL_SHARE {
                // A trial starts with an empty block, so that its median is of the present.
                let way = if size.serial_is_faster() { &mut size.shared } else { &mut size.serial };
                way.filled = 0;
                size.trial = TRIAL;
            }
        }
    }

    /// Makes all work serial, or shared.
    #[cfg(test)]
    pub fn always(serial: bool) -> Self {
        Self { forced: Some(serial), ..Self::above(Duration::ZERO) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Runs `calls` calls on `slots` slots that take the given microseconds; returns the number of serial ones and the
    /// microseconds of all.
    fn play(it: &mut Parallelism, calls: usize, slots: usize, serial: f64, shared: f64) -> (usize, f64) {
        let (mut count, mut spent) = (0, 0.0);
        for _ in 0..calls {
            let is_serial = it.is_serial(slots);
            let micros = if is_serial { serial } else { shared };
            if it.clock(slots).is_some() {
                it.record(is_serial, slots, Duration::from_secs_f64(micros * 1e-6));
            }
            count += usize::from(is_serial);
            spent += micros;
        }
        (count, spent)
    }

    fn new() -> Parallelism {
        Parallelism::above(Duration::from_micros(3))
    }

    #[test]
    fn work_shorter_than_a_hand_over_is_never_shared() {
        assert_eq!(play(&mut new(), 10_000, 8, 0.4, 5.0).0, 10_000);
        // It is measured in one of 16 calls.
        let mut it = new();
        play(&mut it, BLOCK, 8, 0.4, 5.0);
        assert_eq!((0..160).filter(|_| it.clock(8).is_some()).count(), 10);
    }

    #[test]
    fn the_faster_way_is_chosen_and_trials_cost_a_hundredth() {
        for (serial, shared) in [(16.0, 30.0), (16.0, 9.0), (3000.0, 1600.0), (5.0, 200.0), (100.0, 101.0)] {
            let mut it = new();
            play(&mut it, 50, 8, serial, shared);
            let calls = 100_000;
            let (count, spent) = play(&mut it, calls, 8, serial, shared);
            let best = f64::min(serial, shared) * calls as f64;
            assert!(spent < 1.01 * best, "{serial} {shared}: {}", spent / best);
            assert_eq!(count > calls / 2, serial < shared, "{serial} {shared}: {count}");
            assert!((1..calls).contains(&count), "both ways are tried: {count}");
        }
    }

    #[test]
    fn long_work_is_shared_after_one_call() {
        assert_eq!(play(&mut new(), 8, 8, 2000.0, 1000.0).0, 1);
        assert_eq!(play(&mut new(), 8, 8, 200.0, 100.0).0, BLOCK);
    }

    #[test]
    fn the_choice_follows_a_change() {
        let mut it = new();
        play(&mut it, 1000, 8, 16.0, 9.0);
        assert!(play(&mut it, 1000, 8, 16.0, 9.0).0 < 50);
        // The other threads are busy from now on.
        play(&mut it, 4000, 8, 16.0, 60.0);
        assert!(play(&mut it, 1000, 8, 16.0, 60.0).0 > 950);
    }

    #[test]
    fn rare_waits_for_a_stopped_thread_count() {
        // Sharing is faster in 99 of 100 calls, and slower on average.
        let mut it = new();
        let (mut spent, calls) = (0.0, 200_000);
        for call in 0..calls {
            let is_serial = it.is_serial(8);
            let micros = if is_serial { 16.0 } else { 9.0 + if call % 100 == 0 { 2000.0 } else { 0.0 } };
            it.record(is_serial, 8, Duration::from_secs_f64(micros * 1e-6));
            spent += micros;
        }
        assert!(spent < 1.1 * 16.0 * f64::from(calls), "{}", spent / 16.0 / f64::from(calls));
    }

    #[test]
    fn numbers_of_slots_are_measured_separately() {
        let mut it = new();
        play(&mut it, 200, 64, 640.0, 330.0);
        assert!(!it.is_serial(64));
        assert!(play(&mut it, 2000, 1, 10.0, 15.0).0 > 1900);
        assert!(!it.is_serial(64) && it.is_serial(usize::MAX) && it.is_serial(0));
    }

    #[test]
    fn tests_can_force_a_way() {
        for serial in [true, false] {
            assert!((0..9).all(|slots| Parallelism::always(serial).is_serial(slots) == serial));
        }
    }
}
