//! A table with an arm, cubes, and in the scene buttons, a drawer and a window: `swm/OGBCube-v0` and `swm/OGBScene-v0`.

mod arena;
mod expert;
mod factors;
mod goal;
mod observe;
mod parts;
mod setup;
mod start;
mod tasks;

pub use expert::EXPERTS;

use super::arm::pose::{Pose, Quat, Vec3};
use super::arm::{ACTION, Arm, find};
use crate::env::MujocoEnv;
use crate::render::Camera;
use crate::task::{StepOutcome, Task};
use crate::{Physics, physics};
use arena::Look;
use goal::{Sight, Subject};
use mujoco_rs::mujoco_c::_mjtObjBase::mjOBJ_CAMERA;
use mujoco_rs::wrappers::MjModel;
use parts::Parts;
use setup::{FRONT, Fixed, Setup, WORKSPACE};
use std::sync::Arc;
use swm_core::registry::EnvOption;
use swm_core::{DType, Env, EnvChoice, EnvSpec, FactorValues, Key, Result, RowMut, Space};

/// Physics steps of a control step, which takes 50 ms.
const SUBSTEPS: usize = 25;

/// What can be chosen of both tables, beside `env_type`.
macro_rules! options {
    ($($own:expr,)*) => {
        &[
            $($own,)*
            EnvOption {
                key: "mode",
                summary: "episodes carry out a task, or begin as the factors say and have one thing to do",
                values: &["task", "data_collection"],
            },
            EnvOption {
                key: "reward_task_id",
                summary: "always this task, 0 for the usual one, and a reward that counts what is not done",
                values: &["none", "0", "1", "2", "3", "4", "5"],
            },
            EnvOption {
                key: "ob_type",
                summary: "for whom pictures are: an agent that sees has an arm that does not hide the cubes",
                values: &["states", "pixels"],
            },
            EnvOption { key: "permute_blocks", summary: "whether cubes take turns in the tasks", values: &["true", "false"] },
            EnvOption {
                key: "terminate_at_goal",
                summary: "whether an episode ends at its goal",
                values: &["true", "false"],
            },
            EnvOption { key: "multiview", summary: "whether the camera at the side varies too", values: &["false", "true"] },
        ]
    };
}

/// The options of `swm/OGBCube-v0`.
pub const CUBE_OPTIONS: &[EnvOption] = options![EnvOption {
    key: "env_type",
    summary: "how many cubes: 1, 2, 3, 4 or 8",
    values: &["single", "double", "triple", "quadruple", "octuple"],
},];

/// The options of `swm/OGBScene-v0`.
pub const SCENE_OPTIONS: &[EnvOption] = options![];

/// The task that a reward is for unless another one is asked for.
const USUAL_TASK: usize = 2;

/// Makes a table of cubes.
///
/// # Errors
/// When MuJoCo or OGBench's files are not installed.
pub fn make_cube(choice: &EnvChoice) -> Result<Box<dyn Env>> {
    let name = choice.choices.get("env_type");
    make(setup::CUBES.iter().find(|setup| setup.name == name).unwrap_or(&setup::CUBES[0]), choice)
}

/// Makes a scene.
///
/// # Errors
/// When MuJoCo or OGBench's files are not installed.
pub fn make_scene(choice: &EnvChoice) -> Result<Box<dyn Env>> {
    make(&setup::SCENE, choice)
}

/// The model of a table, compiled once.
fn model(setup: &Setup, look: Look) -> Result<Arc<MjModel>> {
    physics::shared_model(&format!("{} {} {look:?}", setup.id, setup.name), || arena::compile(setup, look))
}

fn make(setup: &'static Setup, choice: &EnvChoice) -> Result<Box<dyn Env>> {
    let chosen = |key| choice.choices.get(key);
    let look = if chosen("ob_type") == "pixels" { Look::Transparent } else { Look::Solid };
    let model = model(setup, look)?;
    let mode = match (chosen("mode"), chosen("reward_task_id").parse()) {
        ("data_collection", _) => Mode::Collect,
        (_, Err(_)) => Mode::Task,
        (_, Ok(0)) => Mode::One(USUAL_TASK - 1),
        (_, Ok(task)) => Mode::One(task - 1),
    };
    let table =
        Table::new(setup, &model, mode, chosen("permute_blocks") == "true", chosen("terminate_at_goal") == "true")?;
    let observation = observe::observation_len(setup.cubes, setup.fixtures);
    let unbounded = Space::uniform_box([observation], DType::Float64, f64::NEG_INFINITY, f64::INFINITY);
    let spec = EnvSpec {
        id: choice.id(),
        action_space: Space::uniform_box([ACTION], DType::Float32, -1.0, 1.0),
        columns: table.columns(&model),
        observation_space: vec![("observation", unbounded)],
        variation_space: factors::space(setup, if chosen("multiview") == "true" { 2 } else { 1 }),
        max_episode_steps: setup.limit,
        cameras: vec![],
    };
    Ok(Box::new(MujocoEnv::new(spec, model, table)?))
}

/// How episodes begin and what they are for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Mode {
    /// One of the tasks; the reward is 1 at the goal.
    Task,
    /// One task, by its place; the reward counts what is not done, below 0.
    One(usize),
    /// Starts from the factors, and one thing to do.
    Collect,
}

/// What happens on a table.
struct Table {
    setup: &'static Setup,
    mode: Mode,
    /// Whether cubes take turns in the tasks.
    permute: bool,
    /// Whether an episode ends at its goal.
    terminate: bool,
    arm: Arm,
    parts: Parts,
    camera: usize,
    lock_colors: [[f32; 3]; 2],
    /// How the locks stand.
    buttons: [u8; 2],
    /// How they stood before the last step.
    previous_buttons: [u8; 2],
    /// How firmly the gripper holds something.
    contact: f64,
    /// `qpos` and `qvel` before the last step.
    previous: Vec<f64>,
    goal: Goal,
}

/// The goal of an episode.
struct Goal {
    /// What it is about.
    subject: Subject,
    /// Where each cube should be and how it should be turned; only where counts.
    cubes: Vec<(Vec3, Quat)>,
    /// How the fixtures should stand.
    fixed: Fixed,
    /// `qpos` and `qvel` where it is reached.
    pose: Vec<f64>,
    /// How firmly the gripper holds something there.
    contact: f64,
    /// What one observes there, once it was looked at.
    target: Vec<f64>,
    seen: bool,
}

impl Table {
    fn new(setup: &'static Setup, model: &MjModel, mode: Mode, permute: bool, terminate: bool) -> Result<Self> {
        let pose = vec![0.0; model.qpos0().len() + model.dof_damping().len()];
        Ok(Self {
            setup,
            mode,
            permute,
            terminate,
            arm: Arm::new(model)?,
            parts: Parts::new(model, setup)?,
            camera: find(model, mjOBJ_CAMERA, FRONT)?,
            lock_colors: [[0.0; 3]; 2],
            buttons: [0; 2],
            previous_buttons: [0; 2],
            contact: 0.0,
            previous: pose.clone(),
            goal: Goal {
                subject: Subject::All,
                cubes: vec![(start::AWAY, super::arm::pose::IDENTITY); setup.cubes],
                fixed: Fixed::default(),
                pose,
                contact: 0.0,
                target: vec![0.0; observe::observation_len(setup.cubes, setup.fixtures)],
                seen: false,
            },
        })
    }

    /// How the fixtures stand.
    fn fixed(&self, qpos: &[f64]) -> Fixed {
        self.parts.fixtures.map_or_else(Fixed::default, |fixtures| fixtures.read(qpos, self.buttons))
    }

    /// What is to be done.
    fn sight<'a>(&'a self, physics: &'a Physics) -> Sight<'a> {
        let qpos = physics.data().qpos();
        Sight {
            parts: &self.parts,
            qpos,
            sites: physics.data().site_xpos(),
            now: self.fixed(qpos),
            cubes: &self.goal.cubes,
            goal: self.goal.fixed,
        }
    }

    /// Remembers the present pose as the one before the next step.
    fn note_pose(&mut self, physics: &Physics) {
        let (qpos, qvel) = (physics.data().qpos(), physics.data().qvel());
        self.previous[..qpos.len()].copy_from_slice(qpos);
        self.previous[qpos.len()..].copy_from_slice(qvel);
        self.previous_buttons = self.buttons;
    }

    /// Lets a control step pass.
    fn advance(&mut self, physics: &mut Physics, action: &[f32]) {
        self.arm.act(physics, action, &WORKSPACE);
        self.note_pose(physics);
        physics.step(SUBSTEPS);
        physics.contact_forces();
        self.contact = self.arm.contact(physics);
        if let Some(fixtures) = self.parts.fixtures {
            if matches!(self.mode, Mode::Task | Mode::One(_)) {
                self.catch_cubes(physics);
            }
            self.buttons = fixtures.toggled(self.buttons, &self.previous, physics.data().qpos());
            fixtures.lock(physics, self.buttons, &self.lock_colors);
            // The reference looks at a scene through `mj_forward`: what is derived does not lag, as it does among cubes.
            physics.forward();
        }
    }

    /// Brings back cubes that were squeezed out of the scene, which happens when a drawer with a cube in it is locked while
    /// it moves. The reference puts them anywhere by chance; here they come to the middle.
    fn catch_cubes(&self, physics: &mut Physics) {
        const BEYOND: f64 = 0.2;
        let [low, high] = WORKSPACE;
        for cube in &self.parts.cubes {
            let place = cube.place(physics.data().qpos());
            if (0..3).any(|i| place[i] <= low[i] - BEYOND || place[i] >= high[i] + BEYOND) {
                let [x, y] = self.setup.factors.cube;
                cube.put(physics, [x, y, start::CUBE_HEIGHT], super::arm::pose::IDENTITY);
                physics.data_mut().qvel_mut()[cube.qvel..cube.qvel + 6].fill(0.0);
            }
        }
    }

    /// Makes the model show goal and locks.
    fn dress(&self, physics: &mut Physics) {
        if let Some(fixtures) = self.parts.fixtures {
            fixtures.lock(physics, self.buttons, &self.lock_colors);
            fixtures.mark(physics, self.goal.fixed);
        }
        for (i, cube) in self.parts.cubes.iter().enumerate() {
            cube.show_mark(physics, matches!(self.goal.subject, Subject::All) || self.goal.subject == Subject::Cube(i));
        }
    }

    /// Puts the cubes' markers where the goal wants the cubes, as a part of the state: where an episode begins.
    fn move_marks(&self, physics: &mut Physics) {
        for (cube, &(place, turn)) in self.parts.cubes.iter().zip(&self.goal.cubes) {
            let at = Pose { place, turn };
            cube.mark(physics, at, at);
            physics.data_mut().mocap_pos_mut()[cube.mocap] = place;
            physics.data_mut().mocap_quat_mut()[cube.mocap] = turn;
        }
    }

    /// Observes the goal, whose pose is that of the physics afterwards. The reference observes none where it collects data.
    fn look_at_goal(&mut self, physics: &mut Physics) {
        self.goal.seen = true;
        if self.mode == Mode::Collect {
            return;
        }
        let (buttons, contact) = (self.buttons, self.contact);
        self.move_to_goal(physics);
        (self.buttons, self.contact) = (self.goal.fixed.buttons, self.goal.contact);
        let mut target = std::mem::take(&mut self.goal.target);
        self.observation(physics, &mut target);
        self.goal.target = target;
        (self.buttons, self.contact) = (buttons, contact);
        self.dress(physics);
    }
}

/// Numbers of a [`Table`]'s memory before the pose, and of its goal before the cubes.
const MEMORY: usize = 5;
const GOAL: usize = 6;

/// Locks as numbers, and back.
fn numbers(buttons: [u8; 2]) -> [f64; 2] {
    buttons.map(f64::from)
}

fn locks(numbers: &[f64]) -> [u8; 2] {
    [u8::from(numbers[0] > 0.5), u8::from(numbers[1] > 0.5)]
}

impl Task for Table {
    fn overwrites_edits(&self) -> bool {
        true
    }

    fn apply_factors(&mut self, physics: &mut Physics, factors: &FactorValues) -> Result<()> {
        if self.setup.fixtures {
            self.lock_colors = factors::lock_colors(factors);
        }
        factors::apply(physics, self.setup, &self.parts, factors)?;
        self.dress(physics);
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
            Mode::One(_) => -self.sight(physics).gaps(self.goal.subject).map(|gap| f64::from(!gap.closed)).sum::<f64>(),
            _ => f64::from(success),
        };
        StepOutcome { reward, terminated: success && self.terminate }
    }

    fn observe(&self, physics: &Physics, row: &mut RowMut<'_>) {
        self.write(physics, row);
    }

    fn task_state_len(&self, model: &MjModel) -> usize {
        MEMORY + model.qpos0().len() + model.dof_damping().len()
    }

    fn save_task_state(&self, into: &mut [f64]) {
        let ([a, b], [c, d]) = (numbers(self.buttons), numbers(self.previous_buttons));
        let (head, previous) = into.split_at_mut(MEMORY);
        head.copy_from_slice(&[self.contact, a, b, c, d]);
        previous.copy_from_slice(&self.previous);
    }

    fn load_task_state(&mut self, _: &mut Physics, memory: &[f64]) {
        let (head, previous) = memory.split_at(MEMORY);
        self.contact = head[0];
        (self.buttons, self.previous_buttons) = (locks(&head[1..]), locks(&head[3..]));
        self.previous.copy_from_slice(previous);
    }

    fn goal_len(&self) -> usize {
        GOAL + 7 * self.setup.cubes + self.goal.pose.len()
    }

    fn save_goal(&self, into: &mut [f64]) {
        let (Fixed { buttons, drawer, window }, contact) = (self.goal.fixed, self.goal.contact);
        let [a, b] = numbers(buttons);
        let subject = self.goal.subject.number() as f64;
        let (head, rest) = into.split_at_mut(GOAL);
        head.copy_from_slice(&[subject, a, b, drawer, window, contact]);
        let (cubes, pose) = rest.split_at_mut(7 * self.setup.cubes);
        for (numbers, (place, turn)) in cubes.chunks_exact_mut(7).zip(&self.goal.cubes) {
            numbers[..3].copy_from_slice(place);
            numbers[3..].copy_from_slice(turn);
        }
        pose.copy_from_slice(&self.goal.pose);
    }

    fn load_goal(&mut self, goal: &[f64]) {
        let (head, rest) = goal.split_at(GOAL);
        let (cubes, pose) = rest.split_at(7 * self.setup.cubes);
        self.goal.subject = Subject::from_number(head[0] as i64);
        self.goal.fixed = Fixed { buttons: locks(&head[1..]), drawer: head[3], window: head[4] };
        for (numbers, (place, turn)) in cubes.chunks_exact(7).zip(&mut self.goal.cubes) {
            place.copy_from_slice(&numbers[..3]);
            turn.copy_from_slice(&numbers[3..]);
        }
        // Whoever plans restores one episode's states thousands of times, all with the same goal.
        if self.goal.pose != pose || self.goal.contact != head[5] {
            self.goal.pose.copy_from_slice(pose);
            self.goal.contact = head[5];
            self.goal.seen = false;
        }
    }

    fn set_goal_state(&mut self, physics: &mut Physics, state: &[f64], memory: &[f64]) -> Result<()> {
        let pose = &state[1..=self.goal.pose.len()];
        self.goal.pose.copy_from_slice(pose);
        (self.goal.subject, self.goal.contact) = (Subject::All, memory[0]);
        for (goal, cube) in self.goal.cubes.iter_mut().zip(&self.parts.cubes) {
            *goal = (cube.place(pose), cube.turn(pose));
        }
        if let Some(fixtures) = self.parts.fixtures {
            self.goal.fixed = fixtures.read(pose, locks(&memory[1..]));
        }
        self.look_at_goal(physics);
        Ok(())
    }

    fn sample_goal(&mut self, physics: &mut Physics, key: Key) -> Result<()> {
        self.choose_goal(physics, key)
    }

    fn update_markers(&mut self, physics: &mut Physics, state: &[f64]) {
        if !self.goal.seen {
            self.look_at_goal(physics);
        }
        self.dress(physics);
        // Places and turns of what is moved by hand stand at the end of a state.
        let n = self.setup.cubes;
        let (places, turns) = state[state.len() - 7 * n..].split_at(3 * n);
        for (cube, &(place, turn)) in self.parts.cubes.iter().zip(&self.goal.cubes) {
            let place_now = std::array::from_fn(|i| places[3 * cube.mocap + i]);
            let turn_now = std::array::from_fn(|i| turns[4 * cube.mocap + i]);
            cube.mark(physics, Pose { place: place_now, turn: turn_now }, Pose { place, turn });
        }
    }

    fn move_to_goal(&mut self, physics: &mut Physics) {
        let (qpos, qvel) = self.goal.pose.split_at(physics.data().qpos().len());
        physics.data_mut().qpos_mut().copy_from_slice(qpos);
        physics.data_mut().qvel_mut().copy_from_slice(qvel);
        self.move_marks(physics);
        if let Some(fixtures) = self.parts.fixtures {
            fixtures.lock(physics, self.goal.fixed.buttons, &self.lock_colors);
        }
        physics.forward();
    }

    fn is_success(&self, physics: &Physics) -> bool {
        self.sight(physics).reached(self.goal.subject)
    }

    fn goal_distance(&self, physics: &Physics) -> f64 {
        self.sight(physics).distance(self.goal.subject, self.arm.feel(physics, self.contact).place)
    }

    fn camera(&self) -> Camera {
        Camera::Fixed(self.camera)
    }
}

/// The models of all tables as they are compiled, by name.
pub fn models() -> impl Iterator<Item = (String, Result<Arc<MjModel>>)> {
    setup::CUBES.iter().chain([&setup::SCENE]).map(|setup| (setup.name.to_owned(), model(setup, Look::Solid)))
}
