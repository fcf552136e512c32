#![doc = include_str!("README.md")]

mod expert;
mod physics;
mod render;

use super::{ClassicEnv, ColorFactor, ControlTask, Controller, PhysicsFactor, Surface, angle};
use physics::{MAX_SPEED, Physics};
use rand::Rng as _;
use std::f64::consts::PI;
use swm_core::{DType, EnvEntry, ExpertEntry, Result, Rng, Space, Transition};

/// The registry row of this environment.
pub const ENTRY: EnvEntry = EnvEntry {
    id: Pendulum::ID,
    summary: "swing a rod up with a motor too weak to lift it, and hold it upright",
    options: &[],
    make: |_| Ok(Box::new(ClassicEnv::<Pendulum>::new())),
    experts: &[ExpertEntry {
        id: "expert",
        summary: "adds energy to the rod until state feedback can hold it upright, then holds it upright",
        tasks: &[],
        make: || Box::new(Controller::<Pendulum>::new()),
    }],
};

/// A rod that rotates about its end.
struct Pendulum(Physics);

/// Bound of the actions in N m, independent of the maximal torque of the motor.
const MAX_ACTION: f64 = 2.0;
/// Half-widths of the uniform distributions of the start around 0: angle (rad) and angular velocity (rad/s).
const START: [f64; 2] = [PI, 1.0];
/// Tolerances of the goal for the angle (rad) and the angular velocity (rad/s).
const NEAR: [f64; 2] = [0.2, 1.0];

impl ControlTask for Pendulum {
    const ID: &'static str = "swm/PendulumControl-v1";
    const MAX_EPISODE_STEPS: usize = 200;
    const STATE_BOUNDS: &'static [(f64, f64)] = &[(-1.0, 1.0), (-1.0, 1.0), (-8.0, 8.0)];
    const FRAME_SIZE: (usize, usize) = render::SIZE;
    const PHYSICS_FACTORS: &'static [PhysicsFactor] = &[
        PhysicsFactor("dt", [0.025, 0.1], 0.05),
        PhysicsFactor("g", [5.0, 15.0], 10.0),
        PhysicsFactor("l", [0.5, 1.5], 1.0),
        PhysicsFactor("m", [0.5, 1.5], 1.0),
        PhysicsFactor("max_speed", [4.0, MAX_SPEED], 8.0),
        PhysicsFactor("max_torque", [1.0, 4.0], 2.0),
    ];
    const COLOR_FACTORS: &'static [ColorFactor] = &[
        ColorFactor("bg", [0.6, 1.0], [255; 3]),
        ColorFactor("rod", [0.0, 1.0], render::ROD),
        ColorFactor("hub", [0.0, 0.4], render::HUB),
    ];

    /// Angle from upright (rad), angular velocity (rad/s), and the torque of the last step (N m), which the frame
    /// shows.
    type State = [f64; 3];

    fn action_space() -> Space {
        Space::uniform_box([1], DType::Float32, -MAX_ACTION, MAX_ACTION)
    }

    fn new(physics: &[f32]) -> Self {
        Self(Physics::new(physics))
    }

    fn sample_start(rng: &mut Rng) -> Self::State {
        let [angle, velocity] = START.map(|bound| rng.random_range(-bound..bound));
        [angle, velocity, 0.0]
    }

    fn sample_task_goal(_rng: &mut Rng) -> Self::State {
        [0.0; 3]
    }

    fn step(&self, state: &mut Self::State, action: f64) -> Transition {
        self.0.step(state, action)
    }

    fn observe(&[angle, velocity, _]: &Self::State, row: &mut [f32]) {
        row.copy_from_slice(&[angle.cos(), angle.sin(), velocity].map(|v| v as f32));
    }

    fn state_space() -> Space {
        let bounds = [1.0, 1.0, f64::from(MAX_SPEED)];
        Space::Box { shape: vec![3], dtype: DType::Float64, low: bounds.map(|v| -v).to_vec(), high: bounds.to_vec() }
    }

    fn read_state(observed: &[f64]) -> Self::State {
        [angle::from_cos_sin(observed[0], observed[1]), observed[2], 0.0]
    }

    fn parse_state(what: &str, observed: &[f64]) -> Result<Self::State> {
        Self::state_space().check(what, observed)?;
        angle::check(what, observed[0], observed[1])?;
        Ok(Self::read_state(observed))
    }

    fn is_reached(&self, state: &Self::State, goal: &Self::State) -> bool {
        angle::between(state[0], goal[0]).abs() <= NEAR[0] && (state[1] - goal[1]).abs() <= NEAR[1]
    }

    fn goal_distance(&self, state: &Self::State, goal: &Self::State) -> f64 {
        let fall = self.0.gravity_acceleration();
        let energy = |[angle, velocity, _]: &Self::State| velocity * velocity / 2.0 + fall * angle.cos();
        let distance = angle::between(state[0], goal[0]).abs() / NEAR[0] + (state[1] - goal[1]).abs() / NEAR[1];
        distance + (energy(state) - energy(goal)).abs()
    }

    fn control(&self, state: &Self::State, _goal: &Self::State) -> f64 {
        expert::torque(&self.0, state, MAX_ACTION)
    }

    fn draw_background(&self, _surface: &mut Surface) {}

    fn draw(&self, state: &Self::State, surface: &mut Surface) {
        render::rod(surface, state);
    }
}
