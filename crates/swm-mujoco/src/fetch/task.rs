//! [`Fetch`]: the robot, its gripper led by a mocap body, an object, and a goal.

use super::factors::Handles;
use super::kind::{Kind, NEAR, SUBSTEPS, Setup};
use crate::env::{FIRST, Step, Task};
use crate::physics::{Physics, place};
use crate::render::Camera;
use mujoco_rs::wrappers::MjModel;
use mujoco_rs::wrappers::mj_model::MjtObjBase;
use rand::Rng as _;
use std::sync::Arc;
use swm_core::{Error, FactorValues, Key, Result, Rng, RowMut, VariationRequest};

/// Metres the gripper is led by an action of 1.
const REACH_OF_ACTION: f32 = 0.05;

/// Samples from which a goal is chosen.
const GOAL_TRIES: usize = 256;

/// Steps in which the gripper is led to a goal, to know a pose there.
const LEADING: usize = 25;

type Place = [f64; 3];

/// How rewards are given.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Reward {
    /// 0 at the goal, -1 elsewhere.
    Sparse,
    /// The distance, negative.
    Dense,
}

/// How an agent sees the world.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Sight {
    /// One array: what the robot knows, and the goal.
    Flat,
    /// Three: what it knows, what it achieved, what it should.
    Parted,
}

/// The world's task.
pub struct Fetch {
    kind: &'static Kind,
    reward: Reward,
    sight: Sight,
    setup: Arc<Setup>,
    handles: Handles,
    /// The sites of gripper, object and target.
    gripper: usize,
    object: Option<usize>,
    target: usize,
    /// The body the mocap body leads.
    hand: usize,
    /// Places of the fingers in `qpos` and `qvel`, the right one first.
    fingers: [(usize, usize); 2],
    /// The place of the object in `qpos`.
    block: usize,
    goal: Place,
    /// `qpos` and `qvel` where it is reached.
    goal_pose: Vec<f64>,
    /// Whether the reset asked for the object's place, its angle, and the goal: otherwise they are drawn.
    asked: [bool; 3],
}

/// The factors that tell where an episode begins, if they are asked for.
const PLACES: [&str; 3] = ["block.start_position", "block.angle", "goal.start_position"];

/// Numbers of what the robot knows: of gripper and fingers, and of an object.
pub fn known_len(object: bool) -> usize {
    if object { 25 } else { 10 }
}

impl Fetch {
    /// The task on its model.
    ///
    /// # Errors
    /// When the model is not Fetch's.
    pub fn new(kind: &'static Kind, setup: Arc<Setup>, reward: Reward, sight: Sight) -> Result<Self> {
        let model = &*setup.model;
        let joint = |name: &str| {
            let joint = place(model, MjtObjBase::mjOBJ_JOINT, name)?;
            let whole = |address: i32| usize::try_from(address).unwrap_or(0);
            Ok((whole(model.jnt_qposadr()[joint]), whole(model.jnt_dofadr()[joint])))
        };
        let site = |name: &str| place(model, MjtObjBase::mjOBJ_SITE, name);
        Ok(Self {
            handles: Handles::new(model, kind.has_object())?,
            gripper: site("robot0:grip")?,
            object: if kind.has_object() { Some(site("object0")?) } else { None },
            target: site("target0")?,
            hand: place(model, MjtObjBase::mjOBJ_BODY, "robot0:gripper_link")?,
            fingers: [joint("robot0:r_gripper_finger_joint")?, joint("robot0:l_gripper_finger_joint")?],
            block: if kind.has_object() { joint("object0:joint")?.0 } else { 0 },
            goal: setup.gripper,
            goal_pose: [&setup.qpos[..], &setup.qvel].concat(),
            asked: [false; 3],
            kind,
            reward,
            sight,
            setup,
        })
    }

    /// Where the object is, or the gripper where there is none.
    fn achieved(&self, world: &Physics) -> Place {
        world.data().site_xpos()[self.object.unwrap_or(self.gripper)]
    }

    fn distance(&self, world: &Physics) -> f64 {
        distance(self.achieved(world), self.goal)
    }

    /// Moves the goal to a place, and finds a pose where it is reached: the state is another one afterwards.
    fn set_goal(&mut self, world: &mut Physics, goal: Place) {
        self.goal = goal;
        if self.object.is_some() {
            world.data_mut().qpos_mut()[self.block..self.block + 3].copy_from_slice(&goal);
            world.forward();
        } else {
            for _ in 0..LEADING {
                let at = self.achieved(world);
                #[allow(clippy::cast_possible_truncation)]
                let towards = |i: usize| ((goal[i] - at[i]) as f32 / REACH_OF_ACTION).clamp(-1.0, 1.0);
                self.advance(world, [towards(0), towards(1), towards(2), 0.0]);
            }
        }
        self.note_pose(world);
    }

    /// Takes the present pose for one where the goal is reached.
    fn note_pose(&mut self, world: &Physics) {
        self.goal_pose.clear();
        self.goal_pose.extend(world.data().qpos());
        self.goal_pose.extend(world.data().qvel());
    }

    /// Draws a goal around a place.
    fn draw_goal(&self, around: Place, rng: &mut Rng) -> Place {
        let range = self.kind.target_range;
        let mut goal = around.map(|x| x + rng.random_range(-range..=range));
        if self.kind.has_object() {
            goal[0] += self.kind.target_offset;
            goal[2] = self.setup.height;
            if self.kind.target_in_the_air && rng.random_bool(0.5) {
                goal[2] += rng.random_range(0.0..=0.45);
            }
        }
        goal
    }

    /// The place around which objects and goals are drawn.
    fn middle(&self, factors: &FactorValues) -> Place {
        let given = factors.get("agent.start_position");
        let factor = factors.factors().iter().find(|factor| factor.key == "agent.start_position");
        match factor {
            Some(factor) if factor.init_value != given => [given[0], given[1], self.setup.gripper[2]],
            _ => self.setup.gripper,
        }
    }

    /// Leads the gripper and sets the fingers' motors, and lets time pass.
    fn advance(&mut self, world: &mut Physics, action: [f32; 4]) {
        let data = world.data();
        let (at, turn) = (data.xpos()[self.hand], data.xquat()[self.hand]);
        let data = world.data_mut();
        data.mocap_pos_mut()[0] = std::array::from_fn(|i| at[i] + f64::from(action[i] * REACH_OF_ACTION));
        data.mocap_quat_mut()[0] = [turn[0] + 1.0, turn[1], turn[2] + 1.0, turn[3]];
        if !self.kind.shut {
            // The motor of the left finger is the first one.
            let wanted = [1, 0].map(|i: usize| data.qpos()[self.fingers[i].0] + f64::from(action[3]));
            data.ctrl_mut().copy_from_slice(&wanted);
        }
        world.step(SUBSTEPS);
        if self.kind.shut {
            for (at, _) in self.fingers {
                world.data_mut().qpos_mut()[at] = 0.0;
            }
            world.forward();
        }
    }

    /// Writes what the robot knows.
    fn known(&self, world: &Physics, into: &mut [f64]) {
        let data = world.data();
        // Velocities are metres and radians per action.
        #[allow(clippy::cast_precision_loss)]
        let dt = SUBSTEPS as f64 * world.model().opt().timestep;
        let scaled = |velocity: Place| velocity.map(|v| v * dt);
        let gripper = data.site_xpos()[self.gripper];
        let gripper_velocity = scaled(world.site_velocity(self.gripper).0);
        let mut place = 0;
        let mut put = |numbers: &[f64]| {
            into[place..place + numbers.len()].copy_from_slice(numbers);
            place += numbers.len();
        };
        put(&gripper);
        let fingers = self.fingers.map(|(at, _)| data.qpos()[at]);
        if let Some(object) = self.object {
            let at = data.site_xpos()[object];
            let (linear, angular) = world.site_velocity(object);
            let linear = scaled(linear);
            put(&at);
            put(&std::array::from_fn::<_, 3, _>(|i| at[i] - gripper[i]));
            put(&fingers);
            put(&euler(&data.site_xmat()[object]));
            put(&std::array::from_fn::<_, 3, _>(|i| linear[i] - gripper_velocity[i]));
            put(&scaled(angular));
        } else {
            put(&fingers);
        }
        put(&gripper_velocity);
        put(&self.fingers.map(|(_, at)| data.qvel()[at] * dt));
    }
}

fn distance(a: Place, b: Place) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt()
}

/// The angles of a rotation matrix (row after row), around x, y and z, turned in this order of fixed axes.
fn euler(m: &[f64; 9]) -> Place {
    let cosine = m[8].hypot(m[5]);
    let y = m[2].atan2(cosine);
    if cosine > 4.0 * f64::EPSILON {
        [-m[5].atan2(m[8]), y, -m[1].atan2(m[0])]
    } else {
        // Pointing straight up or down: x and z turn around the same axis.
        [0.0, y, m[3].atan2(m[4])]
    }
}

impl Task for Fetch {
    fn arrange(&mut self, world: &mut Physics, factors: &FactorValues) -> Result<()> {
        world.attend(Arc::clone(&self.setup.era));
        self.handles.apply(world, factors);
        Ok(())
    }

    fn heed(&mut self, asked: &VariationRequest) {
        let named = |key: &str, name: &str| name == "all" || name == key || key.split('.').next() == Some(name);
        self.asked = PLACES.map(|key| {
            asked.variation_values.contains_key(key) || asked.variation.iter().flatten().any(|name| named(key, name))
        });
    }

    fn start(&mut self, world: &mut Physics, factors: &FactorValues, key: Key) -> Result<()> {
        let mut rng = key.rng();
        let middle = self.middle(factors);
        let [place, angle, goal] = self.asked;
        let data = world.data_mut();
        data.set_time(self.setup.time);
        data.qpos_mut().copy_from_slice(&self.setup.qpos);
        data.qvel_mut().copy_from_slice(&self.setup.qvel);
        if self.object.is_some() {
            let range = self.kind.object_range;
            // Not where the gripper is, which may stand on the table.
            let drawn = loop {
                let away = [0, 1].map(|_| rng.random_range(-range..=range));
                if away[0].hypot(away[1]) >= 0.1 {
                    break [middle[0] + away[0], middle[1] + away[1]];
                }
            };
            let at = if place { factors.get("block.start_position") } else { &drawn };
            data.qpos_mut()[self.block..self.block + 2].copy_from_slice(at);
            if angle {
                let half = factors.scalar("block.angle") / 2.0;
                let turn = [half.cos(), 0.0, 0.0, half.sin()];
                data.qpos_mut()[self.block + 3..self.block + 7].copy_from_slice(&turn);
            }
        }
        world.forward();
        let drawn = self.draw_goal(middle, &mut rng);
        let given = factors.get("goal.start_position");
        let mut start = vec![0.0; world.state_len()];
        world.state(&mut start);
        self.set_goal(world, if goal { [given[0], given[1], given[2]] } else { drawn });
        self.mark_goal(world, &start);
        world.set_state(&start)
    }

    fn step(&mut self, world: &mut Physics, action: &[f32]) -> Step {
        self.advance(world, std::array::from_fn(|i| action[i].clamp(-1.0, 1.0)));
        let left = self.distance(world);
        let reward = match self.reward {
            Reward::Dense => -left,
            Reward::Sparse if left > NEAR => -1.0,
            Reward::Sparse => 0.0,
        };
        Step { reward, terminated: false }
    }

    fn observe(&self, world: &Physics, row: &mut RowMut<'_>) {
        let mut known = [0.0; 25];
        let known = &mut known[..known_len(self.object.is_some())];
        self.known(world, known);
        row.set(FIRST, known);
        row.set(FIRST + 1, &self.goal_pose);
        row.set(FIRST + 2, &self.achieved(world));
        row.set(FIRST + 3, &self.goal);
        match self.sight {
            #[allow(clippy::cast_possible_truncation)]
            Sight::Flat => {
                let seen = row.at::<f32>(FIRST + 4);
                seen.iter_mut().zip(known.iter().chain(&self.goal)).for_each(|(to, from)| *to = *from as f32);
            }
            Sight::Parted => row.set(FIRST + 4, known),
        }
    }

    fn memory_len(&self, _model: &MjModel) -> usize {
        0
    }

    fn remember(&self, _into: &mut [f64]) {}

    fn recall(&mut self, _world: &mut Physics, _memory: &[f64]) {}

    fn goal_len(&self) -> usize {
        self.goal.len() + self.goal_pose.len()
    }

    fn remember_goal(&self, into: &mut [f64]) {
        let (place, pose) = into.split_at_mut(self.goal.len());
        place.copy_from_slice(&self.goal);
        pose.copy_from_slice(&self.goal_pose);
    }

    fn recall_goal(&mut self, goal: &[f64]) {
        let (place, pose) = goal.split_at(self.goal.len());
        self.goal.copy_from_slice(place);
        self.goal_pose.copy_from_slice(pose);
    }

    fn mark_goal(&mut self, world: &mut Physics, _state: &[f64]) {
        let body = usize::try_from(world.model().site_bodyid()[self.target]).unwrap_or(0);
        // The body does not move and is not turned.
        let origin = world.model().body_pos()[body];
        let goal = self.goal;
        world.model_mut().site_pos_mut()[self.target] = std::array::from_fn(|i| goal[i] - origin[i]);
    }

    fn aim(&mut self, world: &mut Physics, state: &[f64], _memory: &[f64]) -> Result<()> {
        world.set_state(state)?;
        self.goal = self.achieved(world);
        self.note_pose(world);
        Ok(())
    }

    fn aim_at(&mut self, world: &mut Physics, goal: &[f64]) -> Option<Result<()>> {
        let &[x, y, z] = goal else { return None };
        self.set_goal(world, [x, y, z]);
        Some(Ok(()))
    }

    fn sample_goal(&mut self, world: &mut Physics, key: Key) -> Result<()> {
        let mut rng = key.rng();
        let at = self.achieved(world);
        let goals = (0..GOAL_TRIES).map(|_| self.draw_goal(self.setup.gripper, &mut rng));
        // Twice as far as would do, so that there is something to do.
        let goal = goals.into_iter().find(|&goal| distance(goal, at) > 2.0 * NEAR);
        let goal = goal.ok_or_else(|| Error::Unsatisfiable {
            factor: "goal".to_owned(),
            constraint: "not reached already".to_owned(),
            tries: GOAL_TRIES,
        })?;
        self.set_goal(world, goal);
        Ok(())
    }

    fn show_goal(&mut self, world: &mut Physics) {
        let shown = world.set_pose(&self.goal_pose);
        debug_assert!(shown.is_ok(), "a pose of this model");
    }

    fn is_success(&self, world: &Physics) -> bool {
        self.distance(world) < NEAR
    }

    fn goal_distance(&self, world: &Physics) -> f64 {
        self.distance(world)
    }

    fn camera(&self) -> Camera {
        Camera::Orbit { lookat: [1.3, 0.75, 0.55], distance: 2.5, azimuth: 132.0, elevation: -14.0 }
    }
}
