#![doc = include_str!("README.md")]

mod expert;
mod physics;
mod render;

use super::{Classic, Paint, Parameter, Surface, World};
use physics::Physics;
use rand::Rng as _;
use swm_core::{DType, EnvEntry, ExpertEntry, Rng, Space, Transition};

/// The registry row.
pub const ENTRY: EnvEntry = EnvEntry {
    id: CartPole::ID,
    summary: "push a cart left or right so that the pole on it stays up, and take it to a place",
    options: &[],
    make: |_| Ok(Box::new(Classic::<CartPole>::new())),
    experts: &[ExpertEntry {
        id: "expert",
        summary: "drives the cart to the goal without letting the pole fall (state feedback)",
        make: || Box::new(super::Controller::<CartPole>::new()),
    }],
};

/// A cart with a pole on it.
struct CartPole(Physics);

/// The start is drawn from this around 0, every number.
const START: f64 = 0.05;
/// The goal of an episode is this far from the middle of the track, at least and at most.
const GOAL: [f64; 2] = [0.5, 1.5];
/// How near to the goal the cart, in metres, and the pole, in radians, must be.
const NEAR: [f64; 2] = [0.1, 0.1];
/// Twice the tilt at which an episode ends, in radians: what the reference names as the bound of an observation.
const TILT: f64 = 24.0 * std::f64::consts::PI / 180.0;
/// States asked for are bounded by this: far beyond what anyone can make of an episode.
const FAR: f64 = 1000.0;

impl World for CartPole {
    const ID: &'static str = "swm/CartPoleControl-v1";
    const LIMIT: usize = 500;
    const OBSERVED: &'static [(f64, f64)] =
        &[(-4.8, 4.8), (f64::NEG_INFINITY, f64::INFINITY), (-TILT, TILT), (f64::NEG_INFINITY, f64::INFINITY)];
    const SIZE: (usize, usize) = render::SIZE;
    const PHYSICS: &'static [Parameter] = &[
        Parameter("force_mag", [5.0, 15.0], 10.0),
        Parameter("gravity", [4.9, 14.7], 9.8),
        Parameter("length", [0.25, 0.75], 0.5),
        Parameter("masscart", [0.5, 1.5], 1.0),
        Parameter("masspole", [0.05, 0.5], 0.1),
        Parameter("tau", [0.01, 0.04], 0.02),
    ];
    const VISUALS: &'static [Paint] = &[
        Paint("bg", [0.6, 1.0], [255; 3]),
        Paint("cart", [0.0, 0.4], render::CART),
        Paint("pole", [0.0, 1.0], render::POLE),
        Paint("axle", [0.0, 1.0], render::AXLE),
    ];

    /// Place and speed of the cart, angle and speed of the pole, and 1 once it fell.
    type State = [f64; 5];

    fn action_space() -> Space {
        Space::Discrete { n: 2, start: 0 }
    }

    fn new(physics: &[f32]) -> Self {
        Self(Physics::new(physics))
    }

    fn start(rng: &mut Rng) -> Self::State {
        let [x, v, angle, turn] = [(); 4].map(|()| rng.random_range(-START..START));
        [x, v, angle, turn, 0.0]
    }

    fn task(rng: &mut Rng) -> Self::State {
        let side = if rng.random() { 1.0 } else { -1.0 };
        [side * rng.random_range(GOAL[0]..GOAL[1]), 0.0, 0.0, 0.0, 0.0]
    }

    fn step(&self, state: &mut Self::State, action: f64) -> Transition {
        self.0.step(state, action == 1.0)
    }

    #[allow(clippy::cast_possible_truncation)]
    fn observe(state: &Self::State, row: &mut [f32]) {
        row.iter_mut().zip(state).for_each(|(number, &value)| *number = value as f32);
    }

    fn states() -> Space {
        Space::uniform_box([Self::OBSERVED.len()], DType::Float64, -FAR, FAR)
    }

    fn shown(observed: &[f64]) -> Self::State {
        [observed[0], observed[1], observed[2], observed[3], 0.0]
    }

    fn reached(&self, state: &Self::State, goal: &Self::State) -> bool {
        (state[0] - goal[0]).abs() <= NEAR[0] && (state[2] - goal[2]).abs() <= NEAR[1]
    }

    fn distance(&self, state: &Self::State, goal: &Self::State) -> f64 {
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
