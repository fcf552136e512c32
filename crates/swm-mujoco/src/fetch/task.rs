//! [`Fetch`]: start, step, observation, reward and goal of the four tasks. Formulas are those of `gymnasium-robotics`
//! 1.4.2.

use super::config::{GOAL_TOLERANCE, SUBSTEPS, Setup, TaskConfig};
use super::factors::FactorTargets;
use crate::physics::{Physics, index_of};
use crate::render::Camera;
use crate::task::{FIRST_TASK_COLUMN, StepOutcome, Task};
use mujoco_rs::wrappers::MjModel;
use mujoco_rs::wrappers::mj_model::MjtObjBase;
use rand::Rng as _;
use std::sync::Arc;
use swm_core::{Error, FactorValues, Key, Result, Rng, RowMut, VariationRequest};

/// Displacement of the gripper for an action of 1, in metres.
const ACTION_SCALE: f32 = 0.05;

/// The number of goals that [`Task::sample_goal`] draws before it fails.
const GOAL_TRIES: usize = 256;

/// The number of actions that move the gripper to a goal to obtain the goal pose.
const GOAL_POSE_STEPS: usize = 25;

type Vec3 = [f64; 3];

/// The reward function.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Reward {
    /// 0 at the goal, -1 elsewhere.
    Sparse,
    /// The negative distance to the goal, in metres.
    Dense,
}

/// The form of the observation.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum ObservationKind {
    /// One array: proprioception and goal.
    Flat,
    /// Three arrays: proprioception, achieved goal and desired goal.
    Dict,
}

/// A Fetch task, with the indices of its elements in the model.
pub struct Fetch {
    config: &'static TaskConfig,
    reward: Reward,
    observation: ObservationKind,
    setup: Arc<Setup>,
    factor_targets: FactorTargets,
    /// Index of the gripper's site.
    gripper: usize,
    /// Index of the object's site.
    object: Option<usize>,
    /// Index of the site that marks the goal.
    target: usize,
    /// Index of the body that the mocap body moves.
    hand: usize,
    /// Indices of the finger joints in `qpos` and `qvel`, the right finger first.
    fingers: [(usize, usize); 2],
    /// Index of the object's free joint in `qpos`.
    object_qpos: usize,
    /// The goal, in metres.
    goal: Vec3,
    /// `qpos` and `qvel` of a pose at the goal.
    goal_pose: Vec<f64>,
    /// Whether the reset requested each of [`START_FACTORS`]; factors that are not requested are drawn.
    requested: [bool; 3],
}

/// The factors that determine the start of an episode if the reset requests them.
const START_FACTORS: [&str; 3] = ["block.start_position", "block.angle", "goal.start_position"];

/// The length of the `proprio` column, with or without an object.
pub fn proprio_len(object: bool) -> usize {
    if object { 25 } else { 10 }
}

impl Fetch {
    /// Finds the elements of the task in its model.
    ///
    /// # Errors
    /// When the model is not a model of Fetch.
    pub fn new(
        config: &'static TaskConfig,
        setup: Arc<Setup>,
        reward: Reward,
        observation: ObservationKind,
    ) -> Result<Self> {
        let model = &*setup.model;
        let joint = |name: &str| {
            let joint = index_of(model, MjtObjBase::mjOBJ_JOINT, name)?;
            let to_index = |address: i32| usize::try_from(address).unwrap_or(0);
            Ok((to_index(model.jnt_qposadr()[joint]), to_index(model.jnt_dofadr()[joint])))
        };
        let site = |name: &str| index_of(model, MjtObjBase::mjOBJ_SITE, name);
        Ok(Self {
            factor_targets: FactorTargets::new(model, config.has_object())?,
            gripper: site("robot0:grip")?,
            object: if config.has_object() { Some(site("object0")?) } else { None },
            target: site("target0")?,
            hand: index_of(model, MjtObjBase::mjOBJ_BODY, "robot0:gripper_link")?,
            fingers: [joint("robot0:r_gripper_finger_joint")?, joint("robot0:l_gripper_finger_joint")?],
            object_qpos: if config.has_object() { joint("object0:joint")?.0 } else { 0 },
            goal: setup.gripper,
            goal_pose: [&setup.qpos[..], &setup.qvel].concat(),
            requested: [false; 3],
            config,
            reward,
            observation,
            setup,
        })
    }

    /// The position (m) of the object, or of the gripper in a task without an object.
    fn achieved(&self, physics: &Physics) -> Vec3 {
        physics.data().site_xpos()[self.object.unwrap_or(self.gripper)]
    }

    fn distance(&self, physics: &Physics) -> f64 {
        distance(self.achieved(physics), self.goal)
    }

    /// Sets the goal and finds a pose at which the goal is reached. Changes the state of the physics.
    fn set_goal(&mut self, physics: &mut Physics, goal: Vec3) {
        self.goal = goal;
        if self.object.is_some() {
            physics.data_mut().qpos_mut()[self.object_qpos..self.object_qpos + 3].copy_from_slice(&goal);
            physics.forward();
        } else {
            for _ in 0..GOAL_POSE_STEPS {
                let at = self.achieved(physics);
                let towards = |i: usize| ((goal[i] - at[i]) as f32 / ACTION_SCALE).clamp(-1.0, 1.0);
                self.advance(physics, [towards(0), towards(1), towards(2), 0.0]);
            }
        }
        self.store_goal_pose(physics);
    }

    /// Stores the present pose as the goal pose.
    fn store_goal_pose(&mut self, physics: &Physics) {
        self.goal_pose.clear();
        self.goal_pose.extend(physics.data().qpos());
        self.goal_pose.extend(physics.data().qvel());
    }

    /// Draws a goal around a point, in metres.
    fn draw_goal(&self, around: Vec3, rng: &mut Rng) -> Vec3 {
        let range = self.config.target_range;
        let mut goal = around.map(|x| x + rng.random_range(-range..=range));
        if self.config.has_object() {
            goal[0] += self.config.target_offset;
            goal[2] = self.setup.object_height;
            if self.config.target_in_the_air && rng.random_bool(0.5) {
                goal[2] += rng.random_range(0.0..=0.45);
            }
        }
        goal
    }

    /// The point (m) around which objects and goals are drawn: the factor `agent.start_position` if it differs from its
    /// default, otherwise the gripper's position.
    fn draw_center(&self, factors: &FactorValues) -> Vec3 {
        let given = factors.get("agent.start_position");
        let factor = factors.factors().iter().find(|factor| factor.key == "agent.start_position");
        match factor {
            Some(factor) if factor.init_value != given => [given[0], given[1], self.setup.gripper[2]],
            _ => self.setup.gripper,
        }
    }

    /// Moves the mocap body and sets the fingers' motors, then advances the simulation.
    fn advance(&mut self, physics: &mut Physics, action: [f32; 4]) {
        let data = physics.data();
        let (at, turn) = (data.xpos()[self.hand], data.xquat()[self.hand]);
        let data = physics.data_mut();
        data.mocap_pos_mut()[0] = std::array::from_fn(|i| at[i] + f64::from(action[i] * ACTION_SCALE));
        data.mocap_quat_mut()[0] = [turn[0] + 1.0, turn[1], turn[2] + 1.0, turn[3]];
        if !self.config.fingers_closed {
            // The first motor is that of the left finger.
            let targets = [1, 0].map(|i: usize| data.qpos()[self.fingers[i].0] + f64::from(action[3]));
            data.ctrl_mut().copy_from_slice(&targets);
        }
        physics.step(SUBSTEPS);
        if self.config.fingers_closed {
            for (at, _) in self.fingers {
                physics.data_mut().qpos_mut()[at] = 0.0;
            }
            physics.forward();
        }
    }

    /// Writes the `proprio` column.
    fn proprio(&self, physics: &Physics, into: &mut [f64]) {
        let data = physics.data();
        // Velocities are in metres and radians per action.
        let dt = SUBSTEPS as f64 * physics.model().opt().timestep;
        let scaled = |velocity: Vec3| velocity.map(|v| v * dt);
        let gripper = data.site_xpos()[self.gripper];
        let gripper_velocity = scaled(physics.site_velocity(self.gripper).0);
        let mut next = 0;
        let mut append = |values: &[f64]| {
            into[next..next + values.len()].copy_from_slice(values);
            next += values.len();
        };
        append(&gripper);
        let fingers = self.fingers.map(|(at, _)| data.qpos()[at]);
        if let Some(object) = self.object {
            let at = data.site_xpos()[object];
            let (linear, angular) = physics.site_velocity(object);
            let linear = scaled(linear);
            append(&at);
            append(&std::array::from_fn::<_, 3, _>(|i| at[i] - gripper[i]));
            append(&fingers);
            append(&euler(&data.site_xmat()[object]));
            append(&std::array::from_fn::<_, 3, _>(|i| linear[i] - gripper_velocity[i]));
            append(&scaled(angular));
        } else {
            append(&fingers);
        }
        append(&gripper_velocity);
        append(&self.fingers.map(|(_, at)| data.qvel()[at] * dt));
    }
}

fn distance(a: Vec3, b: Vec3) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt()
}

/// Euler angles (rad) of a row-major rotation matrix, as `mat2euler` of `gymnasium-robotics`: about the fixed x, y and
/// z axes.
fn euler(m: &[f64; 9]) -> Vec3 {
    let cosine = m[8].hypot(m[5]);
    let y = m[2].atan2(cosine);
    if cosine > 4.0 * f64::EPSILON {
        [-m[5].atan2(m[8]), y, -m[1].atan2(m[0])]
    } else {
        // Gimbal lock: x and z rotate about the same axis.
        [0.0, y, m[3].atan2(m[4])]
    }
}

impl Task for Fetch {
    fn apply_factors(&mut self, physics: &mut Physics, factors: &FactorValues) -> Result<()> {
        physics.set_hooks(Arc::clone(&self.setup.hooks));
        self.factor_targets.apply(physics, factors);
        Ok(())
    }

    fn receive_request(&mut self, request: &VariationRequest) {
        let names = |key: &str, name: &str| name == "all" || name == key || key.split('.').next() == Some(name);
        self.requested = START_FACTORS.map(|key| {
            request.variation_values.contains_key(key)
                || request.variation.iter().flatten().any(|name| names(key, name))
        });
    }

    fn start(&mut self, physics: &mut Physics, factors: &FactorValues, key: Key) -> Result<()> {
        let mut rng = key.rng();
        let center = self.draw_center(factors);
        let [position, angle, goal] = self.requested;
        let data = physics.data_mut();
        data.set_time(self.setup.time);
        data.qpos_mut().copy_from_slice(&self.setup.qpos);
        data.qvel_mut().copy_from_slice(&self.setup.qvel);
        if self.object.is_some() {
            let range = self.config.object_range;
            // The object starts at least 10 cm from the gripper, which may be at the object's height.
            let drawn = loop {
                let away = [0, 1].map(|_| rng.random_range(-range..=range));
                if away[0].hypot(away[1]) >= 0.1 {
                    break [center[0] + away[0], center[1] + away[1]];
                }
            };
            let at = if position { factors.get("block.start_position") } else { &drawn };
            data.qpos_mut()[self.object_qpos..self.object_qpos + 2].copy_from_slice(at);
            if angle {
                let half = factors.scalar("block.angle") / 2.0;
                let rotation = [half.cos(), 0.0, 0.0, half.sin()];
                data.qpos_mut()[self.object_qpos + 3..self.object_qpos + 7].copy_from_slice(&rotation);
            }
        }
        physics.forward();
        let drawn = self.draw_goal(center, &mut rng);
        let given = factors.get("goal.start_position");
        let mut start = vec![0.0; physics.state_len()];
        physics.state(&mut start);
        self.set_goal(physics, if goal { [given[0], given[1], given[2]] } else { drawn });
        self.update_markers(physics, &start);
        physics.set_state(&start)
    }

    fn step(&mut self, physics: &mut Physics, action: &[f32]) -> StepOutcome {
        self.advance(physics, std::array::from_fn(|i| action[i].clamp(-1.0, 1.0)));
        let distance = self.distance(physics);
        let reward = match self.reward {
            Reward::Dense => -distance,
            Reward::Sparse if distance > GOAL_TOLERANCE => -1.0,
            Reward::Sparse => 0.0,
        };
        StepOutcome { reward, terminated: false }
    }

    fn observe(&self, physics: &Physics, row: &mut RowMut<'_>) {
        let mut proprio = [0.0; 25];
        let proprio = &mut proprio[..proprio_len(self.object.is_some())];
        self.proprio(physics, proprio);
        row.set(FIRST_TASK_COLUMN, proprio);
        row.set(FIRST_TASK_COLUMN + 1, &self.goal_pose);
        row.set(FIRST_TASK_COLUMN + 2, &self.achieved(physics));
        row.set(FIRST_TASK_COLUMN + 3, &self.goal);
        match self.observation {
            ObservationKind::Flat => {
                let observation = row.at::<f32>(FIRST_TASK_COLUMN + 4);
                let values = proprio.iter().chain(&self.goal);
                observation.iter_mut().zip(values).for_each(|(to, from)| *to = *from as f32);
            }
            ObservationKind::Dict => row.set(FIRST_TASK_COLUMN + 4, proprio),
        }
    }

    fn task_state_len(&self, _model: &MjModel) -> usize {
        0
    }

    fn save_task_state(&self, _into: &mut [f64]) {}

    fn load_task_state(&mut self, _physics: &mut Physics, _task_state: &[f64]) {}

    fn goal_len(&self) -> usize {
        self.goal.len() + self.goal_pose.len()
    }

    fn save_goal(&self, into: &mut [f64]) {
        let (point, pose) = into.split_at_mut(self.goal.len());
        point.copy_from_slice(&self.goal);
        pose.copy_from_slice(&self.goal_pose);
    }

    fn load_goal(&mut self, goal: &[f64]) {
        let (point, pose) = goal.split_at(self.goal.len());
        self.goal.copy_from_slice(point);
        self.goal_pose.copy_from_slice(pose);
    }

    fn update_markers(&mut self, physics: &mut Physics, _state: &[f64]) {
        let body = usize::try_from(physics.model().site_bodyid()[self.target]).unwrap_or(0);
        // The body of the marker is fixed and has no rotation.
        let origin = physics.model().body_pos()[body];
        let goal = self.goal;
        physics.model_mut().site_pos_mut()[self.target] = std::array::from_fn(|i| goal[i] - origin[i]);
    }

    fn set_goal_state(&mut self, physics: &mut Physics, state: &[f64], _task_state: &[f64]) -> Result<()> {
        physics.set_state(state)?;
        self.goal = self.achieved(physics);
        self.store_goal_pose(physics);
        Ok(())
    }

    fn set_goal_values(&mut self, physics: &mut Physics, goal: &[f64]) -> Option<Result<()>> {
        let &[x, y, z] = goal else { return None };
        self.set_goal(physics, [x, y, z]);
        Some(Ok(()))
    }

    fn sample_goal(&mut self, physics: &mut Physics, key: Key) -> Result<()> {
        let mut rng = key.rng();
        let at = self.achieved(physics);
        let goals = (0..GOAL_TRIES).map(|_| self.draw_goal(self.setup.gripper, &mut rng));
        // At a distance of twice the tolerance, a small disturbance does not reach the goal.
        let goal = goals.into_iter().find(|&goal| distance(goal, at) > 2.0 * GOAL_TOLERANCE);
        let goal = goal.ok_or_else(|| Error::Unsatisfiable {
            factor: "goal".to_owned(),
            constraint: "not already reached".to_owned(),
            tries: GOAL_TRIES,
        })?;
        self.set_goal(physics, goal);
        Ok(())
    }

    fn move_to_goal(&mut self, physics: &mut Physics) {
        let set = physics.set_pose(&self.goal_pose);
        debug_assert!(set.is_ok(), "the goal pose is invalid for this model");
    }

    fn is_success(&self, physics: &Physics) -> bool {
        self.distance(physics) < GOAL_TOLERANCE
    }

    fn goal_distance(&self, physics: &Physics) -> f64 {
        self.distance(physics)
    }

    fn camera(&self) -> Camera {
        Camera::Orbit { lookat: [1.3, 0.75, 0.55], distance: 2.5, azimuth: 132.0, elevation: -14.0 }
    }
}
