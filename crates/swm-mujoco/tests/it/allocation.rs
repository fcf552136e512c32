//! Nothing is allocated in a step, an observation or a picture, once a world is warm. What MuJoCo takes from its own allocator, and what a
//! driver of OpenGL does, is not counted.

use swm_conformance::allocation::{self, Counting};
use swm_core::{Action, Env, FrameMut, Key, ResetOptions, VariationRequest, thread_budget};
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

/// Worlds with default factors, and with all varied.
fn worlds() -> Vec<Box<dyn Env>> {
    let names = ["swm/CheetahDMControl-v0", "swm/HumanoidDMControl-v0", "swm/OGBCube-v0", "swm/FetchReach-v3"];
    let variation = VariationRequest { variation: Some(vec!["all".to_owned()]), ..VariationRequest::default() };
    names
        .iter()
        .flat_map(|name| [VariationRequest::default(), variation.clone()].map(|variation| (name, variation)))
        .map(|(name, variation)| {
            let mut world = ENVS.choose(name).and_then(|entry| entry.env()).expect("a world");
            world.reset(0, &ResetOptions { variation, ..ResetOptions::default() }).expect("a reset");
            world
        })
        .collect()
}

/// Draws all worlds, again and again: what is allocated once all have been in each place where something is kept of a few.
fn drawn(side: usize, worlds: &mut [Box<dyn Env>]) -> usize {
    let mut rgb = vec![0; side * side * 3];
    let mut draw = || {
        for world in &mut *worlds {
            world.render(FrameMut::new(side, side, &mut rgb)).expect("a picture");
        }
    };
    render::with(Choice::Cpu, || {
        (0..8).for_each(|_| draw());
        allocation::allocations(&mut draw)
    })
}

#[test]
fn a_thread_that_draws_worlds_in_turn_allocates_nothing() {
    assert_eq!(drawn(64, &mut worlds()), 0);
}

#[test]
fn pictures_of_moving_worlds_allocate_nothing_once_warm() {
    let mut rgb = vec![0; 64 * 64 * 3];
    for mut world in worlds() {
        let space = world.spec().action_space.clone();
        let mut allocated = vec![];
        for step in 0..120 {
            let action: Vec<f32> = space.sample(&mut Key::new(7).at(step).rng()).iter().map(|&x| x as f32).collect();
            world.step(Action::Continuous(&action)).expect("a step");
            let mut draw = || world.render(FrameMut::new(64, 64, &mut rgb)).expect("a picture");
            allocated.push(allocation::allocations(|| render::with(Choice::Cpu, &mut draw)));
        }
        assert!(allocated[60..].iter().all(|&count| count == 0), "{}: {allocated:?}", world.spec().id);
    }
}

#[test]
fn a_picture_that_threads_share_allocates_nothing() {
    // Counted on the thread that asks, which is one of the pool's.
    let pool = swm_core::pool::threads(3).expect("threads");
    let mut worlds = worlds();
    pool.install(|| thread_budget::all(|| assert_eq!(drawn(160, &mut worlds), 0)));
}
