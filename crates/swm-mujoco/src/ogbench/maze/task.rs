//! [`Maze`]: start, step, observation, reward and goal of a maze. Constants are OGBench's (`locomaze/maze.py`).

use super::agent::Agent;
use super::map::{Map, ShortestPaths, TELEPORT_RADIUS, UNIT, Xy, center, distance};
use crate::Physics;
use crate::ogbench::arm::find;
use crate::ogbench::floor;
use crate::render::Camera;
use crate::task::{FIRST_TASK_COLUMN, StepOutcome, Task};
use mujoco_rs::mujoco_c::_mjtObjBase::{mjOBJ_GEOM, mjOBJ_LIGHT, mjOBJ_MATERIAL, mjOBJ_TEXTURE};
use mujoco_rs::wrappers::MjModel;
use rand::Rng as _;
use rand_distr::{Distribution as _, StandardNormal};
use swm_core::{Error, FactorValues, Key, Result, Rng, RowMut};

/// Time steps of 20 ms per action.
const SUBSTEPS: usize = 5;
/// Displacement of the point for an action of 1, in metres.
pub const POINT_STEP: f32 = 0.2;
/// Largest distance of start and goal from the centres of their cells along each axis, in metres.
const NOISE: f64 = UNIT / 4.0;
/// Half range of the uniform noise on initial positions (m, rad), and standard deviation of initial velocities (m/s,
/// rad/s).
const START_NOISE: f64 = 0.1;
/// The number of random actions at the goal before the goal pose is stored.
const SETTLE_STEPS: usize = 5;
/// Distance from the centre of an entrance within which the agent is teleported, in metres.
const TELEPORT_DISTANCE: f64 = 1.5 * TELEPORT_RADIUS;
/// The number of goals that [`Task::sample_goal`] draws before it fails.
const GOAL_TRIES: usize = 1000;
/// The number of elements of the task state before the pose: the teleport seed.
pub const TASK_STATE_HEAD: usize = 1;

/// The options of a maze.
pub struct Settings {
    /// The agent.
    pub agent: Agent,
    /// The map.
    pub map: &'static Map,
    /// The task of all episodes, if it is fixed; the reward is then 0 at the goal and -1 elsewhere.
    pub fixed_task: Option<usize>,
    /// Whether an episode terminates at its goal.
    pub terminate: bool,
    /// Whether goals differ from the centres of cells.
    pub goal_noise: bool,
    /// Whether frames are the observation: the goal is then not displayed.
    pub pixels: bool,
}

/// A maze task on a compiled model.
pub struct Maze {
    settings: Settings,
    /// The geom that marks the goal, if it is displayed.
    marker: Option<usize>,
    goal: Xy,
    paths: ShortestPaths,
    /// `qpos` and `qvel` of the agent at the goal.
    goal_pose: Vec<f64>,
    /// `qpos` and `qvel` before the last step.
    previous: Vec<f64>,
    /// The seed from which the next teleport exit is drawn.
    teleport_seed: u32,
}

/// The agent's position in the plane, in metres.
fn xy(physics: &Physics) -> Xy {
    [physics.data().qpos()[0], physics.data().qpos()[1]]
}

/// Draws a teleport seed of 24 bits, which single precision represents exactly, because datasets may store states in
/// single precision.
fn draw_seed(rng: &mut Rng) -> u32 {
    rng.random_range(0..1 << 24)
}

impl Maze {
    /// Finds the elements of a maze in its model.
    ///
    /// # Errors
    /// When the model lacks the marker of the goal.
    pub fn new(model: &MjModel, settings: Settings) -> Result<Self> {
        let pose = vec![0.0; model.qpos0().len() + model.dof_damping().len()];
        Ok(Self {
            marker: if settings.pixels { None } else { Some(find(model, mjOBJ_GEOM, "target")?) },
            goal: [0.0; 2],
            paths: ShortestPaths::new(settings.map, [0.0; 2]),
            goal_pose: pose.clone(),
            previous: pose,
            teleport_seed: 0,
            settings,
        })
    }

    /// Stores the present pose in `previous`, as the pose before the next step.
    fn store_previous(&mut self, physics: &Physics) {
        let (qpos, qvel) = (physics.data().qpos(), physics.data().qvel());
        self.previous[..qpos.len()].copy_from_slice(qpos);
        self.previous[qpos.len()..].copy_from_slice(qvel);
    }

    /// Applies an action for one control step.
    fn advance(&mut self, physics: &mut Physics, action: &[f32]) {
        self.store_previous(physics);
        match self.settings.agent {
            Agent::Point => {
                let data = physics.data_mut();
                data.qpos_mut().iter_mut().zip(action).for_each(|(at, by)| *at += f64::from(POINT_STEP * by));
                data.qvel_mut().fill(0.0);
            }
            Agent::Ant => {
                let controls = physics.data_mut().ctrl_mut();
                controls.iter_mut().zip(action).for_each(|(control, &by)| *control = f64::from(by));
            }
        }
        physics.step(SUBSTEPS);
    }

    /// Moves an agent that is near an entrance to a random exit.
    fn teleport(&mut self, physics: &mut Physics) {
        let (entrances, exits) = self.settings.map.teleports;
        if entrances.iter().any(|&entrance| distance(xy(physics), center(entrance)) <= TELEPORT_DISTANCE) {
            let mut rng = Key::new(u64::from(self.teleport_seed)).with("teleport").rng();
            let exit = center(exits[rng.random_range(0..exits.len())]);
            self.teleport_seed = draw_seed(&mut rng);
            physics.data_mut().qpos_mut()[..2].copy_from_slice(&exit);
            physics.forward();
        }
    }

    /// Adds noise to the initial positions and draws the initial velocities.
    fn add_start_noise(&self, physics: &mut Physics, rng: &mut Rng) {
        let data = physics.data_mut();
        for at in data.qpos_mut() {
            *at += rng.random_range(-START_NOISE..=START_NOISE);
        }
        for speed in data.qvel_mut() {
            let normal: f64 = StandardNormal.sample(rng);
            *speed = START_NOISE * normal;
        }
    }

    /// Sets the goal, and its position in the goal pose.
    fn set_goal(&mut self, goal: Xy) {
        self.goal = goal;
        self.goal_pose[..2].copy_from_slice(&goal);
        self.paths.set_goal(goal);
    }

    /// Moves the marker to the goal.
    fn place_marker(&self, physics: &mut Physics) {
        if let Some(marker) = self.marker {
            physics.model_mut().geom_pos_mut()[marker][..2].copy_from_slice(&self.goal);
        }
    }
}

impl Task for Maze {
    fn overwrites_edits(&self) -> bool {
        true
    }

    fn apply_factors(&mut self, physics: &mut Physics, factors: &FactorValues) -> Result<()> {
        for (material, factor) in [("self", "agent.color"), ("wall", "wall.color")] {
            let material = find(physics.model(), mjOBJ_MATERIAL, material)?;
            let color = factors.get(factor);
            physics.model_mut().mat_rgba_mut()[material] = [color[0] as f32, color[1] as f32, color[2] as f32, 1.0];
        }
        let light = find(physics.model(), mjOBJ_LIGHT, "global")?;
        physics.model_mut().light_diffuse_mut()[light] = [factors.scalar("light.intensity") as f32; 3];
        if self.settings.pixels && factors.integer("floor.pixel_encoding") == 1 {
            let texture = find(physics.model(), mjOBJ_TEXTURE, "grid")?;
            floor::encode_position(physics, texture);
        } else {
            floor::set_colors(physics, factors.get("floor.color"))?;
        }
        self.place_marker(physics);
        Ok(())
    }

    fn start(&mut self, physics: &mut Physics, _: &FactorValues, key: Key) -> Result<()> {
        let rng = &mut key.rng();
        let tasks = self.settings.map.tasks;
        let (start, goal) = tasks[self.settings.fixed_task.unwrap_or_else(|| rng.random_range(0..tasks.len()))];
        let mut near = |cell, by: f64| center(cell).map(|at| at + rng.random_range(-by..=by));
        let start = near(start, NOISE);
        let goal = near(goal, if self.settings.goal_noise { NOISE } else { 0.0 });
        self.teleport_seed = draw_seed(rng);
        // The goal pose comes first, because the start overwrites the state of the goal.
        self.add_start_noise(physics, rng);
        physics.forward();
        for _ in 0..SETTLE_STEPS {
            let action: [f32; 8] = std::array::from_fn(|_| rng.random_range(-1.0..=1.0));
            self.advance(physics, &action);
        }
        self.store_previous(physics);
        self.goal_pose.copy_from_slice(&self.previous);
        self.set_goal(goal);
        self.place_marker(physics);
        physics.reset();
        self.add_start_noise(physics, rng);
        physics.data_mut().qpos_mut()[..2].copy_from_slice(&start);
        self.store_previous(physics);
        physics.forward();
        Ok(())
    }

    fn step(&mut self, physics: &mut Physics, action: &[f32]) -> StepOutcome {
        self.advance(physics, action);
        let success = self.is_success(physics);
        self.teleport(physics);
        let reward = f64::from(success) - if self.settings.fixed_task.is_some() { 1.0 } else { 0.0 };
        StepOutcome { reward, terminated: success && self.settings.terminate }
    }

    fn observe(&self, physics: &Physics, row: &mut RowMut<'_>) {
        let (qpos, qvel) = (physics.data().qpos(), physics.data().qvel());
        let observation = row.at::<f64>(FIRST_TASK_COLUMN);
        observation[..qpos.len()].copy_from_slice(qpos);
        if self.settings.agent == Agent::Ant {
            observation[qpos.len()..].copy_from_slice(qvel);
        }
        let (previous_qpos, previous_qvel) = self.previous.split_at(qpos.len());
        let (state, task_state) = row.at::<f64>(FIRST_TASK_COLUMN + 1).split_at_mut(physics.state_len());
        physics.state(state);
        state[1..=self.goal_pose.len()].copy_from_slice(&self.goal_pose);
        task_state[0] = f64::from(self.teleport_seed);
        task_state[TASK_STATE_HEAD..].copy_from_slice(&self.goal_pose);
        let columns =
            [&xy(physics)[..], previous_qpos, previous_qvel, qpos, qvel, &self.goal, &self.paths.next(xy(physics))];
        for (i, values) in columns.into_iter().enumerate() {
            row.set(FIRST_TASK_COLUMN + 2 + i, values);
        }
    }

    fn task_state_len(&self, model: &MjModel) -> usize {
        TASK_STATE_HEAD + model.qpos0().len() + model.dof_damping().len()
    }

    fn save_task_state(&self, into: &mut [f64]) {
        into[0] = f64::from(self.teleport_seed);
        into[TASK_STATE_HEAD..].copy_from_slice(&self.previous);
    }

    fn load_task_state(&mut self, _: &mut Physics, task_state: &[f64]) {
        self.teleport_seed = task_state[0] as u32;
        self.previous.copy_from_slice(&task_state[TASK_STATE_HEAD..]);
    }

    fn goal_len(&self) -> usize {
        2 + self.goal_pose.len()
    }

    fn save_goal(&self, into: &mut [f64]) {
        into[..2].copy_from_slice(&self.goal);
        into[2..].copy_from_slice(&self.goal_pose);
    }

    fn load_goal(&mut self, goal: &[f64]) {
        self.goal_pose.copy_from_slice(&goal[2..]);
        if self.goal != goal[..2] {
            self.set_goal([goal[0], goal[1]]);
        }
    }

    fn set_goal_state(&mut self, _: &mut Physics, state: &[f64], _: &[f64]) -> Result<()> {
        let pose = &state[1..=self.goal_pose.len()];
        self.goal_pose.copy_from_slice(pose);
        self.set_goal([state[1], state[2]]);
        Ok(())
    }

    fn sample_goal(&mut self, physics: &mut Physics, key: Key) -> Result<()> {
        let rng = &mut key.rng();
        let (start, map) = (xy(physics), self.settings.map);
        let free: Vec<_> = map.cells().filter(|&cell| map.is_free(cell)).collect();
        let before = self.goal;
        for _ in 0..GOAL_TRIES {
            let goal = center(free[rng.random_range(0..free.len())]).map(|at| at + rng.random_range(-NOISE..=NOISE));
            self.set_goal(goal);
            if distance(start, goal) > self.settings.agent.goal_tolerance() && self.paths.is_reachable(start) {
                return Ok(());
            }
        }
        self.set_goal(before);
        Err(Error::Unsatisfiable {
            factor: "goal".to_owned(),
            constraint: "reachable, and not already reached".to_owned(),
            tries: GOAL_TRIES,
        })
    }

    fn move_to_goal(&mut self, physics: &mut Physics) {
        let (qpos, qvel) = self.goal_pose.split_at(physics.data().qpos().len());
        physics.data_mut().qpos_mut().copy_from_slice(qpos);
        physics.data_mut().qvel_mut().copy_from_slice(qvel);
        physics.forward();
    }

    fn update_markers(&mut self, physics: &mut Physics, _: &[f64]) {
        self.place_marker(physics);
    }

    fn is_success(&self, physics: &Physics) -> bool {
        distance(xy(physics), self.goal) <= self.settings.agent.goal_tolerance()
    }

    fn goal_distance(&self, physics: &Physics) -> f64 {
        self.paths.length(xy(physics))
    }

    fn camera(&self) -> Camera {
        let ([x, y], [columns, _]) = (self.settings.map.camera_center(), self.settings.map.extent());
        Camera::Orbit { lookat: [x, y, 0.0], distance: 5.0 * (columns - 2.0), azimuth: 90.0, elevation: -90.0 }
    }
}
