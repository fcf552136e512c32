//! Tests of the pool on a toy environment, and of its worker threads.

use super::*;
use crate::{FactorValues, Key, RowRef, Snapshot, Space, Transition, VariationRequest, VariationSpace};
use std::sync::Barrier;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread;

/// Adds its action to a number; its frame shows the number.
struct Counter {
    spec: EnvSpec,
    value: f64,
    factors: FactorValues,
    /// Called at the beginning of every step.
    hook: Arc<dyn Fn(f64) + Send + Sync>,
}

impl Counter {
    fn new(hook: Arc<dyn Fn(f64) + Send + Sync>) -> Self {
        let limits =
            |bound: f64| Space::Box { shape: vec![1], dtype: DType::Float32, low: vec![-bound], high: vec![bound] };
        let spec = EnvSpec {
            id: "counter".to_owned(),
            action_space: limits(1.0),
            columns: vec![ColumnSpec::new(columns::STATE, DType::Float64, [1])],
            observation_space: vec![(columns::STATE, limits(1e9))],
            variation_space: VariationSpace::new(vec![], &[]),
            max_episode_steps: 6,
            cameras: vec![],
            angles: vec![],
        };
        let factors = spec.variation_space.resolve(&VariationRequest::default(), Key::new(0)).expect("no factors");
        Self { spec, value: 0.0, factors, hook }
    }
}

impl Env for Counter {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn reset(&mut self, seed: u64, _: &ResetOptions) -> Result<()> {
        self.value = seed as f64;
        Ok(())
    }

    fn step(&mut self, action: Action<'_>) -> Result<Transition> {
        (self.hook)(self.value);
        let given = f64::from(action.continuous(1)?[0]);
        if given > 1.0 {
            return Err(Error::config("action", format!("too large at {}", self.value), "choose at most 1"));
        }
        self.value += given;
        Ok(Transition { reward: given, terminated: self.value > 1000.0, truncated: false })
    }

    fn observe(&self, row: &mut RowMut<'_>) {
        row.set(0, &[self.value]);
    }

    fn render(&mut self, frame: FrameMut<'_>) -> Result<()> {
        frame.rgb.fill(self.value as u8);
        Ok(())
    }

    fn render_goal(&mut self, frame: FrameMut<'_>) -> Result<()> {
        frame.rgb.fill(7);
        Ok(())
    }

    fn factors(&self) -> &FactorValues {
        &self.factors
    }

    fn snapshot(&self) -> Snapshot {
        Snapshot(self.value.to_le_bytes().to_vec())
    }

    fn restore(&mut self, _: &Snapshot) -> Result<()> {
        Ok(())
    }

    fn restore_from(&mut self, _: RowRef<'_>, _: RowRef<'_>) -> Result<()> {
        Ok(())
    }

    fn sample_goal(&mut self, _: Key) -> Result<()> {
        Ok(())
    }

    fn is_success(&self) -> bool {
        self.value > 3.0
    }

    fn goal_distance(&self) -> f64 {
        (3.0 - self.value).max(0.0)
    }
}

/// A pool of `envs` environments on `workers` threads, reset with the seeds 0, 1, ..
fn pool(envs: usize, workers: usize, serial: Option<bool>, hook: impl Fn(f64) + Send + Sync + 'static) -> EnvPool {
    let hook: Arc<dyn Fn(f64) + Send + Sync> = Arc::new(hook);
    let envs: Vec<Box<dyn Env>> =
        (0..envs).map(|_| Box::new(Counter::new(Arc::clone(&hook))) as Box<dyn Env>).collect();
    let mut pool =
        EnvPool::new(envs, Some((2, 3)), None, threads(workers).expect("creating the thread pool")).expect("a pool");
    if let Some(serial) = serial {
        pool.steps = Parallelism::always(serial);
        pool.resets = Parallelism::always(serial);
    }
    let resets: Vec<Reset> =
        (0..pool.len()).map(|slot| Reset { slot, seed: slot as u64, options: ResetOptions::default() }).collect();
    pool.reset(&resets).expect("resetting");
    pool
}

fn actions(pool: &EnvPool, value: impl Fn(usize) -> f32) -> Batch {
    let mut actions = Batch::zeros(&Schema::new([pool.spec().action_column()]).expect("a schema"), pool.len());
    let values = actions.get_mut::<f32>(columns::ACTION).expect("the column");
    values.iter_mut().enumerate().for_each(|(slot, action)| *action = value(slot));
    actions
}

/// All bytes of the infos of 40 steps, in which some slots pause and some start again.
fn played(mut pool: EnvPool) -> Vec<u8> {
    let mut bytes = vec![];
    for step in 0..40_usize {
        let actions = actions(&pool, |slot| ((slot * 7 + step) % 11) as f32 / 11.0);
        let active: Vec<bool> = (0..pool.len()).map(|slot| (slot + step) % 5 != 0).collect();
        pool.step(&actions, &active).expect("stepping");
        if step % 9 == 8 {
            let slot = step % pool.len();
            let reset = Reset { slot, seed: step as u64, options: ResetOptions::default() };
            pool.reset(&[reset]).expect("resetting");
        }
        let infos = pool.infos();
        bytes.extend((0..infos.schema().columns().len()).flat_map(|column| infos.bytes(column)));
    }
    bytes
}

#[test]
fn infos_do_not_depend_on_threads_or_on_the_way() {
    for envs in [1, 3, 8] {
        let expected = played(pool(envs, 1, Some(true), |_| ()));
        for workers in [1, 2, 4] {
            for serial in [Some(true), Some(false), None] {
                assert!(played(pool(envs, workers, serial, |_| ())) == expected, "{envs} {workers} {serial:?}");
            }
        }
    }
}

#[test]
fn the_calling_thread_works_and_the_others_join_it() {
    // Each of two slots waits until the other one is being stepped, so two threads must be inside.
    let (both, caller) = (Barrier::new(2), thread::current().id());
    let by_caller = Arc::new(AtomicUsize::new(0));
    let counted = Arc::clone(&by_caller);
    let mut pool = pool(2, 2, Some(false), move |_| {
        both.wait();
        counted.fetch_add(usize::from(thread::current().id() == caller), Ordering::Relaxed);
    });
    let actions = actions(&pool, |_| 0.5);
    (0..20).for_each(|_| pool.step(&actions, &[true; 2]).expect("stepping"));
    assert_eq!(by_caller.load(Ordering::Relaxed), 20);
}

#[test]
fn small_steps_stay_on_the_calling_thread() {
    let caller = thread::current().id();
    let mut pool = pool(8, 4, None, move |_| assert_eq!(thread::current().id(), caller));
    // A clock that always finds steps of a nanosecond.
    (0..100).for_each(|_| pool.steps.record(true, 8, Duration::from_nanos(8)));
    let actions = actions(&pool, |_| 0.0);
    (0..4).for_each(|_| pool.step(&actions, &[true; 8]).expect("stepping"));
}

#[test]
fn the_error_of_the_first_failed_slot_is_returned_in_every_way() {
    for (workers, serial) in [(1, true), (2, true), (2, false), (4, false)] {
        let mut pool = pool(8, workers, Some(serial), |_| ());
        let failing = actions(&pool, |slot| if slot >= 3 { 2.0 } else { 0.0 });
        let error = pool.step(&failing, &[true; 8]).expect_err("slots 3 to 7 fail").to_string();
        assert!(error.contains("too large at 3"), "{error}");
        let actions = actions(&pool, |_| 0.0);
        pool.step(&actions, &[true; 8]).expect("the next step works");
    }
}

#[test]
fn a_panic_of_an_environment_on_any_thread_is_an_error() {
    for (workers, serial) in [(1, true), (2, false), (4, false)] {
        let mut pool = pool(8, workers, Some(serial), |value| assert!(value < 1.0, "the value is {value}"));
        let error = pool.step(&actions(&pool, |_| 0.0), &[true; 8]).expect_err("slots 1 to 7 panic").to_string();
        assert_eq!(error, "stepping an environment: the value is 1");
        let first: Vec<bool> = (0..8).map(|slot| slot == 0).collect();
        pool.step(&actions(&pool, |_| 0.0), &first).expect("slot 0 works");
    }
    // The panic of the one thread that is not the calling thread.
    let (both, caller) = (Barrier::new(2), thread::current().id());
    let mut pool = pool(2, 2, Some(false), move |_| {
        both.wait();
        assert_eq!(thread::current().id(), caller, "not the caller");
    });
    let error = pool.step(&actions(&pool, |_| 0.0), &[true; 2]).expect_err("one slot panics").to_string();
    assert!(error.contains("not the caller"), "{error}");
}

#[test]
fn worker_threads_join_in_and_the_caller_waits_for_them() {
    let mut workers = WorkerThreads::new(2).expect("starting threads");
    let (all, done) = (Barrier::new(3), AtomicUsize::new(0));
    for _ in 0..50 {
        // The barrier opens only when three threads are inside.
        workers
            .run(2, &|| {
                all.wait();
                done.fetch_add(1, Ordering::Relaxed);
            })
            .expect("no panic");
    }
    assert_eq!(done.load(Ordering::Relaxed), 150);
    workers.run(0, &|| assert!(thread::current().name() != Some("swm-step-0"))).expect("no worker thread is asked");
}

#[test]
fn worker_threads_join_in_while_they_watch_and_after_they_slept() {
    let mut workers = WorkerThreads::new(1).expect("starting a thread");
    let both = Barrier::new(2);
    for call in 0..60 {
        // In the middle the thread sleeps before every call, so that it stops watching.
        if (20..50).contains(&call) {
            while workers.asleep() == 0 {
                thread::yield_now();
            }
        }
        workers.run(1, &|| _ = both.wait()).expect("no panic");
    }
}

#[test]
fn a_panic_of_any_thread_is_returned_and_the_threads_go_on() {
    let mut workers = WorkerThreads::new(1).expect("starting a thread");
    let both = Barrier::new(2);
    for by_worker in [true, false] {
        let failed = workers.run(1, &|| {
            both.wait();
            let is_worker = thread::current().name() == Some("swm-step-0");
            assert!(is_worker != by_worker, "by_worker {by_worker}");
        });
        let panic = failed.expect_err("one thread panics");
        assert_eq!(panic.downcast_ref::<String>(), Some(&format!("by_worker {by_worker}")));
        workers.run(1, &|| _ = both.wait()).expect("the thread works again");
    }
}
