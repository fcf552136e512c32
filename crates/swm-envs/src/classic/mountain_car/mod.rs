#![doc = include_str!("README.md")]

mod expert;
mod physics;
mod render;

use super::{ClassicEnv, ColorFactor, ControlTask, Controller, PhysicsFactor, Surface};
use physics::{ENDS, Hill, MAX_SPEED, height};
use rand::Rng as _;
use std::marker::PhantomData;
use swm_core::{DType, EnvEntry, ExpertEntry, Rng, Space, Transition};

/// The registry row of the environment with three actions.
pub const ENTRY: EnvEntry = EnvEntry {
    id: Discrete::ID,
    summary: "swing a car with a weak motor out of a valley, up to the flag",
    options: &[],
    make: |_| Ok(Box::new(ClassicEnv::<MountainCar<Discrete>>::new())),
    experts: &[ExpertEntry { make: || Box::new(Controller::<MountainCar<Discrete>>::new()), ..PUMP }],
};

/// The registry row of the environment with continuous motor power.
pub const CONTINUOUS: EnvEntry = EnvEntry {
    id: Continuous::ID,
    summary: "swing a car with a weak motor out of a valley, up to the flag, with little power",
    options: &[],
    make: |_| Ok(Box::new(ClassicEnv::<MountainCar<Continuous>>::new())),
    experts: &[ExpertEntry { make: || Box::new(Controller::<MountainCar<Continuous>>::new()), ..PUMP }],
};

/// Id and summary of both experts.
const PUMP: ExpertEntry = ExpertEntry {
    id: "expert",
    summary: "pushes in the direction of motion, so that every swing is higher than the last",
    tasks: &[],
    make: || Box::new(Controller::<MountainCar<Discrete>>::new()),
};

/// The differences between the two environments.
trait Variant: Send + 'static {
    const ID: &'static str;
    const MAX_EPISODE_STEPS: usize;
    const PHYSICS_FACTORS: &'static [PhysicsFactor];
    /// Position of the flag, in track units.
    const FLAG: f64;

    fn action_space() -> Space;

    /// Makes the hill with these values of `PHYSICS_FACTORS`.
    fn hill(physics: &[f32]) -> Hill;

    /// Returns the state after a step.
    fn step(hill: &Hill, state: [f64; 2], action: f64) -> [f64; 2];

    /// Returns the reward of a step.
    fn reward(action: f64, terminated: bool) -> f64;

    /// Returns the action of full power to the right or to the left.
    fn push(right: bool) -> f64;
}

/// The variant with three actions: push left, do nothing, push right.
struct Discrete;

impl Variant for Discrete {
    const ID: &'static str = "swm/MountainCarControl-v0";
    const MAX_EPISODE_STEPS: usize = 200;
    const PHYSICS_FACTORS: &'static [PhysicsFactor] = &[
        PhysicsFactor("force", [0.0005, 0.0015], 0.001),
        PhysicsFactor("gravity", [0.00125, 0.00375], 0.0025),
        PhysicsFactor("max_speed", [0.035, MAX_SPEED], 0.07),
    ];
    const FLAG: f64 = 0.5;

    fn action_space() -> Space {
        Space::Discrete { n: 3, start: 0 }
    }

    fn hill(physics: &[f32]) -> Hill {
        let [push, gravity, max_speed] = std::array::from_fn(|i| f64::from(physics[i]));
        Hill { push, gravity, max_speed }
    }

    fn step(hill: &Hill, state: [f64; 2], action: f64) -> [f64; 2] {
        hill.step(state, action - 1.0)
    }

    fn reward(_action: f64, _terminated: bool) -> f64 {
        -1.0
    }

    fn push(right: bool) -> f64 {
        if right { 2.0 } else { 0.0 }
    }
}

/// The variant whose action is a motor power from -1 to 1, which the reward penalises.
struct Continuous;

impl Variant for Continuous {
    const ID: &'static str = "swm/MountainCarContinuousControl-v0";
    const MAX_EPISODE_STEPS: usize = 999;
    const PHYSICS_FACTORS: &'static [PhysicsFactor] =
        &[PhysicsFactor("max_speed", [0.035, MAX_SPEED], 0.07), PhysicsFactor("power", [0.00075, 0.00225], 0.0015)];
    const FLAG: f64 = 0.45;

    fn action_space() -> Space {
        Space::uniform_box([1], DType::Float32, -1.0, 1.0)
    }

    fn hill(physics: &[f32]) -> Hill {
        Hill { max_speed: f64::from(physics[0]), push: f64::from(physics[1]), gravity: 0.0025 }
    }

    fn step(hill: &Hill, state: [f64; 2], action: f64) -> [f64; 2] {
        hill.continuous_step(state, action)
    }

    fn reward(action: f64, terminated: bool) -> f64 {
        (if terminated { 100.0 } else { 0.0 }) - action * action * 0.1
    }

    fn push(right: bool) -> f64 {
        if right { 1.0 } else { -1.0 }
    }
}

/// A car in a valley.
struct MountainCar<V>(Hill, PhantomData<V>);

/// Bounds of the start position, in track units; the car starts at rest.
const START: [f64; 2] = [-0.6, -0.4];
/// Tolerance of the position for a goal below the flag, in track units.
const NEAR: f64 = 0.05;
/// Weight of a unit of missing height in the goal distance, relative to a unit of distance.
const HEIGHT_WEIGHT: f64 = 10.0;

impl<V: Variant> MountainCar<V> {
    /// Position of the flag, rounded to the precision of the `state` column.
    const FLAG: f64 = V::FLAG as f32 as f64;

    /// Returns whether the car is at the flag and does not roll back.
    fn at_flag(state: &[f64; 2]) -> bool {
        state[0] >= Self::FLAG.min(V::FLAG) && state[1] >= 0.0
    }
}

impl<V: Variant> ControlTask for MountainCar<V> {
    const ID: &'static str = V::ID;
    const MAX_EPISODE_STEPS: usize = V::MAX_EPISODE_STEPS;
    const STATE_BOUNDS: &'static [(f64, f64)] = &[(-1.2, 0.6), (-0.07, 0.07)];
    const FRAME_SIZE: (usize, usize) = render::SIZE;
    const PHYSICS_FACTORS: &'static [PhysicsFactor] = V::PHYSICS_FACTORS;
    const COLOR_FACTORS: &'static [ColorFactor] =
        &[ColorFactor("bg", [0.6, 1.0], [255; 3]), ColorFactor("fg", [0.0, 0.4], render::INK)];

    /// Position (track units) and velocity (track units per step).
    type State = [f64; 2];

    fn action_space() -> Space {
        V::action_space()
    }

    fn new(physics: &[f32]) -> Self {
        Self(V::hill(physics), PhantomData)
    }

    fn sample_start(rng: &mut Rng) -> Self::State {
        [f64::from(rng.random_range(START[0]..START[1]) as f32), 0.0]
    }

    fn sample_task_goal(_rng: &mut Rng) -> Self::State {
        [Self::FLAG, 0.0]
    }

    fn step(&self, state: &mut Self::State, action: f64) -> Transition {
        *state = V::step(&self.0, *state, action);
        let terminated = Self::at_flag(state);
        Transition { reward: V::reward(action, terminated), terminated, truncated: false }
    }

    fn observe(state: &Self::State, row: &mut [f32]) {
        row.copy_from_slice(&state.map(|v| v as f32));
    }

    fn state_space() -> Space {
        let [low, high] = ENDS.map(|end| f64::from(end as f32));
        let max_speed = f64::from(MAX_SPEED);
        Space::Box { shape: vec![2], dtype: DType::Float64, low: vec![low, -max_speed], high: vec![high, max_speed] }
    }

    fn read_state(observed: &[f64]) -> Self::State {
        [observed[0].clamp(ENDS[0], ENDS[1]), observed[1]]
    }

    fn is_reached(&self, state: &Self::State, goal: &Self::State) -> bool {
        if Self::at_flag(goal) { Self::at_flag(state) } else { (state[0] - goal[0]).abs() <= NEAR }
    }

    fn goal_distance(&self, state: &Self::State, goal: &Self::State) -> f64 {
        if Self::at_flag(goal) && self.is_reached(state, goal) {
            return 0.0;
        }
        // The hill's slope is at most 1.35, where gravity accelerates the car by `gravity`.
        let potential = |state: &[f64; 2]| height(state[0]) / 1.35 * self.0.gravity;
        let missing_height = (potential(goal) - potential(state) - state[1] * state[1] / 2.0).max(0.0) / self.0.gravity;
        (state[0] - goal[0]).abs() + HEIGHT_WEIGHT * missing_height
    }

    fn control(&self, state: &Self::State, _goal: &Self::State) -> f64 {
        V::push(expert::pushes_right(state))
    }

    fn draw_background(&self, surface: &mut Surface) {
        render::hill(surface);
    }

    fn draw(&self, state: &Self::State, surface: &mut Surface) {
        render::car(surface, state[0], V::FLAG);
    }
}
