//! Checks that steps, observations and frames allocate no memory after a warm-up.
//!
//! Allocations are counted per thread, so concurrent tests do not interfere. The test program must use the counting
//! allocator:
//!
//! ```ignore
//! #[global_allocator]
//! static ALLOCATOR: Counting = Counting;
//! ```

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use swm_core::{Action, Batch, EnvEntry, FrameMut, Key, ResetOptions, Schema, Space, VariationRequest};

/// The number of steps before counting starts, and the number of counted steps.
const WARM_UP: usize = 30;

/// The system's allocator with a count per thread.
pub struct Counting;

thread_local! {
    /// The number of allocations of this thread; `None` while the thread does not count.
    static ALLOCATIONS: Cell<Option<usize>> = const { Cell::new(None) };
}

/// Counts an allocation. The counter is `const` and has no destructor, so every state of a thread can read it
/// without an allocation.
fn count() {
    ALLOCATIONS.with(|count| count.set(count.get().map(|n| n + 1)));
}

// SAFETY: every call goes to the system's allocator unchanged; counting touches neither memory nor arguments.
#[allow(unsafe_code, reason = "a global allocator is an unsafe trait")]
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count();
        // SAFETY: the caller upholds the contract of `GlobalAlloc`.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        count();
        // SAFETY: as above.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count();
        // SAFETY: as above.
        unsafe { System.realloc(pointer, layout, size) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: as above.
        unsafe { System.dealloc(pointer, layout) }
    }
}

/// The number of allocations of `work` on this thread.
pub fn allocations(work: impl FnOnce()) -> usize {
    ALLOCATIONS.set(Some(0));
    work();
    ALLOCATIONS.take().unwrap_or_default()
}

/// Checks that the program uses [`Counting`] as its allocator.
///
/// # Panics
/// When the program uses another allocator.
pub fn counting_allocator_is_active() {
    assert_eq!(allocations(|| drop(std::hint::black_box(vec![1u8; 100]))), 1, "the program uses another allocator");
    assert_eq!(allocations(|| _ = std::hint::black_box([1u8; 100])), 0);
}

/// Steps every environment, with default factors and with all factors varied, and renders the state and the goal as
/// square frames of `sides` pixels per side.
///
/// # Panics
/// When a step, an observation or a frame allocates memory or fails.
pub fn steps_and_frames_allocate_nothing(rows: &[EnvEntry], sides: &[usize]) {
    let mut allocating = vec![];
    for entry in rows {
        for (seed, variation) in
            [None, Some(vec!["all".to_owned()]), Some(vec!["all".to_owned()])].into_iter().enumerate()
        {
            let mut env = entry.env().expect("creating the environment");
            let variation = VariationRequest { variation, ..VariationRequest::default() };
            env.reset(seed as u64, &ResetOptions { variation, ..ResetOptions::default() })
                .expect("resetting the environment");
            let mut row = Batch::zeros(&Schema::new(env.spec().columns.clone()).expect("creating the schema"), 1);
            let mut frames: Vec<_> = sides.iter().map(|&side| (side, vec![0; side * side * 3])).collect();
            let mut worst = 0;
            for t in 0..2 * WARM_UP {
                let action = env.spec().action_space.sample(&mut Key::new(seed as u64).at(t as u64).rng());
                let values: Vec<f32> = action.iter().map(|&v| v as f32).collect();
                let choice: Vec<i64> = action.iter().map(|&v| v as i64).collect();
                let action = match env.spec().action_space {
                    Space::Box { .. } => Action::Continuous(&values),
                    _ => Action::Discrete(&choice),
                };
                let count = allocations(|| {
                    env.step(action).expect("stepping the environment");
                    env.observe(&mut row.row_mut(0));
                    for (side, rgb) in &mut frames {
                        env.render(FrameMut::new(*side, *side, rgb)).expect("rendering a frame");
                        env.render_goal(FrameMut::new(*side, *side, rgb)).expect("rendering the goal");
                    }
                    std::hint::black_box((env.is_success(), env.goal_distance()));
                });
                if t >= WARM_UP {
                    worst = worst.max(count);
                }
            }
            if worst > 0 {
                allocating.push(format!("{}, seed {seed}: {worst} times in a step", entry.id));
            }
        }
    }
    assert!(allocating.is_empty(), "steps allocate memory: {allocating:#?}");
}
