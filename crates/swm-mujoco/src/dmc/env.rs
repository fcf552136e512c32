//! The task of any [`Domain`], in the physics that all worlds share.

use super::Domain;
use super::adopt::adopt;
use super::blueprint::Blueprint;
use super::goal::Coordinates;
use crate::Physics;
use crate::env::MujocoEnv;
use crate::physics::shared_model;
use crate::render::Camera;
use crate::task::{FIRST_TASK_COLUMN, StepOutcome, Task};
use mujoco_rs::wrappers::MjModel;
use rand::Rng as _;
use std::borrow::Borrow;
use std::ops::RangeInclusive;
use std::sync::Arc;
use swm_core::{
    ColumnSpec, DType, Env, EnvChoice, EnvSpec, Error, FactorValues, Key, Result, Rng, RowMut, Space, VariationRequest,
    VariationSpace,
};

/// Control steps in which an action is held.
const REPEAT: usize = 2;
/// The most numbers an observation has.
const MAX_OBSERVED: usize = 256;
/// How many starts are tried until one does not run away.
const START_TRIES: u64 = 10;
/// How many walks are taken until one leads to a new goal, and how many steps each may have.
const GOAL_TRIES: u64 = 32;
const GOAL_STEPS: RangeInclusive<usize> = 5..=25;

/// Places of columns, from [`FIRST_TASK_COLUMN`] on.
const GOAL_STATE: usize = FIRST_TASK_COLUMN;
const OBSERVATION: usize = FIRST_TASK_COLUMN + 1;
const QPOS: usize = FIRST_TASK_COLUMN + 2;
const QVEL: usize = FIRST_TASK_COLUMN + 3;
const SCORE: usize = FIRST_TASK_COLUMN + 4;
const INFO: usize = FIRST_TASK_COLUMN + 5;

/// An observation while it is written.
pub struct Seen<'a> {
    row: &'a mut [f32],
    written: usize,
}

impl Seen<'_> {
    /// Appends a number.
    pub fn push(&mut self, number: f64) {
        self.row[self.written] = number as f32;
        self.written += 1;
    }

    /// Appends numbers.
    pub fn extend(&mut self, numbers: impl IntoIterator<Item = impl Borrow<f64>>) {
        numbers.into_iter().for_each(|number| self.push(*number.borrow()));
    }
}

/// A world of the suite, apart from its physics.
pub struct Control<D: Domain> {
    domain: D,
    task: D::Task,
    blueprint: Blueprint,
    coordinates: Coordinates,
    /// The controls that the actions -1 and 1 stand for.
    ranges: Vec<[f64; 2]>,
    /// All rewards of the episode, added.
    score: f64,
    /// Where the task's target is.
    target: Vec<f64>,
    /// The goal's `qpos` and `qvel`.
    goal: Vec<f64>,
}

/// Makes a world of the suite.
///
/// # Errors
/// When MuJoCo or the models of the suite are not installed.
pub fn make<D: Domain>(choice: &EnvChoice) -> Result<Box<dyn Env>> {
    let (spec, model, control) = parts::<D>(choice)?;
    Ok(Box::new(MujocoEnv::new(spec, model, control)?))
}

/// What a world of the suite is made of.
pub(super) fn parts<D: Domain>(choice: &EnvChoice) -> Result<(EnvSpec, Arc<MjModel>, Control<D>)> {
    let name = choice.choices.get("task");
    let task = D::TASKS.iter().find(|(known, _)| *known == name).unwrap_or(&D::TASKS[0]).1;
    let blueprint = Blueprint::read(D::MODEL, |text| D::draft(text, task))?;
    let variation_space = VariationSpace::new(D::factors(), &[]);
    let none = VariationRequest { variation: Some(vec![]), ..VariationRequest::default() };
    let defaults = variation_space.resolve(&none, Key::new(0))?;
    let model =
        shared_model(&format!("{},{name}", D::ID), || blueprint.compile(&defaults, |edit| D::edit(edit, task)))?;

    let domain = D::new(&model, task)?;
    let mut physics = Physics::new(Arc::clone(&model))?;
    domain.adapt(&mut physics);
    let mut row = [0.0; MAX_OBSERVED];
    let mut seen = Seen { row: &mut row, written: 0 };
    domain.observe(&physics, &mut seen);
    let observed = seen.written;
    let mut target = vec![0.0; D::TARGET];
    domain.target(&physics, &mut target);

    let (nq, nv) = (physics.data().qpos().len(), physics.data().qvel().len());
    let ranges = model.actuator_ctrlrange().to_vec();
    let mut columns = vec![
        ColumnSpec::new("goal_state", DType::Float64, [nq + nv]),
        ColumnSpec::new("observation", DType::Float32, [observed]),
        ColumnSpec::new("qpos", DType::Float64, [nq]),
        ColumnSpec::new("qvel", DType::Float64, [nv]),
        ColumnSpec::new("score", DType::Float64, []),
    ];
    columns.extend(D::INFO.iter().map(|&(name, n)| match n {
        1 => ColumnSpec::new(name, DType::Float64, []),
        n => ColumnSpec::new(name, DType::Float64, [n]),
    }));
    let unbounded = Space::uniform_box([observed], DType::Float32, f64::NEG_INFINITY, f64::INFINITY);
    let spec = EnvSpec {
        id: choice.id(),
        action_space: Space::uniform_box([ranges.len()], DType::Float32, -1.0, 1.0),
        columns,
        observation_space: vec![("observation", unbounded)],
        variation_space,
        max_episode_steps: D::LIMIT,
        cameras: vec![],
    };
    let coordinates = Coordinates::new(&model, D::IDLE);
    let control =
        Control { domain, task, blueprint, coordinates, ranges, score: 0.0, target, goal: vec![0.0; nq + nv] };
    Ok((spec, model, control))
}

impl<D: Domain> Control<D> {
    /// Compiles the model of these factors; without its sky, all but at once.
    pub(super) fn compile(&self, factors: &FactorValues, sky: bool) -> Result<MjModel> {
        self.blueprint.compile(factors, |edit| {
            if !sky {
                edit.shrink_sky();
            }
            D::edit(edit, self.task)
        })
    }

    /// Holds an action, in double precision.
    pub(super) fn hold(&mut self, physics: &mut Physics, action: impl Iterator<Item = f64>) -> StepOutcome {
        for ((control, &[low, high]), action) in physics.data_mut().ctrl_mut().iter_mut().zip(&self.ranges).zip(action)
        {
            *control = low + (high - low) / 2.0 * (action + 1.0);
        }
        let (mut reward, mut terminated) = (0.0, false);
        for _ in 0..REPEAT {
            physics.step_control(D::SUBSTEPS);
            reward += self.domain.reward(physics);
            terminated = self.domain.ends_at_goal() && self.is_success(physics);
            if terminated || physics.is_unstable() {
                break;
            }
        }
        self.score += reward;
        StepOutcome { reward, terminated }
    }

    /// Where random actions lead: `qpos` and `qvel`, as soon as that is somewhere new where the world can stay, after as many
    /// steps as are drawn.
    fn wander(&self, physics: &mut Physics, rng: &mut Rng) -> Option<Vec<f64>> {
        let from = physics.data().qpos().to_vec();
        let (enough, mut left) = (rng.random_range(GOAL_STEPS), 0);
        for step in 1..=*GOAL_STEPS.end() {
            // An action is held for some steps: random ones in each step would cancel out.
            if left == 0 {
                left = rng.random_range(1..=5);
                for (control, &[low, high]) in physics.data_mut().ctrl_mut().iter_mut().zip(&self.ranges) {
                    *control = rng.random_range(low..=high);
                }
            }
            left -= 1;
            physics.step_control(D::SUBSTEPS * REPEAT);
            if physics.is_unstable() {
                return None;
            }
            let there = physics.data().qpos();
            let new = || !self.coordinates.reached(&from, there, D::NEAR);
            if step >= enough && self.coordinates.can_stay(there, D::NEAR / 2.0) && new() {
                return Some([there, physics.data().qvel()].concat());
            }
        }
        None
    }

    /// Takes walks until one leads to a new goal.
    fn seek(&mut self, physics: &mut Physics, key: Key) -> Result<()> {
        let mut here = vec![];
        physics.save(&mut here);
        for attempt in 0..GOAL_TRIES {
            if let Some(goal) = self.wander(physics, &mut key.at(attempt).rng()) {
                self.goal = goal;
                return Ok(());
            }
            physics.load(&here)?;
        }
        Err(Error::Unsatisfiable {
            factor: "goal".to_owned(),
            constraint: "where random actions lead, and not reached already".to_owned(),
            tries: GOAL_TRIES as usize,
        })
    }
}

impl<D: Domain> Task for Control<D> {
    fn apply_factors(&mut self, physics: &mut Physics, factors: &FactorValues) -> Result<()> {
        if factors.iter().zip(factors.factors()).all(|((_, value), factor)| *value == factor.init_value) {
            physics.restore_model();
        } else {
            adopt(physics.model_mut(), &self.compile(factors, false)?)?;
        }
        physics.mark_textures_edited();
        self.domain.adapt(physics);
        // A target stays where it is, whatever the model was compiled with.
        self.domain.place(physics, &self.target);
        Ok(())
    }

    fn overwrites_edits(&self) -> bool {
        true
    }

    fn start(&mut self, physics: &mut Physics, _factors: &FactorValues, key: Key) -> Result<()> {
        let mut attempt = 0;
        loop {
            physics.reset();
            physics.forward_passive();
            self.domain.start(physics, &mut key.at(attempt).rng())?;
            attempt += 1;
            if !physics.is_unstable() {
                break;
            }
            if attempt == START_TRIES {
                let constraint = "stable physics".to_owned();
                return Err(Error::Unsatisfiable {
                    factor: "start".to_owned(),
                    constraint,
                    tries: START_TRIES as usize,
                });
            }
        }
        self.score = 0.0;
        self.domain.target(physics, &mut self.target);
        self.goal.fill(0.0);
        let nq = physics.data().qpos().len();
        if self.domain.destination(physics, &mut self.goal[..nq]) && !self.is_success(physics) {
            return Ok(());
        }
        let mut here = vec![];
        physics.save(&mut here);
        self.seek(physics, key.with("goal"))?;
        physics.load(&here)
    }

    fn step(&mut self, physics: &mut Physics, action: &[f32]) -> StepOutcome {
        self.hold(physics, action.iter().map(|&number| f64::from(number)))
    }

    fn observe(&self, physics: &Physics, row: &mut RowMut<'_>) {
        row.set(GOAL_STATE, &self.goal);
        self.domain.observe(physics, &mut Seen { row: row.at(OBSERVATION), written: 0 });
        row.set(QPOS, physics.data().qpos());
        row.set(QVEL, physics.data().qvel());
        row.set(SCORE, &[self.score / 1000.0]);
        for column in 0..D::INFO.len() {
            self.domain.info(physics, column, row.at(INFO + column));
        }
    }

    fn task_state_len(&self, _model: &MjModel) -> usize {
        1 + D::TARGET
    }

    fn save_task_state(&self, into: &mut [f64]) {
        into[0] = self.score;
        into[1..].copy_from_slice(&self.target);
    }

    fn load_task_state(&mut self, physics: &mut Physics, memory: &[f64]) {
        self.score = memory[0];
        self.target.copy_from_slice(&memory[1..]);
        self.domain.place(physics, &self.target);
    }

    fn goal_len(&self) -> usize {
        self.goal.len()
    }

    fn save_goal(&self, into: &mut [f64]) {
        into.copy_from_slice(&self.goal);
    }

    fn load_goal(&mut self, goal: &[f64]) {
        self.goal.copy_from_slice(goal);
    }

    fn set_goal_state(&mut self, _physics: &mut Physics, state: &[f64], _memory: &[f64]) -> Result<()> {
        // Behind the time stand `qpos` and `qvel`.
        let n = self.goal.len();
        self.goal.copy_from_slice(&state[1..=n]);
        Ok(())
    }

    fn sample_goal(&mut self, physics: &mut Physics, key: Key) -> Result<()> {
        self.seek(physics, key)
    }

    fn move_to_goal(&mut self, physics: &mut Physics) {
        let nq = physics.data().qpos().len();
        physics.data_mut().qpos_mut().copy_from_slice(&self.goal[..nq]);
        physics.forward();
    }

    fn is_success(&self, physics: &Physics) -> bool {
        let qpos = physics.data().qpos();
        let goal = &self.goal[..qpos.len()];
        self.domain.reached(physics, goal).unwrap_or_else(|| self.coordinates.reached(qpos, goal, D::NEAR))
    }

    fn goal_distance(&self, physics: &Physics) -> f64 {
        let qpos = physics.data().qpos();
        let goal = &self.goal[..qpos.len()];
        self.domain.left(physics, goal).unwrap_or_else(|| self.coordinates.distance(qpos, goal))
    }

    fn camera(&self) -> Camera {
        Camera::Fixed(D::CAMERA)
    }
}
