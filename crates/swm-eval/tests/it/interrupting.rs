//! Runs are interrupted within one action of a policy, not only between steps.

use crate::evaluating::world;
use crate::line::Walker;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use swm_core::run::{Control, Interrupt};
use swm_core::{Batch, Error, Key, Policy, Result, VariationRequest};
use swm_eval::{EvalConfig, Starts};

/// A planner that never finishes by itself; it sets `planning` when it begins.
struct Endless {
    planning: Arc<AtomicBool>,
    uses_threads: bool,
}

impl Policy for Endless {
    fn begin(&mut self, _: usize, _: Key) {}

    fn act(&mut self, _: &Batch, _: &[bool], _: &mut Batch) -> Result<()> {
        unreachable!("an evaluation passes its interrupt")
    }

    fn act_until(&mut self, _: &Batch, _: &[bool], _: &mut Batch, interrupt: &dyn Interrupt) -> Result<()> {
        self.planning.store(true, Ordering::Relaxed);
        loop {
            interrupt.check()?;
            thread::yield_now();
        }
    }

    fn uses_threads(&self) -> bool {
        self.uses_threads
    }
}

#[test]
fn a_flag_or_a_poll_ends_a_plan() {
    let starts = Starts::episodic(2, 0, VariationRequest::default()).expect("creating the starts");
    let config = EvalConfig::default();
    let here = thread::current().id();
    for uses_threads in [true, false] {
        let planning = Arc::new(AtomicBool::new(false));
        let mut world = world(2, 2);
        let mut policy = Endless { planning: Arc::clone(&planning), uses_threads };
        // Both are set off by the plan itself, so the run cannot be interrupted before it.
        let mut flagged = Control::new().with_interrupt(Arc::clone(&planning));
        let interrupted = world.evaluate(&mut policy, &starts, &config, &mut flagged);
        assert!(matches!(interrupted, Err(Error::Interrupted)), "threads {uses_threads}");

        planning.store(false, Ordering::Relaxed);
        let mut polled = Control::new().with_poll(|| {
            assert_eq!(thread::current().id(), here, "signals arrive in this thread");
            if planning.load(Ordering::Relaxed) { Err(Error::external("polling", "a signal")) } else { Ok(()) }
        });
        let error = world.evaluate(&mut policy, &starts, &config, &mut polled).expect_err("a signal arrives");
        assert_eq!(error.to_string(), "polling: a signal", "threads {uses_threads}");
        // The world is usable afterwards.
        world.evaluate(&mut Walker, &starts, &config, &mut Control::new()).expect("an evaluation");
    }
}
