#![doc = include_str!("README.md")]

mod expert;
mod physics;
mod render;

use super::{Classic, Controller, Paint, Parameter, Surface, World, angle};
use physics::{FASTEST, Physics};
use rand::Rng as _;
use std::f64::consts::PI;
use swm_core::{DType, EnvEntry, ExpertEntry, Result, Rng, Space, Transition};

/// The registry row.
pub const ENTRY: EnvEntry = EnvEntry {
    id: Pendulum::ID,
    summary: "swing a rod up with a motor too weak to lift it, and hold it upright",
    options: &[],
    make: |_| Ok(Box::new(Classic::<Pendulum>::new())),
    experts: &[ExpertEntry {
        id: "expert",
        summary: "pumps energy into the rod until it can be caught, then holds it (state feedback)",
        make: || Box::new(Controller::<Pendulum>::new()),
    }],
};

/// A rod around its end.
struct Pendulum(Physics);

/// Actions are bounded by this, whatever the motor can do.
const TORQUE: f64 = 2.0;
/// The start is drawn from this around 0: angle and angular speed.
const START: [f64; 2] = [PI, 1.0];
/// How near to the goal angle, in radians, and angular speed, in radians a second, must be.
const NEAR: [f64; 2] = [0.2, 1.0];

impl World for Pendulum {
    const ID: &'static str = "swm/PendulumControl-v1";
    const LIMIT: usize = 200;
    const OBSERVED: &'static [(f64, f64)] = &[(-1.0, 1.0), (-1.0, 1.0), (-8.0, 8.0)];
    const SIZE: (usize, usize) = render::SIZE;
    const PHYSICS: &'static [Parameter] = &[
        Parameter("dt", [0.025, 0.1], 0.05),
        Parameter("g", [5.0, 15.0], 10.0),
        Parameter("l", [0.5, 1.5], 1.0),
        Parameter("m", [0.5, 1.5], 1.0),
        Parameter("max_speed", [4.0, FASTEST], 8.0),
        Parameter("max_torque", [1.0, 4.0], 2.0),
    ];
    const VISUALS: &'static [Paint] = &[
        Paint("bg", [0.6, 1.0], [255; 3]),
        Paint("rod", [0.0, 1.0], render::ROD),
        Paint("hub", [0.0, 0.4], render::HUB),
    ];

    /// Angle from upright, angular speed, and the torque of the last step, which the picture shows.
    type State = [f64; 3];

    fn action_space() -> Space {
        Space::uniform_box([1], DType::Float32, -TORQUE, TORQUE)
    }

    fn new(physics: &[f32]) -> Self {
        Self(Physics::new(physics))
    }

    fn start(rng: &mut Rng) -> Self::State {
        let [angle, turn] = START.map(|bound| rng.random_range(-bound..bound));
        [angle, turn, 0.0]
    }

    fn task(_rng: &mut Rng) -> Self::State {
        [0.0; 3]
    }

    fn step(&self, state: &mut Self::State, action: f64) -> Transition {
        self.0.step(state, action)
    }

    #[allow(clippy::cast_possible_truncation)]
    fn observe(&[angle, turn, _]: &Self::State, row: &mut [f32]) {
        row.copy_from_slice(&[angle.cos(), angle.sin(), turn].map(|v| v as f32));
    }

    fn states() -> Space {
        let bounds = [1.0, 1.0, f64::from(FASTEST)];
        Space::Box { shape: vec![3], dtype: DType::Float64, low: bounds.map(|v| -v).to_vec(), high: bounds.to_vec() }
    }

    fn shown(observed: &[f64]) -> Self::State {
        [angle::of(observed[0], observed[1]), observed[2], 0.0]
    }

    fn parse(what: &str, observed: &[f64]) -> Result<Self::State> {
        Self::states().check(what, observed)?;
        angle::check(what, observed[0], observed[1])?;
        Ok(Self::shown(observed))
    }

    fn reached(&self, state: &Self::State, goal: &Self::State) -> bool {
        angle::between(state[0], goal[0]).abs() <= NEAR[0] && (state[1] - goal[1]).abs() <= NEAR[1]
    }

    fn distance(&self, state: &Self::State, goal: &Self::State) -> f64 {
        let fall = self.0.fall();
        let energy = |[angle, turn, _]: &Self::State| turn * turn / 2.0 + fall * angle.cos();
        let away = angle::between(state[0], goal[0]).abs() / NEAR[0] + (state[1] - goal[1]).abs() / NEAR[1];
        away + (energy(state) - energy(goal)).abs()
    }

    fn control(&self, state: &Self::State, _goal: &Self::State) -> f64 {
        expert::torque(&self.0, state, TORQUE)
    }

    fn draw_background(&self, _surface: &mut Surface) {}

    fn draw(&self, state: &Self::State, surface: &mut Surface) {
        render::rod(surface, state);
    }
}
