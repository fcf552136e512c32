//! Nothing is allocated in a step, an observation or a frame, once an environment is warm.
//!
//! Allocations are counted on the thread that asks for it, so tests that run beside this one do not matter.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use swm_core::{Action, Batch, FrameMut, Key, ResetOptions, Schema, Space, VariationRequest};
use swm_envs::ENVS;

/// The system's allocator, counting.
struct Counting;

thread_local! {
    /// What this thread has allocated, while it counts.
    static ALLOCATIONS: Cell<Option<usize>> = const { Cell::new(None) };
}

/// `const` and without a destructor, the counter can be read in every state of a thread, and reading it allocates nothing.
fn count() {
    ALLOCATIONS.with(|count| count.set(count.get().map(|n| n + 1)));
}

// Sound: every call goes to the system's allocator as it came; counting touches neither memory nor arguments.
#[allow(unsafe_code)]
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count();
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        count();
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count();
        unsafe { System.realloc(pointer, layout, size) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// How many times `work` allocates.
fn allocations(work: impl FnOnce()) -> usize {
    ALLOCATIONS.set(Some(0));
    work();
    ALLOCATIONS.take().unwrap_or_default()
}

#[test]
fn the_counter_counts() {
    assert_eq!(allocations(|| drop(std::hint::black_box(vec![1u8; 100]))), 1);
    assert_eq!(allocations(|| _ = std::hint::black_box([1u8; 100])), 0);
}

#[test]
fn steps_and_frames_allocate_nothing() {
    const WARM_UP: usize = 30;
    let mut guilty = vec![];
    for entry in ENVS.rows {
        for (seed, variation) in
            [None, Some(vec!["all".to_owned()]), Some(vec!["all".to_owned()])].into_iter().enumerate()
        {
            let mut env = entry.env().expect("an environment");
            let variation = VariationRequest { variation, ..VariationRequest::default() };
            env.reset(seed as u64, &ResetOptions { variation, ..ResetOptions::default() }).expect("a reset");
            let mut row = Batch::zeros(&Schema::new(env.spec().columns.clone()).expect("a schema"), 1);
            let mut frames = [64, 224].map(|side| (side, vec![0; side * side * 3]));
            let mut worst = 0;
            for t in 0..2 * WARM_UP {
                let action = env.spec().action_space.sample(&mut Key::new(seed as u64).at(t as u64).rng());
                let numbers: Vec<f32> = action.iter().map(|&v| v as f32).collect();
                let choice: Vec<i64> = action.iter().map(|&v| v as i64).collect();
                let action = match env.spec().action_space {
                    Space::Box { .. } => Action::Continuous(&numbers),
                    _ => Action::Discrete(&choice),
                };
                let count = allocations(|| {
                    env.step(action).expect("an action of the action space");
                    env.observe(&mut row.row_mut(0));
                    for (side, rgb) in &mut frames {
                        env.render(FrameMut::new(*side, *side, rgb)).expect("a picture");
                        env.render_goal(FrameMut::new(*side, *side, rgb)).expect("a picture");
                    }
                    std::hint::black_box((env.is_success(), env.goal_distance()));
                });
                if t >= WARM_UP {
                    worst = worst.max(count);
                }
            }
            if worst > 0 {
                guilty.push(format!("{}, seed {seed}: {worst} times in a step", entry.id));
            }
        }
    }
    assert!(guilty.is_empty(), "memory is allocated: {guilty:#?}");
}
