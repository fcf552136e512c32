//! [`Table`]: step, reward and goal of a table. The module `start` has the start of episodes, `observe` the columns.

use super::config::{AWAY, CUBE_HEIGHT, FRONT, FixtureState, TableConfig, WORKSPACE, observation_len};
use super::factors;
use super::goal::{GoalCheck, Subject};
use super::objects::Objects;
use crate::Physics;
use crate::ogbench::arm::pose::{IDENTITY, Pose, Quat, Vec3};
use crate::ogbench::arm::{Arm, Proprioception, find};
use crate::render::Camera;
use crate::task::{StepOutcome, Task};
use mujoco_rs::mujoco_c::_mjtObjBase::mjOBJ_CAMERA;
use mujoco_rs::wrappers::MjModel;
use swm_core::{FactorValues, Key, Result, RowMut};

/// Time steps of 2 ms per action.
const SUBSTEPS: usize = 25;
/// The number of elements of the task state before the pose: contact, the locks, and the locks before the last step.
pub const TASK_STATE_HEAD: usize = 5;
/// The number of elements of the goal values before the cubes: subject, locks, openings, contact.
const GOAL_HEAD: usize = 6;
/// Distance outside the workspace at which a cube is brought back, in metres.
const LOST_DISTANCE: f64 = 0.2;

/// The start and the reward of episodes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mode {
    /// A random task; the reward is 1 at the goal.
    RandomTask,
    /// One task, by index; the reward is minus the number of objects that are not at their goals.
    FixedTask(usize),
    /// The factors set the start, and the goal is one object.
    DataCollection,
    /// As [`Mode::DataCollection`], but a new goal follows each reached one, and only the limit of steps ends an episode.
    Play,
}

impl Mode {
    /// Whether the factors set the start.
    pub fn starts_from_factors(self) -> bool {
        matches!(self, Self::DataCollection | Self::Play)
    }
}

/// A table task on a compiled model.
pub struct Table {
    pub(super) config: &'static TableConfig,
    pub(super) mode: Mode,
    /// Whether the cubes of a task are shuffled.
    pub(super) permute: bool,
    /// Whether an episode terminates at its goal.
    terminate: bool,
    pub(super) arm: Arm,
    pub(super) objects: Objects,
    camera: usize,
    lock_colors: [[f32; 3]; 2],
    /// The locks: 0 locked, 1 unlocked.
    pub(super) buttons: [u8; 2],
    /// The locks before the last step.
    pub(super) previous_buttons: [u8; 2],
    /// Contact of the gripper, 0 to 1.
    pub(super) contact: f64,
    /// `qpos` and `qvel` before the last step.
    pub(super) previous: Vec<f64>,
    pub(super) goal: Goal,
}

/// The goal of an episode.
pub struct Goal {
    /// The objects that the goal includes.
    pub subject: Subject,
    /// The goal pose of each cube; only the position counts for success.
    pub cubes: Vec<(Vec3, Quat)>,
    /// The goal state of the fixtures.
    pub fixtures: FixtureState,
    /// `qpos` and `qvel` of a pose at the goal.
    pub pose: Vec<f64>,
    /// Contact of the gripper in `pose`, 0 to 1.
    pub contact: f64,
    /// The observation in `pose`.
    pub observation: Vec<f64>,
    /// Whether `observation` was computed in `pose`.
    observed: bool,
}

impl Table {
    /// Finds the elements of a table in its model.
    ///
    /// # Errors
    /// When the model lacks an element.
    pub fn new(
        config: &'static TableConfig,
        model: &MjModel,
        mode: Mode,
        permute: bool,
        terminate: bool,
    ) -> Result<Self> {
        let pose = vec![0.0; model.qpos0().len() + model.dof_damping().len()];
        Ok(Self {
            config,
            mode,
            permute,
            terminate,
            arm: Arm::new(model)?,
            objects: Objects::new(model, config)?,
            camera: find(model, mjOBJ_CAMERA, FRONT)?,
            lock_colors: [[0.0; 3]; 2],
            buttons: [0; 2],
            previous_buttons: [0; 2],
            contact: 0.0,
            previous: pose.clone(),
            goal: Goal {
                subject: Subject::All,
                cubes: vec![(AWAY, IDENTITY); config.cubes],
                fixtures: FixtureState::default(),
                pose,
                contact: 0.0,
                observation: vec![0.0; observation_len(config.cubes, config.fixtures)],
                observed: false,
            },
        })
    }

    /// The state of the fixtures in a configuration.
    pub(super) fn fixture_state(&self, qpos: &[f64]) -> FixtureState {
        self.objects.fixtures.map_or_else(FixtureState::default, |fixtures| fixtures.state(qpos, self.buttons))
    }

    /// The state of the gripper.
    pub(super) fn proprioception(&self, physics: &Physics) -> Proprioception {
        self.arm.proprioception(physics, self.contact)
    }

    /// Returns the comparison of the present state with the goal.
    fn goal_check<'a>(&'a self, physics: &'a Physics) -> GoalCheck<'a> {
        let qpos = physics.data().qpos();
        GoalCheck {
            objects: &self.objects,
            qpos,
            sites: physics.data().site_xpos(),
            now: self.fixture_state(qpos),
            cubes: &self.goal.cubes,
            goal: self.goal.fixtures,
        }
    }

    /// Stores the present pose and locks as the pose and locks before the next step.
    pub(super) fn store_previous(&mut self, physics: &Physics) {
        let (qpos, qvel) = (physics.data().qpos(), physics.data().qvel());
        self.previous[..qpos.len()].copy_from_slice(qpos);
        self.previous[qpos.len()..].copy_from_slice(qvel);
        self.previous_buttons = self.buttons;
    }

    /// Applies an action for one control step.
    pub(super) fn advance(&mut self, physics: &mut Physics, action: &[f32]) {
        self.arm.apply_action(physics, action, &WORKSPACE);
        self.store_previous(physics);
        physics.step(SUBSTEPS);
        physics.contact_forces();
        self.contact = self.arm.contact(physics);
        if let Some(fixtures) = self.objects.fixtures {
            if matches!(self.mode, Mode::RandomTask | Mode::FixedTask(_)) {
                self.return_lost_cubes(physics);
            }
            self.buttons = fixtures.toggled(self.buttons, &self.previous, physics.data().qpos());
            fixtures.apply_locks(physics, self.buttons, &self.lock_colors);
            // The reference calls `mj_forward` in the scene only: with cubes alone, derived quantities lag by one step.
            physics.forward();
        }
    }

    /// Moves cubes that left the workspace to the middle of the table. This happens when a drawer with a cube inside is
    /// locked while it moves. The reference moves such cubes to a random position.
    fn return_lost_cubes(&self, physics: &mut Physics) {
        let [low, high] = WORKSPACE;
        for cube in &self.objects.cubes {
            let at = cube.position(physics.data().qpos());
            if (0..3).any(|i| at[i] <= low[i] - LOST_DISTANCE || at[i] >= high[i] + LOST_DISTANCE) {
                let [x, y] = self.config.factors.cube;
                cube.set_pose(physics, [x, y, CUBE_HEIGHT], IDENTITY);
                physics.data_mut().qvel_mut()[cube.qvel..cube.qvel + 6].fill(0.0);
            }
        }
    }

    /// Updates the parts of the model that display locks and goal.
    pub(super) fn update_model(&self, physics: &mut Physics) {
        if let Some(fixtures) = self.objects.fixtures {
            fixtures.apply_locks(physics, self.buttons, &self.lock_colors);
            fixtures.place_markers(physics, self.goal.fixtures);
        }
        for (i, cube) in self.objects.cubes.iter().enumerate() {
            let included = matches!(self.goal.subject, Subject::All) || self.goal.subject == Subject::Cube(i);
            cube.set_marker_visible(physics, included);
        }
    }

    /// Moves the mocap bodies of the cubes' markers, which are part of the state, to the goal. Called at the start of
    /// an episode.
    pub(super) fn move_marker_bodies(&self, physics: &mut Physics) {
        for (cube, &(position, rotation)) in self.objects.cubes.iter().zip(&self.goal.cubes) {
            let at = Pose { position, rotation };
            cube.place_marker(physics, at, at);
            physics.data_mut().mocap_pos_mut()[cube.mocap] = position;
            physics.data_mut().mocap_quat_mut()[cube.mocap] = rotation;
        }
    }

    /// Computes the observation at the goal; the physics is in the goal pose afterwards. In data collection, the
    /// observation is not computed, as in the reference.
    pub(super) fn observe_goal(&mut self, physics: &mut Physics) {
        self.goal.observed = true;
        if self.mode.starts_from_factors() {
            return;
        }
        let (buttons, contact) = (self.buttons, self.contact);
        self.move_to_goal(physics);
        (self.buttons, self.contact) = (self.goal.fixtures.buttons, self.goal.contact);
        let mut observation = std::mem::take(&mut self.goal.observation);
        self.observation(physics, &mut observation);
        self.goal.observation = observation;
        (self.buttons, self.contact) = (buttons, contact);
        self.update_model(physics);
    }
}

/// Decodes locks from a task state or goal values.
fn locks(values: &[f64]) -> [u8; 2] {
    [u8::from(values[0] > 0.5), u8::from(values[1] > 0.5)]
}

impl Task for Table {
    fn overwrites_edits(&self) -> bool {
        true
    }

    fn apply_factors(&mut self, physics: &mut Physics, factors: &FactorValues) -> Result<()> {
        if self.config.fixtures {
            self.lock_colors = factors::lock_colors(factors);
        }
        factors::apply(physics, self.config, &self.objects, factors)?;
        self.update_model(physics);
        Ok(())
    }

    fn start(&mut self, physics: &mut Physics, factors: &FactorValues, key: Key) -> Result<()> {
        self.begin(physics, factors, key);
        Ok(())
    }

    fn step(&mut self, physics: &mut Physics, action: &[f32]) -> StepOutcome {
        self.advance(physics, action);
        let success = self.is_success(physics);
        let reward = match self.mode {
            Mode::FixedTask(_) => {
                let check = self.goal_check(physics);
                -check.terms(self.goal.subject).map(|term| f64::from(!term.reached)).sum::<f64>()
            }
            _ => f64::from(success),
        };
        if self.mode == Mode::Play {
            if success && self.is_clear(physics) {
                self.follow_goal(physics);
            }
            return StepOutcome { reward, terminated: false };
        }
        StepOutcome { reward, terminated: success && self.terminate }
    }

    fn observe(&self, physics: &Physics, row: &mut RowMut<'_>) {
        self.write(physics, row);
    }

    fn task_state_len(&self, model: &MjModel) -> usize {
        TASK_STATE_HEAD + model.qpos0().len() + model.dof_damping().len()
    }

    fn save_task_state(&self, into: &mut [f64]) {
        let [[a, b], [c, d]] = [self.buttons, self.previous_buttons].map(|buttons| buttons.map(f64::from));
        let (head, previous) = into.split_at_mut(TASK_STATE_HEAD);
        head.copy_from_slice(&[self.contact, a, b, c, d]);
        previous.copy_from_slice(&self.previous);
    }

    fn load_task_state(&mut self, _: &mut Physics, task_state: &[f64]) {
        let (head, previous) = task_state.split_at(TASK_STATE_HEAD);
        self.contact = head[0];
        (self.buttons, self.previous_buttons) = (locks(&head[1..]), locks(&head[3..]));
        self.previous.copy_from_slice(previous);
    }

    fn goal_len(&self) -> usize {
        GOAL_HEAD + 7 * self.config.cubes + self.goal.pose.len()
    }

    fn save_goal(&self, into: &mut [f64]) {
        let (FixtureState { buttons, drawer, window }, contact) = (self.goal.fixtures, self.goal.contact);
        let [a, b] = buttons.map(f64::from);
        let subject = self.goal.subject.code() as f64;
        let (head, rest) = into.split_at_mut(GOAL_HEAD);
        head.copy_from_slice(&[subject, a, b, drawer, window, contact]);
        let (cubes, pose) = rest.split_at_mut(7 * self.config.cubes);
        for (values, (position, rotation)) in cubes.chunks_exact_mut(7).zip(&self.goal.cubes) {
            values[..3].copy_from_slice(position);
            values[3..].copy_from_slice(rotation);
        }
        pose.copy_from_slice(&self.goal.pose);
    }

    fn load_goal(&mut self, goal: &[f64]) {
        let (head, rest) = goal.split_at(GOAL_HEAD);
        let (cubes, pose) = rest.split_at(7 * self.config.cubes);
        self.goal.subject = Subject::from_code(head[0] as i64);
        self.goal.fixtures = FixtureState { buttons: locks(&head[1..]), drawer: head[3], window: head[4] };
        for (values, (position, rotation)) in cubes.chunks_exact(7).zip(&mut self.goal.cubes) {
            position.copy_from_slice(&values[..3]);
            rotation.copy_from_slice(&values[3..]);
        }
        // Planning restores thousands of states of one episode, all with the same goal, so the goal's observation is
        // cached.
        if self.goal.pose != pose || self.goal.contact != head[5] {
            self.goal.pose.copy_from_slice(pose);
            self.goal.contact = head[5];
            self.goal.observed = false;
        }
    }

    fn set_goal_state(&mut self, physics: &mut Physics, state: &[f64], task_state: &[f64]) -> Result<()> {
        let pose = &state[1..=self.goal.pose.len()];
        self.goal.pose.copy_from_slice(pose);
        (self.goal.subject, self.goal.contact) = (Subject::All, task_state[0]);
        for (goal, cube) in self.goal.cubes.iter_mut().zip(&self.objects.cubes) {
            *goal = (cube.position(pose), cube.rotation(pose));
        }
        if let Some(fixtures) = self.objects.fixtures {
            self.goal.fixtures = fixtures.state(pose, locks(&task_state[1..]));
        }
        self.observe_goal(physics);
        Ok(())
    }

    fn sample_goal(&mut self, physics: &mut Physics, key: Key) -> Result<()> {
        self.draw_goal(physics, key)
    }

    fn update_markers(&mut self, physics: &mut Physics, state: &[f64]) {
        if !self.goal.observed {
            self.observe_goal(physics);
        }
        self.update_model(physics);
        // Positions and quaternions of the mocap bodies are at the end of a state.
        let n = self.config.cubes;
        let (positions, quats) = state[state.len() - 7 * n..].split_at(3 * n);
        for (cube, &(position, rotation)) in self.objects.cubes.iter().zip(&self.goal.cubes) {
            let body = Pose {
                position: std::array::from_fn(|i| positions[3 * cube.mocap + i]),
                rotation: std::array::from_fn(|i| quats[4 * cube.mocap + i]),
            };
            cube.place_marker(physics, body, Pose { position, rotation });
        }
    }

    fn move_to_goal(&mut self, physics: &mut Physics) {
        let (qpos, qvel) = self.goal.pose.split_at(physics.data().qpos().len());
        physics.data_mut().qpos_mut().copy_from_slice(qpos);
        physics.data_mut().qvel_mut().copy_from_slice(qvel);
        self.move_marker_bodies(physics);
        if let Some(fixtures) = self.objects.fixtures {
            fixtures.apply_locks(physics, self.goal.fixtures.buttons, &self.lock_colors);
        }
        physics.forward();
    }

    fn is_success(&self, physics: &Physics) -> bool {
        self.goal_check(physics).reached(self.goal.subject)
    }

    fn goal_distance(&self, physics: &Physics) -> f64 {
        self.goal_check(physics).distance(self.goal.subject, self.proprioception(physics).position)
    }

    fn camera(&self) -> Camera {
        Camera::Fixed(self.camera)
    }
}
