//! Tests that steps, observations and frames allocate no memory after the first step.

use swm_conformance::allocation::{self, Counting};
use swm_envs::ENVS;

#[global_allocator]
static ALLOCATOR: Counting = Counting;

#[test]
fn counting_allocator_is_active() {
    allocation::counting_allocator_is_active();
}

#[test]
fn steps_and_frames_allocate_nothing() {
    allocation::steps_and_frames_allocate_nothing(ENVS.rows, &[64, 224]);
}
