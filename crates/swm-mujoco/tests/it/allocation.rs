//! Nothing is allocated in a step, an observation or a picture, once a world is warm. What MuJoCo takes from its own allocator, and what a
//! driver of OpenGL does, is not counted.

use swm_conformance::allocation::{self, Counting};
use swm_core::{FrameMut, ResetOptions, VariationRequest};
use swm_mujoco::ENVS;
use swm_mujoco::render::{self, Choice};

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

#[test]
fn a_thread_that_draws_worlds_in_turn_allocates_nothing() {
    let names = ["swm/CheetahDMControl-v0", "swm/HumanoidDMControl-v0", "swm/OGBCube-v0", "swm/FetchReach-v3"];
    let variation = VariationRequest { variation: Some(vec!["all".to_owned()]), ..VariationRequest::default() };
    let mut worlds: Vec<_> = names
        .iter()
        .flat_map(|name| [VariationRequest::default(), variation.clone()].map(|variation| (name, variation)))
        .map(|(name, variation)| {
            let mut world = ENVS.choose(name).and_then(|entry| entry.env()).expect("a world");
            world.reset(0, &ResetOptions { variation, ..ResetOptions::default() }).expect("a reset");
            world
        })
        .collect();
    let mut rgb = vec![0; 64 * 64 * 3];
    let mut draw = || {
        for world in &mut worlds {
            world.render(FrameMut::new(64, 64, &mut rgb)).expect("a picture");
        }
    };
    render::with(Choice::Cpu, || {
        draw();
        assert_eq!(allocation::allocations(&mut draw), 0);
    });
}
