//! [`SuiteTask`]: runs a task of any [`Domain`] in [`MujocoEnv`], the environment shared by all families.

use super::domain::Domain;
use super::goal::GoalCoordinates;
use super::model_source::ModelSource;
use super::observation::ObservationWriter;
use super::replace_values::replace_values;
use crate::Physics;
use crate::env::MujocoEnv;
use crate::physics::shared_model;
use crate::render::Camera;
use crate::task::{FIRST_TASK_COLUMN, StepOutcome, Task};
use mujoco_rs::wrappers::MjModel;
use rand::Rng as _;
use std::marker::PhantomData;
use std::ops::RangeInclusive;
use std::sync::Arc;
use swm_core::{
    ColumnSpec, DType, Env, EnvChoice, EnvEntry, EnvOption, EnvSpec, Error, ExpertEntry, FactorValues, Key, Result,
    Rng, RowMut, Space, VariationRequest, VariationSpace, columns,
};

/// Control steps per action (the reference's action repeat).
const ACTION_REPEAT: usize = 2;
/// The maximal number of elements of an observation.
const MAX_OBSERVATION: usize = 256;
/// The maximal number of starts that are tried to find a stable one.
const START_TRIES: u64 = 10;
/// The maximal number of random walks that are tried to find a goal.
const GOAL_TRIES: u64 = 32;
/// The range of the number of actions of a random walk.
const GOAL_STEPS: RangeInclusive<usize> = 5..=25;

// Indices of the columns.
const GOAL_STATE: usize = FIRST_TASK_COLUMN;
const OBSERVATION: usize = FIRST_TASK_COLUMN + 1;
const QPOS: usize = FIRST_TASK_COLUMN + 2;
const QVEL: usize = FIRST_TASK_COLUMN + 3;
const SCORE: usize = FIRST_TASK_COLUMN + 4;
const INFO: usize = FIRST_TASK_COLUMN + 5;

/// A task of a domain, as the shared environment runs it.
pub struct SuiteTask<D: Domain> {
    domain: D,
    task: D::Task,
    source: ModelSource,
    coordinates: GoalCoordinates,
    /// The controls of each actuator for the actions -1 and 1.
    control_ranges: Vec<[f64; 2]>,
    /// The sum of all rewards of the episode.
    score: f64,
    /// The position of the task's target.
    target: Vec<f64>,
    /// `qpos` and `qvel` of the goal.
    goal: Vec<f64>,
}

/// The options of every environment of the suite.
struct Options<D>(PhantomData<D>);

impl<D: Domain> Options<D> {
    const ALL: &'static [EnvOption] =
        &[EnvOption { key: "task", summary: "the task, which decides start and reward", values: D::TASKS.names }];
}

/// The registry row of a domain.
pub const fn entry<D: Domain>(experts: &'static [ExpertEntry]) -> EnvEntry {
    EnvEntry { id: D::ID, summary: D::SUMMARY, options: Options::<D>::ALL, make: make::<D>, experts }
}

/// Creates an environment.
///
/// # Errors
/// When MuJoCo or the models of the suite are not installed.
fn make<D: Domain>(choice: &EnvChoice) -> Result<Box<dyn Env>> {
    let (spec, model, task) = env_arguments::<D>(choice)?;
    Ok(Box::new(MujocoEnv::new(spec, model, task)?))
}

/// Returns the arguments of [`MujocoEnv::new`]: specification, compiled model and task.
pub(super) fn env_arguments<D: Domain>(choice: &EnvChoice) -> Result<(EnvSpec, Arc<MjModel>, SuiteTask<D>)> {
    let name = choice.choices.get("task");
    let task = D::TASKS.get(name);
    let source = ModelSource::read(D::MODEL, |text| D::prepare_xml(text, task))?;
    let variation_space = VariationSpace::new(D::factors(), &[]);
    let none = VariationRequest { variation: Some(vec![]), ..VariationRequest::default() };
    let defaults = variation_space.resolve(&none, Key::new(0))?;
    let model = shared_model(&format!("{},{name}", D::ID), || source.compile(&defaults, |edit| D::edit(edit, task)))?;

    let domain = D::new(&model, task)?;
    let mut physics = Physics::new(Arc::clone(&model))?;
    domain.configure_model(&mut physics);
    let mut row = [0.0; MAX_OBSERVATION];
    let mut observation = ObservationWriter::new(&mut row);
    domain.observe(&physics, &mut observation);
    let observation_len = observation.written();
    let mut target = vec![0.0; D::TARGET_LEN];
    domain.target(&physics, &mut target);

    let (nq, nv) = (physics.data().qpos().len(), physics.data().qvel().len());
    let control_ranges = model.actuator_ctrlrange().to_vec();
    let mut columns = vec![
        ColumnSpec::new(columns::GOAL_STATE, DType::Float64, [nq + nv]),
        ColumnSpec::new("observation", DType::Float32, [observation_len]),
        ColumnSpec::new("qpos", DType::Float64, [nq]),
        ColumnSpec::new("qvel", DType::Float64, [nv]),
        ColumnSpec::new("score", DType::Float64, []),
    ];
    columns.extend(D::INFO.iter().map(|column| match column.len {
        1 => ColumnSpec::new(column.name, DType::Float64, []),
        len => ColumnSpec::new(column.name, DType::Float64, [len]),
    }));
    let unbounded = Space::uniform_box([observation_len], DType::Float32, f64::NEG_INFINITY, f64::INFINITY);
    let spec = EnvSpec {
        id: choice.id(),
        action_space: Space::uniform_box([control_ranges.len()], DType::Float32, -1.0, 1.0),
        columns,
        observation_space: vec![("observation", unbounded)],
        variation_space,
        max_episode_steps: D::MAX_STEPS,
        cameras: vec![],
        angles: vec![],
    };
    let coordinates = GoalCoordinates::new(&model, D::IGNORED_JOINTS);
    let goal = vec![0.0; nq + nv];
    let task = SuiteTask { domain, task, source, coordinates, control_ranges, score: 0.0, target, goal };
    Ok((spec, model, task))
}

impl<D: Domain> SuiteTask<D> {
    /// Compiles the model for these factors. With a sky texture of one pixel (`sky` false), compilation is about 200
    /// times faster.
    pub(super) fn compile(&self, factors: &FactorValues, sky: bool) -> Result<MjModel> {
        self.source.compile(factors, |edit| {
            if !sky {
                edit.shrink_sky();
            }
            D::edit(edit, self.task)
        })
    }

    /// Applies an action, in double precision.
    pub(super) fn apply_action(&mut self, physics: &mut Physics, action: impl Iterator<Item = f64>) -> StepOutcome {
        let controls = physics.data_mut().ctrl_mut().iter_mut();
        for ((control, &[low, high]), action) in controls.zip(&self.control_ranges).zip(action) {
            *control = low + (high - low) / 2.0 * (action + 1.0);
        }
        let (mut reward, mut terminated) = (0.0, false);
        for _ in 0..ACTION_REPEAT {
            physics.step_control(D::SUBSTEPS);
            reward += self.domain.reward(physics);
            terminated = self.domain.terminates_at_goal() && self.is_success(physics);
            if terminated || physics.is_unstable() {
                break;
            }
        }
        self.score += reward;
        StepOutcome { reward, terminated }
    }

    /// Takes a random walk. Returns `qpos` and `qvel` of the first state after the drawn number of steps that is within
    /// the joint limits and differs from the start; `None` if the walk reaches no such state.
    fn random_walk(&self, physics: &mut Physics, rng: &mut Rng) -> Option<Vec<f64>> {
        let from = physics.data().qpos().to_vec();
        let (min_steps, mut hold) = (rng.random_range(GOAL_STEPS), 0);
        for step in 1..=*GOAL_STEPS.end() {
            // Each action is repeated for several steps, because the effects of independent actions would cancel out.
            if hold == 0 {
                hold = rng.random_range(1..=5);
                for (control, &[low, high]) in physics.data_mut().ctrl_mut().iter_mut().zip(&self.control_ranges) {
                    *control = rng.random_range(low..=high);
                }
            }
            hold -= 1;
            physics.step_control(D::SUBSTEPS * ACTION_REPEAT);
            if physics.is_unstable() {
                return None;
            }
            let qpos = physics.data().qpos();
            let is_new = || !self.coordinates.reached(&from, qpos, D::GOAL_TOLERANCE);
            if step >= min_steps && self.coordinates.within_limits(qpos, D::GOAL_TOLERANCE / 2.0) && is_new() {
                return Some([qpos, physics.data().qvel()].concat());
            }
        }
        None
    }

    /// Takes random walks until a walk reaches a new goal.
    fn find_goal(&mut self, physics: &mut Physics, key: Key) -> Result<()> {
        let mut saved = vec![];
        physics.save(&mut saved);
        for attempt in 0..GOAL_TRIES {
            if let Some(goal) = self.random_walk(physics, &mut key.at(attempt).rng()) {
                self.goal = goal;
                return Ok(());
            }
            physics.load(&saved)?;
        }
        Err(Error::Unsatisfiable {
            factor: "goal".to_owned(),
            constraint: "reached by random actions, and not already reached".to_owned(),
            tries: GOAL_TRIES as usize,
        })
    }
}

impl<D: Domain> Task for SuiteTask<D> {
    fn apply_factors(&mut self, physics: &mut Physics, factors: &FactorValues) -> Result<()> {
        if factors.iter().zip(factors.factors()).all(|((_, value), factor)| *value == factor.init_value) {
            physics.restore_model();
        } else {
            replace_values(physics.model_mut(), &self.compile(factors, false)?)?;
        }
        physics.mark_textures_edited();
        self.domain.configure_model(physics);
        // The compiled model has the default target.
        self.domain.set_target(physics, &self.target);
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
        if self.domain.goal_qpos(physics, &mut self.goal[..nq]) && !self.is_success(physics) {
            return Ok(());
        }
        let mut saved = vec![];
        physics.save(&mut saved);
        self.find_goal(physics, key.with("goal"))?;
        physics.load(&saved)
    }

    fn step(&mut self, physics: &mut Physics, action: &[f32]) -> StepOutcome {
        self.apply_action(physics, action.iter().map(|&value| f64::from(value)))
    }

    fn observe(&self, physics: &Physics, row: &mut RowMut<'_>) {
        row.set(GOAL_STATE, &self.goal);
        self.domain.observe(physics, &mut ObservationWriter::new(row.at(OBSERVATION)));
        row.set(QPOS, physics.data().qpos());
        row.set(QVEL, physics.data().qvel());
        row.set(SCORE, &[self.score / 1000.0]);
        for (i, column) in D::INFO.iter().enumerate() {
            (column.write)(&self.domain, physics, row.at(INFO + i));
        }
    }

    fn task_state_len(&self, _model: &MjModel) -> usize {
        1 + D::TARGET_LEN
    }

    fn save_task_state(&self, into: &mut [f64]) {
        into[0] = self.score;
        into[1..].copy_from_slice(&self.target);
    }

    fn load_task_state(&mut self, physics: &mut Physics, task_state: &[f64]) {
        self.score = task_state[0];
        self.target.copy_from_slice(&task_state[1..]);
        self.domain.set_target(physics, &self.target);
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

    fn set_goal_state(&mut self, _physics: &mut Physics, state: &[f64], _task_state: &[f64]) -> Result<()> {
        // `qpos` and `qvel` follow the time.
        let n = self.goal.len();
        self.goal.copy_from_slice(&state[1..=n]);
        Ok(())
    }

    fn sample_goal(&mut self, physics: &mut Physics, key: Key) -> Result<()> {
        self.find_goal(physics, key)
    }

    fn move_to_goal(&mut self, physics: &mut Physics) {
        let nq = physics.data().qpos().len();
        physics.data_mut().qpos_mut().copy_from_slice(&self.goal[..nq]);
        physics.forward();
    }

    fn is_success(&self, physics: &Physics) -> bool {
        let qpos = physics.data().qpos();
        let goal = &self.goal[..qpos.len()];
        let reached = self.domain.goal_reached(physics, goal);
        reached.unwrap_or_else(|| self.coordinates.reached(qpos, goal, D::GOAL_TOLERANCE))
    }

    fn goal_distance(&self, physics: &Physics) -> f64 {
        let qpos = physics.data().qpos();
        let goal = &self.goal[..qpos.len()];
        self.domain.goal_distance(physics, goal).unwrap_or_else(|| self.coordinates.distance(qpos, goal))
    }

    fn camera(&self) -> Camera {
        Camera::Fixed(D::CAMERA)
    }
}
