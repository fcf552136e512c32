//! Mazes that a point or an ant walks through: `swm/OGBMaze-v0`.

mod expert;
mod map;
mod model;

pub use expert::EXPERTS;

use super::arm::find;
use super::floor;
use crate::env::MujocoEnv;
use crate::render::Camera;
use crate::task::{FIRST_TASK_COLUMN, StepOutcome, Task};
use crate::{Physics, physics};
use map::{MAPS, Map, UNIT, Ways, Xy, middle};
use mujoco_rs::mujoco_c::_mjtObjBase::{mjOBJ_GEOM, mjOBJ_LIGHT, mjOBJ_MATERIAL, mjOBJ_TEXTURE};
use mujoco_rs::wrappers::MjModel;
use rand::Rng as _;
use rand_distr::{Distribution as _, StandardNormal};
use std::sync::Arc;
use swm_core::registry::EnvOption;
use swm_core::{
    ColumnSpec, DType, Env, EnvChoice, EnvSpec, Error, Factor, FactorValues, Key, Result, Rng, RowMut, Space,
    VariationSpace,
};

/// Physics steps of a control step, which takes 100 ms.
const SUBSTEPS: usize = 5;
/// How far a point moves at once, along each axis, in metres.
const STRIDE: f32 = 0.2;
/// How far from where a task says one begins and the goal is, at most, along each axis, in metres.
const JITTER: f64 = UNIT / 4.0;
/// How an agent begins: the spread of its positions (uniform) and velocities (normal).
const UNREST: f64 = 0.1;
/// Random steps before the pose at the goal is taken.
const SETTLING: usize = 5;
/// How near one must come to a teleport to be taken, in metres.
const TAKEN: f64 = 1.5 * model::TELEPORT;
/// Places tried for a goal before giving up.
const TRIES: usize = 1000;
/// Steps of an episode.
const LIMIT: usize = 1000;

/// Who walks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Agent {
    /// A ball that is moved.
    Point,
    /// An ant of eight joints.
    Ant,
}

impl Agent {
    /// The file that describes it.
    fn file(self) -> &'static str {
        match self {
            Self::Point => "point.xml",
            Self::Ant => "ant.xml",
        }
    }

    /// How near is near enough, in metres.
    fn tolerance(self) -> f64 {
        match self {
            Self::Point => 1.0,
            Self::Ant => 0.5,
        }
    }
}

/// The options of `swm/OGBMaze-v0`.
pub const OPTIONS: &[EnvOption] = &[
    EnvOption { key: "loco_env_type", summary: "who walks: a point or an ant", values: &["point", "ant"] },
    EnvOption { key: "maze_type", summary: "which maze", values: &["large", "arena", "medium", "giant", "teleport"] },
    EnvOption {
        key: "ob_type",
        summary: "for whom pictures are: an agent that sees sees no goal, and may tell from the floor where it is",
        values: &["states", "pixels"],
    },
    EnvOption {
        key: "reward_task_id",
        summary: "always this task, 0 for the usual one, and a reward of -1 until it is done",
        values: &["none", "0", "1", "2", "3", "4", "5"],
    },
    EnvOption { key: "terminate_at_goal", summary: "whether an episode ends at its goal", values: &["true", "false"] },
    EnvOption {
        key: "add_noise_to_goal",
        summary: "whether goals lie off the middle of cells",
        values: &["true", "false"],
    },
];

/// Makes a maze.
///
/// # Errors
/// When MuJoCo or OGBench's files are not installed, or the maze has no such task.
pub fn make(choice: &EnvChoice) -> Result<Box<dyn Env>> {
    let chosen = |key| choice.choices.get(key);
    let agent = if chosen("loco_env_type") == "ant" { Agent::Ant } else { Agent::Point };
    let map = MAPS.iter().find(|map| map.name == chosen("maze_type")).unwrap_or(&MAPS[0]);
    let seen = chosen("ob_type") == "pixels";
    let only = match chosen("reward_task_id").parse::<usize>() {
        Err(_) => None,
        Ok(task) if task <= map.tasks.len() => Some(task.max(1) - 1),
        Ok(task) => {
            let problem = format!("there is no task {task} in the {} maze", map.name);
            return Err(Error::config("reward_task_id", problem, format!("choose one of 1 to {}", map.tasks.len())));
        }
    };
    let model = shared(agent, map, seen)?;
    let (nq, nv, actions) = (model.qpos0().len(), model.dof_damping().len(), model.actuator_ctrlrange().len());
    let everything = |n| Space::uniform_box([n], DType::Float64, f64::NEG_INFINITY, f64::INFINITY);
    let observation = if agent == Agent::Ant { nq + nv } else { nq };
    let float = |name: &str, n: usize| ColumnSpec::new(name, DType::Float64, [n]);
    let spec = EnvSpec {
        id: choice.id(),
        action_space: Space::uniform_box([actions], DType::Float32, -1.0, 1.0),
        columns: vec![
            float("observation", observation),
            float("goal_state", physics::state_len(&model) + MEMORY + nq + nv),
            float("xy", 2),
            float("prev_qpos", nq),
            float("prev_qvel", nv),
            float("qpos", nq),
            float("qvel", nv),
            float("goal/xy", 2),
            float("goal/next_xy", 2),
        ],
        observation_space: vec![("observation", everything(observation))],
        variation_space: variation_space(seen),
        max_episode_steps: LIMIT,
        cameras: vec![],
    };
    let maze = Maze {
        agent,
        map,
        only,
        terminate: chosen("terminate_at_goal") == "true",
        jitter_goal: chosen("add_noise_to_goal") == "true",
        seen,
        target: if seen { None } else { Some(find(&model, mjOBJ_GEOM, "target")?) },
        goal: [0.0; 2],
        ways: Ways::new(map, [0.0; 2]),
        goal_pose: vec![0.0; nq + nv],
        previous: vec![0.0; nq + nv],
        luck: 0,
    };
    Ok(Box::new(MujocoEnv::new(spec, model, maze)?))
}

/// The model of a maze, compiled once.
fn shared(agent: Agent, map: &Map, seen: bool) -> Result<Arc<MjModel>> {
    physics::shared_model(&format!("swm/OGBMaze-v0 {agent:?} {} {seen}", map.name), || model::compile(agent, map, seen))
}

/// The models of all mazes as they are compiled, by name.
pub fn models() -> impl Iterator<Item = (String, Result<Arc<MjModel>>)> {
    let agents = [(Agent::Point, "point"), (Agent::Ant, "ant")];
    agents.into_iter().flat_map(|(agent, name)| {
        MAPS.iter().map(move |map| (format!("{name}-{}", map.name), shared(agent, map, false)))
    })
}

/// Names, bounds, defaults and order are the reference's.
fn variation_space(seen: bool) -> VariationSpace {
    let color = |shape: &[usize]| Space::uniform_box(shape, DType::Float64, 0.0, 1.0);
    let wall = if seen { 0.6 } else { 1.0 };
    VariationSpace::new(
        vec![
            Factor::new("agent.color", color(&[3]), [0.7, 0.5, 0.3]),
            Factor::new("floor.color", color(&[2, 3]), floor::COLORS.concat()),
            Factor::new("floor.pixel_encoding", Space::Discrete { n: 2, start: 0 }, [0.0]),
            Factor::new("light.intensity", color(&[1]), [1.0]),
            Factor::new("wall.color", color(&[3]), [wall; 3]),
        ],
        &[],
    )
}

/// What happens in a maze.
struct Maze {
    agent: Agent,
    map: &'static Map,
    /// The one task there is, if there is only one: its reward is -1 until the goal, then 0.
    only: Option<usize>,
    /// Whether an episode ends at its goal.
    terminate: bool,
    /// Whether goals lie off the middle of cells.
    jitter_goal: bool,
    /// Whether pictures are for an agent that sees.
    seen: bool,
    /// The marker of the goal, where it is shown.
    target: Option<usize>,
    goal: Xy,
    ways: Ways,
    /// `qpos` and `qvel` at the goal.
    goal_pose: Vec<f64>,
    /// `qpos` and `qvel` before the last step.
    previous: Vec<f64>,
    /// Where teleports lead is drawn from this.
    luck: u32,
}

fn xy(physics: &Physics) -> Xy {
    [physics.data().qpos()[0], physics.data().qpos()[1]]
}

/// A number that single precision, in which datasets may keep states, holds.
fn luck(rng: &mut Rng) -> u32 {
    rng.random_range(0..1 << 24)
}

fn apart(a: Xy, b: Xy) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

impl Maze {
    fn note_pose(&mut self, physics: &Physics) {
        let (qpos, qvel) = (physics.data().qpos(), physics.data().qvel());
        self.previous[..qpos.len()].copy_from_slice(qpos);
        self.previous[qpos.len()..].copy_from_slice(qvel);
    }

    /// Lets a control step pass.
    fn advance(&mut self, physics: &mut Physics, action: &[f32]) {
        self.note_pose(physics);
        match self.agent {
            Agent::Point => {
                let data = physics.data_mut();
                data.qpos_mut().iter_mut().zip(action).for_each(|(at, by)| *at += f64::from(STRIDE * by));
                data.qvel_mut().fill(0.0);
            }
            Agent::Ant => {
                let controls = physics.data_mut().ctrl_mut();
                controls.iter_mut().zip(action).for_each(|(control, &by)| *control = f64::from(by));
            }
        }
        physics.step(SUBSTEPS);
    }

    /// Takes whoever is near an entrance to an exit, which chance chooses.
    fn teleport(&mut self, physics: &mut Physics) {
        let (entrances, exits) = self.map.teleports;
        if entrances.iter().any(|&entrance| apart(xy(physics), middle(entrance)) <= TAKEN) {
            let mut rng = Key::new(u64::from(self.luck)).with("teleport").rng();
            let exit = middle(exits[rng.random_range(0..exits.len())]);
            self.luck = luck(&mut rng);
            physics.data_mut().qpos_mut()[..2].copy_from_slice(&exit);
            physics.forward();
        }
    }

    /// An agent at rest but for a little chance.
    fn unsettle(&self, physics: &mut Physics, rng: &mut Rng) {
        let data = physics.data_mut();
        for at in data.qpos_mut() {
            *at += rng.random_range(-UNREST..=UNREST);
        }
        for speed in data.qvel_mut() {
            let normal: f64 = StandardNormal.sample(rng);
            *speed = UNREST * normal;
        }
    }

    /// Changes the goal, and the pose there.
    fn aim_at(&mut self, goal: Xy) {
        self.goal = goal;
        self.goal_pose[..2].copy_from_slice(&goal);
        self.ways.aim(goal);
    }

    /// Puts the marker where the goal is.
    fn mark(&self, physics: &mut Physics) {
        if let Some(target) = self.target {
            physics.model_mut().geom_pos_mut()[target][..2].copy_from_slice(&self.goal);
        }
    }
}

/// Numbers of a [`Maze`]'s memory before the pose.
const MEMORY: usize = 1;

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
        if self.seen && factors.integer("floor.pixel_encoding") == 1 {
            let texture = find(physics.model(), mjOBJ_TEXTURE, "grid")?;
            floor::encode(physics, texture);
        } else {
            floor::paint(physics, factors.get("floor.color"))?;
        }
        self.mark(physics);
        Ok(())
    }

    fn start(&mut self, physics: &mut Physics, _: &FactorValues, key: Key) -> Result<()> {
        let rng = &mut key.rng();
        let (start, goal) = self.map.tasks[self.only.unwrap_or_else(|| rng.random_range(0..self.map.tasks.len()))];
        let mut near = |cell, by: f64| middle(cell).map(|at| at + rng.random_range(-by..=by));
        let start = near(start, JITTER);
        let goal = near(goal, if self.jitter_goal { JITTER } else { 0.0 });
        self.luck = luck(rng);
        // First the pose at the goal, then the start.
        self.unsettle(physics, rng);
        physics.forward();
        for _ in 0..SETTLING {
            let action: [f32; 8] = std::array::from_fn(|_| rng.random_range(-1.0..=1.0));
            self.advance(physics, &action);
        }
        self.note_pose(physics);
        self.goal_pose.copy_from_slice(&self.previous);
        self.aim_at(goal);
        self.mark(physics);
        physics.reset();
        self.unsettle(physics, rng);
        physics.data_mut().qpos_mut()[..2].copy_from_slice(&start);
        self.note_pose(physics);
        physics.forward();
        Ok(())
    }

    fn step(&mut self, physics: &mut Physics, action: &[f32]) -> StepOutcome {
        self.advance(physics, action);
        let success = self.is_success(physics);
        self.teleport(physics);
        let reward = f64::from(success) - if self.only.is_some() { 1.0 } else { 0.0 };
        StepOutcome { reward, terminated: success && self.terminate }
    }

    fn observe(&self, physics: &Physics, row: &mut RowMut<'_>) {
        let (qpos, qvel) = (physics.data().qpos(), physics.data().qvel());
        let observation = row.at::<f64>(FIRST_TASK_COLUMN);
        observation[..qpos.len()].copy_from_slice(qpos);
        if self.agent == Agent::Ant {
            observation[qpos.len()..].copy_from_slice(qvel);
        }
        let (previous_qpos, previous_qvel) = self.previous.split_at(qpos.len());
        let (state, memory) = row.at::<f64>(FIRST_TASK_COLUMN + 1).split_at_mut(physics.state_len());
        physics.state(state);
        state[1..=self.goal_pose.len()].copy_from_slice(&self.goal_pose);
        memory[0] = f64::from(self.luck);
        memory[MEMORY..].copy_from_slice(&self.goal_pose);
        let columns =
            [&xy(physics)[..], previous_qpos, previous_qvel, qpos, qvel, &self.goal, &self.ways.next(xy(physics))];
        for (i, numbers) in columns.into_iter().enumerate() {
            row.set(FIRST_TASK_COLUMN + 2 + i, numbers);
        }
    }

    fn task_state_len(&self, model: &MjModel) -> usize {
        MEMORY + model.qpos0().len() + model.dof_damping().len()
    }

    fn save_task_state(&self, into: &mut [f64]) {
        into[0] = f64::from(self.luck);
        into[MEMORY..].copy_from_slice(&self.previous);
    }

    fn load_task_state(&mut self, _: &mut Physics, memory: &[f64]) {
        self.luck = memory[0] as u32;
        self.previous.copy_from_slice(&memory[MEMORY..]);
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
            self.aim_at([goal[0], goal[1]]);
        }
    }

    fn set_goal_state(&mut self, _: &mut Physics, state: &[f64], _: &[f64]) -> Result<()> {
        let pose = &state[1..=self.goal_pose.len()];
        self.goal_pose.copy_from_slice(pose);
        self.aim_at([state[1], state[2]]);
        Ok(())
    }

    fn sample_goal(&mut self, physics: &mut Physics, key: Key) -> Result<()> {
        let rng = &mut key.rng();
        let start = xy(physics);
        let free: Vec<_> = self.map.cells().filter(|&cell| self.map.is_free(cell)).collect();
        let before = self.goal;
        for _ in 0..TRIES {
            let goal = middle(free[rng.random_range(0..free.len())]).map(|at| at + rng.random_range(-JITTER..=JITTER));
            self.aim_at(goal);
            if apart(start, goal) > self.agent.tolerance() && self.ways.reach(start) {
                return Ok(());
            }
        }
        self.aim_at(before);
        Err(Error::Unsatisfiable {
            factor: "goal".to_owned(),
            constraint: "in a cell that one can walk to, and not reached already".to_owned(),
            tries: TRIES,
        })
    }

    fn move_to_goal(&mut self, physics: &mut Physics) {
        let (qpos, qvel) = self.goal_pose.split_at(physics.data().qpos().len());
        physics.data_mut().qpos_mut().copy_from_slice(qpos);
        physics.data_mut().qvel_mut().copy_from_slice(qvel);
        physics.forward();
    }

    fn update_markers(&mut self, physics: &mut Physics, _: &[f64]) {
        self.mark(physics);
    }

    fn is_success(&self, physics: &Physics) -> bool {
        apart(xy(physics), self.goal) <= self.agent.tolerance()
    }

    fn goal_distance(&self, physics: &Physics) -> f64 {
        self.ways.length(xy(physics))
    }

    fn camera(&self) -> Camera {
        let ([x, y], [columns, _]) = (model::center(self.map), model::extent(self.map));
        Camera::Orbit { lookat: [x, y, 0.0], distance: 5.0 * (columns - 2.0), azimuth: 90.0, elevation: -90.0 }
    }
}
