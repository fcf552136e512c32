#![doc = include_str!("README.md")]

mod expert;
mod physics;
mod render;

use super::{ClassicEnv, ColorFactor, ControlTask, Controller, PhysicsFactor, Surface, angle};
use physics::{LINE, MAX_SPEED, Physics, State, height};
use rand::Rng as _;
use std::f64::consts::PI;
use swm_core::{DType, EnvEntry, ExpertEntry, Result, Rng, Space, Transition};

/// The registry row of this environment.
pub const ENTRY: EnvEntry = EnvEntry {
    id: Acrobot::ID,
    summary: "swing the end of two links above a line, with a motor in the joint between them",
    options: &[],
    make: |_| Ok(Box::new(ClassicEnv::<Acrobot>::new())),
    experts: &[ExpertEntry {
        id: "expert",
        summary: "applies torque in the direction of the joint's rotation, which adds energy in every step",
        tasks: &[],
        make: || Box::new(Controller::<Acrobot>::new()),
    }],
};

/// Two links with a motor in the joint between them.
struct Acrobot(Physics);

/// Half-width of the uniform distribution around 0 (hanging at rest) of the angles (rad) and the velocities (rad/s) at
/// the start.
const START: f64 = 0.1;
/// Tolerance of both angles for a goal below the line, in radians.
const NEAR: f64 = 0.2;

impl ControlTask for Acrobot {
    const ID: &'static str = "swm/AcrobotControl-v1";
    const MAX_EPISODE_STEPS: usize = 500;
    const STATE_BOUNDS: &'static [(f64, f64)] =
        &[(-1.0, 1.0), (-1.0, 1.0), (-1.0, 1.0), (-1.0, 1.0), (-4.0 * PI, 4.0 * PI), (-9.0 * PI, 9.0 * PI)];
    const FRAME_SIZE: (usize, usize) = render::SIZE;
    const PHYSICS_FACTORS: &'static [PhysicsFactor] = &[
        PhysicsFactor("link_com_pos_1", [0.25, 0.75], 0.5),
        PhysicsFactor("link_com_pos_2", [0.25, 0.75], 0.5),
        PhysicsFactor("link_length_1", [0.5, 1.5], 1.0),
        PhysicsFactor("link_length_2", [0.5, 1.5], 1.0),
        PhysicsFactor("link_mass_1", [0.5, 1.5], 1.0),
        PhysicsFactor("link_mass_2", [0.5, 1.5], 1.0),
        PhysicsFactor("link_moi", [0.5, 1.5], 1.0),
    ];
    const COLOR_FACTORS: &'static [ColorFactor] = &[
        ColorFactor("bg", [0.6, 1.0], [255; 3]),
        ColorFactor("link", [0.0, 1.0], render::LINK),
        ColorFactor("joint", [0.0, 1.0], render::JOINT),
        ColorFactor("line", [0.0, 0.4], render::LINE),
    ];

    type State = State;

    fn action_space() -> Space {
        Space::Discrete { n: 3, start: 0 }
    }

    fn new(physics: &[f32]) -> Self {
        Self(Physics::new(physics))
    }

    fn sample_start(rng: &mut Rng) -> Self::State {
        [(); 4].map(|()| f64::from(rng.random_range(-START..START) as f32))
    }

    fn sample_task_goal(_rng: &mut Rng) -> Self::State {
        [PI, 0.0, 0.0, 0.0]
    }

    fn step(&self, state: &mut Self::State, action: f64) -> Transition {
        self.0.step(state, action - 1.0)
    }

    fn observe(&[angle, joint, velocity, joint_velocity]: &Self::State, row: &mut [f32]) {
        let values = [angle.cos(), angle.sin(), joint.cos(), joint.sin(), velocity, joint_velocity];
        row.copy_from_slice(&values.map(|v| v as f32));
    }

    fn state_space() -> Space {
        let [velocity, joint_velocity] = MAX_SPEED.map(|speed| f64::from(speed as f32));
        let bounds = [1.0, 1.0, 1.0, 1.0, velocity, joint_velocity];
        Space::Box { shape: vec![6], dtype: DType::Float64, low: bounds.map(|v| -v).to_vec(), high: bounds.to_vec() }
    }

    fn read_state(observed: &[f64]) -> Self::State {
        let speed = |i: usize| observed[4 + i].clamp(-MAX_SPEED[i], MAX_SPEED[i]);
        [
            angle::from_cos_sin(observed[0], observed[1]),
            angle::from_cos_sin(observed[2], observed[3]),
            speed(0),
            speed(1),
        ]
    }

    fn parse_state(what: &str, observed: &[f64]) -> Result<Self::State> {
        Self::state_space().check(what, observed)?;
        angle::check(what, observed[0], observed[1])?;
        angle::check(what, observed[2], observed[3])?;
        Ok(Self::read_state(observed))
    }

    fn is_reached(&self, state: &Self::State, goal: &Self::State) -> bool {
        if height(goal) > LINE {
            return height(state) > LINE;
        }
        (0..2).all(|i| angle::between(state[i], goal[i]).abs() <= NEAR)
    }

    fn goal_distance(&self, state: &Self::State, goal: &Self::State) -> f64 {
        let missing_energy =
            (self.0.energy(goal) - self.0.energy(state)).max(0.0) / self.0.energy(&[PI, 0.0, 0.0, 0.0]);
        let distance = if height(goal) > LINE {
            if self.is_reached(state, goal) {
                return 0.0;
            }
            LINE - height(state)
        } else {
            (0..2).map(|i| angle::between(state[i], goal[i]).abs()).sum()
        };
        distance + missing_energy
    }

    fn control(&self, state: &Self::State, _goal: &Self::State) -> f64 {
        expert::torque(state) + 1.0
    }

    fn draw_background(&self, surface: &mut Surface) {
        render::line(surface, &self.0);
    }

    fn draw(&self, state: &Self::State, surface: &mut Surface) {
        render::links(surface, &self.0, state);
    }
}
