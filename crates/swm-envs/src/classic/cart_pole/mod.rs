#![doc = include_str!("README.md")]

mod expert;
mod physics;
mod render;

use super::{ClassicEnv, ColorFactor, ControlTask, Controller, PhysicsFactor, Surface};
use physics::Physics;
use rand::Rng as _;
use swm_core::{DType, EnvEntry, ExpertEntry, Rng, Space, Transition};

/// The registry row of this environment.
pub const ENTRY: EnvEntry = EnvEntry {
    id: CartPole::ID,
    summary: "push a cart left or right so that the pole on it stays up, and bring the cart to a position",
    options: &[],
    make: |_| Ok(Box::new(ClassicEnv::<CartPole>::new())),
    experts: &[ExpertEntry {
        id: "expert",
        summary: "drives the cart to the goal without letting the pole fall (state feedback)",
        tasks: &[],
        make: || Box::new(Controller::<CartPole>::new()),
    }],
};

/// A cart with a pole on it.
struct CartPole(Physics);

/// Half-width of the uniform distribution around 0 from which every value of the start state is drawn.
const START: f64 = 0.05;
/// Least and greatest distance of the goal from the centre of the track, in metres.
const GOAL: [f64; 2] = [0.5, 1.5];
/// Tolerances of the goal for the position of the cart (metres) and the angle of the pole (radians).
const NEAR: [f64; 2] = [0.1, 0.1];
/// Twice the angle at which an episode ends, in radians: the bound of the observation in the reference.
const MAX_ANGLE: f64 = 24.0 * std::f64::consts::PI / 180.0;
/// Bound of the states that a caller may give, far beyond the values of an episode.
const MAX_STATE: f64 = 1000.0;

impl ControlTask for CartPole {
    const ID: &'static str = "swm/CartPoleControl-v1";
    const MAX_EPISODE_STEPS: usize = 500;
    const STATE_BOUNDS: &'static [(f64, f64)] =
        &[(-4.8, 4.8), (f64::NEG_INFINITY, f64::INFINITY), (-MAX_ANGLE, MAX_ANGLE), (f64::NEG_INFINITY, f64::INFINITY)];
    const FRAME_SIZE: (usize, usize) = render::SIZE;
    const PHYSICS_FACTORS: &'static [PhysicsFactor] = &[
        PhysicsFactor("force_mag", [5.0, 15.0], 10.0),
        PhysicsFactor("gravity", [4.9, 14.7], 9.8),
        PhysicsFactor("length", [0.25, 0.75], 0.5),
        PhysicsFactor("masscart", [0.5, 1.5], 1.0),
        PhysicsFactor("masspole", [0.05, 0.5], 0.1),
        PhysicsFactor("tau", [0.01, 0.04], 0.02),
    ];
    const COLOR_FACTORS: &'static [ColorFactor] = &[
        ColorFactor("bg", [0.6, 1.0], [255; 3]),
        ColorFactor("cart", [0.0, 0.4], render::CART),
        ColorFactor("pole", [0.0, 1.0], render::POLE),
        ColorFactor("axle", [0.0, 1.0], render::AXLE),
    ];

    /// Position (m) and velocity (m/s) of the cart, angle (rad) and angular velocity (rad/s) of the pole, and 1 once
    /// the pole has fallen.
    type State = [f64; 5];

    fn action_space() -> Space {
        Space::Discrete { n: 2, start: 0 }
    }

    fn new(physics: &[f32]) -> Self {
        Self(Physics::new(physics))
    }

    fn sample_start(rng: &mut Rng) -> Self::State {
        let [x, v, angle, angular_velocity] = [(); 4].map(|()| rng.random_range(-START..START));
        [x, v, angle, angular_velocity, 0.0]
    }

    fn sample_task_goal(rng: &mut Rng) -> Self::State {
        let side = if rng.random() { 1.0 } else { -1.0 };
        [side * rng.random_range(GOAL[0]..GOAL[1]), 0.0, 0.0, 0.0, 0.0]
    }

    fn step(&self, state: &mut Self::State, action: f64) -> Transition {
        self.0.step(state, action == 1.0)
    }

    fn observe(state: &Self::State, row: &mut [f32]) {
        row.iter_mut().zip(state).for_each(|(slot, &value)| *slot = value as f32);
    }

    fn state_space() -> Space {
        Space::uniform_box([Self::STATE_BOUNDS.len()], DType::Float64, -MAX_STATE, MAX_STATE)
    }

    fn read_state(observed: &[f64]) -> Self::State {
        [observed[0], observed[1], observed[2], observed[3], 0.0]
    }

    fn is_reached(&self, state: &Self::State, goal: &Self::State) -> bool {
        (state[0] - goal[0]).abs() <= NEAR[0] && (state[2] - goal[2]).abs() <= NEAR[1]
    }

    fn goal_distance(&self, state: &Self::State, goal: &Self::State) -> f64 {
        (state[0] - goal[0]).abs() / NEAR[0] + (state[2] - goal[2]).abs() / NEAR[1]
    }

    fn control(&self, state: &Self::State, goal: &Self::State) -> f64 {
        f64::from(u8::from(expert::pushes_right(&self.0, state, goal[0])))
    }

    fn draw_background(&self, surface: &mut Surface) {
        render::track(surface);
    }

    fn draw(&self, state: &Self::State, surface: &mut Surface) {
        render::cart(surface, state, self.0.length);
    }
}
