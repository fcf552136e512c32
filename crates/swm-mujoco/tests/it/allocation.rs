//! Nothing is allocated in a step or an observation, once a world is warm. What MuJoCo takes from its own allocator, and what a
//! driver of OpenGL does, is not counted.

use swm_conformance::allocation::{self, Counting};
use swm_mujoco::ENVS;

#[global_allocator]
static ALLOCATOR: Counting = Counting;

#[test]
fn the_counter_counts() {
    allocation::the_counter_counts();
}

#[test]
fn steps_allocate_nothing() {
    allocation::steps_and_frames_allocate_nothing(ENVS.rows, &[]);
}
