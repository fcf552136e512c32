//! Nothing is allocated in a step, an observation or a frame, once an environment is warm.

use swm_conformance::allocation::{self, Counting};
use swm_envs::ENVS;

#[global_allocator]
static ALLOCATOR: Counting = Counting;

#[test]
fn the_counter_counts() {
    allocation::the_counter_counts();
}

#[test]
fn steps_and_frames_allocate_nothing() {
    allocation::steps_and_frames_allocate_nothing(ENVS.rows, &[64, 224]);
}
