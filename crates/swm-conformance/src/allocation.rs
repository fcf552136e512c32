//! Nothing is allocated in a step, an observation or a frame, once a world is warm.
//!
//! Allocations are counted on the thread that asks for it, so tests that run beside do not matter. The program of the tests
//! must use the allocator that counts:
//!
//! ```ignore
//! #[global_allocator]
//! static ALLOCATOR: Counting = Counting;
//! ```

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use swm_core::{Action, Batch, EnvEntry, FrameMut, Key, ResetOptions, Schema, Space, VariationRequest};

/// Steps before counting begins, and steps that are counted.
const WARM_UP: usize = 30;

/// The system's allocator, counting.
pub struct Counting;

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

/// How many times `work` allocates.
pub fn allocations(work: impl FnOnce()) -> usize {
    ALLOCATIONS.set(Some(0));
    work();
    ALLOCATIONS.take().unwrap_or_default()
}

/// Whether the program's allocator is the one that counts: without it, nothing would be found.
///
/// # Panics
/// When it is another one.
pub fn the_counter_counts() {
    assert_eq!(allocations(|| drop(std::hint::black_box(vec![1u8; 100]))), 1, "the program's allocator is another one");
    assert_eq!(allocations(|| _ = std::hint::black_box([1u8; 100])), 0);
}

/// Steps every world, with the usual factors and with all varied, and draws it and its goal in squares of these sides.
///
/// # Panics
/// When a step, an observation or a frame allocates memory, or is refused.
#[allow(clippy::cast_possible_truncation)]
pub fn steps_and_frames_allocate_nothing(rows: &[EnvEntry], sides: &[usize]) {
    let mut guilty = vec![];
    for entry in rows {
        for (seed, variation) in
            [None, Some(vec!["all".to_owned()]), Some(vec!["all".to_owned()])].into_iter().enumerate()
        {
            let mut env = entry.env().expect("an environment");
            let variation = VariationRequest { variation, ..VariationRequest::default() };
            env.reset(seed as u64, &ResetOptions { variation, ..ResetOptions::default() }).expect("a reset");
            let mut row = Batch::zeros(&Schema::new(env.spec().columns.clone()).expect("a schema"), 1);
            let mut frames: Vec<_> = sides.iter().map(|&side| (side, vec![0; side * side * 3])).collect();
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
