//! Tests that a step, an observation or a rendering allocates no memory after a warm-up. Allocations by MuJoCo's own
//! allocator and by OpenGL drivers are not counted.

use swm_conformance::allocation::{self, Counting};
use swm_core::{Action, Env, FrameMut, Key, ResetOptions, VariationRequest, thread_budget};
use swm_mujoco::ENVS;
use swm_mujoco::render::{self, Choice};

#[global_allocator]
static ALLOCATOR: Counting = Counting;

#[test]
fn counting_allocator_is_active() {
    allocation::counting_allocator_is_active();
}

#[test]
fn steps_allocate_no_memory() {
    allocation::steps_and_frames_allocate_nothing(ENVS.rows, &[]);
}

/// Creates environments with default factors, and with all factors varied.
fn environments() -> Vec<Box<dyn Env>> {
    let names = ["swm/CheetahDMControl-v0", "swm/HumanoidDMControl-v0", "swm/OGBCube-v0", "swm/FetchReach-v3"];
    let variation = VariationRequest { variation: Some(vec!["all".to_owned()]), ..VariationRequest::default() };
    names
        .iter()
        .flat_map(|name| [VariationRequest::default(), variation.clone()].map(|variation| (name, variation)))
        .map(|(name, variation)| {
            let mut env = ENVS.choose(name).and_then(|entry| entry.env()).expect("creating the environment");
            env.reset(0, &ResetOptions { variation, ..ResetOptions::default() }).expect("resetting the environment");
            env
        })
        .collect()
}

/// The number of allocations of rendering all environments once, after eight rounds that fill the caches of the
/// renderer.
fn allocations_of_rendering(side: usize, envs: &mut [Box<dyn Env>]) -> usize {
    let mut rgb = vec![0; side * side * 3];
    let mut draw = || {
        for env in &mut *envs {
            env.render(FrameMut::new(side, side, &mut rgb)).expect("rendering a frame");
        }
    };
    render::with(Choice::Cpu, || {
        (0..8).for_each(|_| draw());
        allocation::allocations(&mut draw)
    })
}

#[test]
fn rendering_environments_in_turn_allocates_no_memory() {
    assert_eq!(allocations_of_rendering(64, &mut environments()), 0);
}

#[test]
fn rendering_after_steps_allocates_no_memory_after_warm_up() {
    let mut rgb = vec![0; 64 * 64 * 3];
    for mut env in environments() {
        let space = env.spec().action_space.clone();
        let mut allocated = vec![];
        for step in 0..120 {
            let action: Vec<f32> = space.sample(&mut Key::new(7).at(step).rng()).iter().map(|&x| x as f32).collect();
            env.step(Action::Continuous(&action)).expect("stepping the environment");
            let mut draw = || env.render(FrameMut::new(64, 64, &mut rgb)).expect("rendering a frame");
            allocated.push(allocation::allocations(|| render::with(Choice::Cpu, &mut draw)));
        }
        assert!(allocated[60..].iter().all(|&count| count == 0), "{}: {allocated:?}", env.spec().id);
    }
}

#[test]
fn rendering_on_several_threads_allocates_no_memory() {
    // Allocations are counted on the calling thread, which belongs to the pool.
    let pool = swm_core::pool::threads(3).expect("creating a thread pool");
    let mut envs = environments();
    pool.install(|| thread_budget::all(|| assert_eq!(allocations_of_rendering(160, &mut envs), 0)));
}
