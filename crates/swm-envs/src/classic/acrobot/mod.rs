#![doc = include_str!("README.md")]

mod expert;
mod physics;
mod render;

use super::{Classic, Controller, Paint, Parameter, Surface, World, angle};
use physics::{FASTEST, LINE, Physics, State, height};
use rand::Rng as _;
use std::f64::consts::PI;
use swm_core::{DType, EnvEntry, ExpertEntry, Result, Rng, Space, Transition};

/// The registry row.
pub const ENTRY: EnvEntry = EnvEntry {
    id: Acrobot::ID,
    summary: "swing the end of two links above a line, with a motor in the joint between them",
    options: &[],
    make: |_| Ok(Box::new(Classic::<Acrobot>::new())),
    experts: &[ExpertEntry {
        id: "expert",
        summary: "turns the joint the way it turns, which adds energy until the end is high enough",
        make: || Box::new(Controller::<Acrobot>::new()),
    }],
};

/// Two links with a motor between them.
struct Acrobot(Physics);

/// The start is drawn from this around hanging still, every number.
const START: f64 = 0.1;
/// How near both angles must be to those of a goal below the line, in radians.
const NEAR: f64 = 0.2;

impl World for Acrobot {
    const ID: &'static str = "swm/AcrobotControl-v1";
    const LIMIT: usize = 500;
    const OBSERVED: &'static [(f64, f64)] =
        &[(-1.0, 1.0), (-1.0, 1.0), (-1.0, 1.0), (-1.0, 1.0), (-4.0 * PI, 4.0 * PI), (-9.0 * PI, 9.0 * PI)];
    const SIZE: (usize, usize) = render::SIZE;
    const PHYSICS: &'static [Parameter] = &[
        Parameter("link_com_pos_1", [0.25, 0.75], 0.5),
        Parameter("link_com_pos_2", [0.25, 0.75], 0.5),
        Parameter("link_length_1", [0.5, 1.5], 1.0),
        Parameter("link_length_2", [0.5, 1.5], 1.0),
        Parameter("link_mass_1", [0.5, 1.5], 1.0),
        Parameter("link_mass_2", [0.5, 1.5], 1.0),
        Parameter("link_moi", [0.5, 1.5], 1.0),
    ];
    const VISUALS: &'static [Paint] = &[
        Paint("bg", [0.6, 1.0], [255; 3]),
        Paint("link", [0.0, 1.0], render::LINK),
        Paint("joint", [0.0, 1.0], render::JOINT),
        Paint("line", [0.0, 0.4], render::LINE),
    ];

    type State = State;

    fn action_space() -> Space {
        Space::Discrete { n: 3, start: 0 }
    }

    fn new(physics: &[f32]) -> Self {
        Self(Physics::new(physics))
    }

    #[allow(clippy::cast_possible_truncation)]
    fn start(rng: &mut Rng) -> Self::State {
        [(); 4].map(|()| f64::from(rng.random_range(-START..START) as f32))
    }

    fn task(_rng: &mut Rng) -> Self::State {
        [PI, 0.0, 0.0, 0.0]
    }

    fn step(&self, state: &mut Self::State, action: f64) -> Transition {
        self.0.step(state, action - 1.0)
    }

    #[allow(clippy::cast_possible_truncation)]
    fn observe(&[angle, bend, turn, fold]: &Self::State, row: &mut [f32]) {
        row.copy_from_slice(&[angle.cos(), angle.sin(), bend.cos(), bend.sin(), turn, fold].map(|v| v as f32));
    }

    #[allow(clippy::cast_possible_truncation)]
    fn states() -> Space {
        let [turn, fold] = FASTEST.map(|speed| f64::from(speed as f32));
        let bounds = [1.0, 1.0, 1.0, 1.0, turn, fold];
        Space::Box { shape: vec![6], dtype: DType::Float64, low: bounds.map(|v| -v).to_vec(), high: bounds.to_vec() }
    }

    fn shown(observed: &[f64]) -> Self::State {
        let speed = |i: usize| observed[4 + i].clamp(-FASTEST[i], FASTEST[i]);
        [angle::of(observed[0], observed[1]), angle::of(observed[2], observed[3]), speed(0), speed(1)]
    }

    fn parse(what: &str, observed: &[f64]) -> Result<Self::State> {
        Self::states().check(what, observed)?;
        angle::check(what, observed[0], observed[1])?;
        angle::check(what, observed[2], observed[3])?;
        Ok(Self::shown(observed))
    }

    fn reached(&self, state: &Self::State, goal: &Self::State) -> bool {
        if height(goal) > LINE {
            return height(state) > LINE;
        }
        (0..2).all(|i| angle::between(state[i], goal[i]).abs() <= NEAR)
    }

    fn distance(&self, state: &Self::State, goal: &Self::State) -> f64 {
        let missing = (self.0.energy(goal) - self.0.energy(state)).max(0.0) / self.0.energy(&[PI, 0.0, 0.0, 0.0]);
        let away = if height(goal) > LINE {
            if self.reached(state, goal) {
                return 0.0;
            }
            LINE - height(state)
        } else {
            (0..2).map(|i| angle::between(state[i], goal[i]).abs()).sum()
        };
        away + missing
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
