//! The scripted expert of tables. It performs one [`Job`] after another and plans every action from the present
//! columns, so that it recovers from errors.
//!
//! As in OGBench's oracles, a job is a sequence of moves: above an object, down, grasp, up, over the target, down,
//! release. A goal may require several jobs. The expert carries lower cubes before the cubes on top of them, removes
//! obstacles first, unlocks before it slides, and sets the locks last.

use super::config::OPEN;
use super::goal::{GOAL_TOLERANCE, Subject};
use crate::ogbench::arm::pose::{Vec3, add, distance, scale, sub, wrap};
use rand::Rng as _;
use rand_distr::{Distribution as _, StandardNormal};
use std::f64::consts::{FRAC_PI_2, PI};
use swm_core::policy::Expert;
use swm_core::{ExpertEntry, Key, Result, Rng, RowRef};

/// The experts of the tables.
pub const EXPERTS: &[ExpertEntry] = &[
    ExpertEntry {
        id: "expert",
        summary: "places one cube after another, unlocks and slides drawer and window, sets the locks",
        tasks: &[],
        make: || Box::new(TableExpert::new(1.0, 0.0)),
    },
    ExpertEntry {
        id: "paper-speed",
        summary: "the jobs of `expert`, at the speed and with the noise of OGBench's oracles",
        tasks: &[],
        make: || Box::new(TableExpert::new(PAPER_SPEED, PAPER_NOISE)),
    },
];

/// The largest motion and rotation of `paper-speed`, as actions.
const PAPER_SPEED: f64 = 0.7;
/// The largest deviation of the noise of `paper-speed` along x, y and z; each episode draws its own from 0 on. That of the
/// reference's `ExpertPolicy`.
const PAPER_NOISE: f64 = 0.1;
/// The noise of rotation and fingers, as multiples of that along x, y and z; the reference's.
const NOISE_SCALES: [f64; 5] = [1.0, 1.0, 1.0, 3.0, 10.0];

/// Displacement for an action of 1, in metres.
const ACTION_POSITION: f64 = 0.05;
/// Rotation for an action of 1, in radians.
const ACTION_YAW: f64 = 0.3;
/// Factor on the remaining displacement: the arm lags behind its targets under load.
const GAIN: f64 = 1.6;
/// Height above objects at which the gripper approaches and carries, in metres.
const HOVER: f64 = 0.09;
/// Horizontal tolerance before the gripper moves down, in metres.
const ABOVE_TOLERANCE: f64 = 0.012;
/// Tolerance before the gripper grasps, in metres.
const GRASP_TOLERANCE: f64 = 0.012;
/// Horizontal tolerance before a cube is released, in metres.
const RELEASE_TOLERANCE: f64 = 0.012;
/// Contact (0 to 1) above which a cube counts as grasped.
const GRASP_CONTACT: f64 = 0.5;
/// Height to which the gripper rises above a cube, a handle or a button, in metres.
const CLEARANCE: f64 = 0.06;
/// Distance below which cubes obstruct each other, in metres.
const OBSTACLE_DISTANCE: f64 = 0.06;
/// Depth of a button press below the top, in metres.
const PRESS_DEPTH: f64 = 0.035;
/// The position at which a cube is released to fall into the open drawer, in metres.
const OVER_DRAWER: Vec3 = [0.33, -0.24, 0.09];
/// The y coordinate below which objects are in the drawer, in metres.
const DRAWER_EDGE: f64 = -0.16;
/// The number of steps after which a job is planned again.
const MAX_JOB_STEPS: usize = 120;

/// A manipulation of one object.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Job {
    /// Carry a cube to a position (m) and yaw (rad).
    Carry(usize, Vec3, f64),
    /// Press a button.
    Press(usize),
    /// Slide the drawer (0) or the window (1) to an opening (m).
    Slide(usize, f64),
}

/// The expert of tables, with its present job.
struct TableExpert {
    /// The largest absolute value of an action that moves or rotates, before noise is added.
    speed: f64,
    /// The largest deviation of the noise along x, y and z.
    largest_noise: f64,
    /// The deviation of the present episode, and the generator of its noise.
    noise: (f64, Rng),
    job: Option<Job>,
    /// Steps since the job started.
    steps: usize,
    /// The states of the locks when the job started.
    locks: [i64; 2],
    /// Whether the gripper must still move away from the object of the last job.
    retreating: bool,
}

/// The columns that the expert reads. Positions are in metres, angles in radians.
struct Inputs {
    gripper: Vec3,
    yaw: f64,
    /// The closure of the fingers: 0 (open) to 1 (closed).
    closed: f64,
    contact: f64,
    /// Position and yaw of each cube.
    cubes: Vec<(Vec3, f64)>,
    /// Goal position and yaw of each cube.
    goals: Vec<(Vec3, f64)>,
    subject: Subject,
    fixtures: Option<FixtureInputs>,
}

/// The columns about buttons, drawer and window.
struct FixtureInputs {
    locks: [i64; 2],
    goal_locks: [i64; 2],
    openings: [f64; 2],
    goal_openings: [f64; 2],
    /// Position and yaw of the handles.
    handles: [(Vec3, f64); 2],
    /// Positions of the buttons' tops.
    tops: [Vec3; 2],
}

/// Reads a column of three elements.
fn vector(row: RowRef<'_>, name: &str) -> Result<Vec3> {
    let value = row.to_f64(name)?;
    Ok([value[0], value[1], value[2]])
}

/// Reads the first element of a column.
fn scalar(row: RowRef<'_>, name: &str) -> Result<f64> {
    Ok(row.to_f64(name)?[0])
}

impl Inputs {
    fn new(row: RowRef<'_>) -> Result<Self> {
        let positions = row.to_f64("goal/block_pos")?;
        let yaws = row.to_f64("goal/block_yaw")?;
        let goals: Vec<(Vec3, f64)> =
            positions.chunks_exact(3).zip(yaws).map(|(at, yaw)| ([at[0], at[1], at[2]], yaw)).collect();
        let cube = |i: usize| {
            let name = format!("privileged/block_{i}");
            Ok((vector(row, &format!("{name}_pos"))?, scalar(row, &format!("{name}_yaw"))?))
        };
        let subject = Subject::from_code(scalar(row, "goal/subject")? as i64);
        Ok(Self {
            gripper: vector(row, "proprio/effector_pos")?,
            yaw: scalar(row, "proprio/effector_yaw")?,
            closed: scalar(row, "proprio/gripper_opening")?,
            contact: scalar(row, "proprio/gripper_contact")?,
            cubes: (0..goals.len()).map(cube).collect::<Result<_>>()?,
            goals,
            subject,
            fixtures: match row.schema().find("button_states") {
                Some(_) => Some(FixtureInputs::new(row)?),
                None => None,
            },
        })
    }

    /// Whether the goal includes a subject.
    fn includes(&self, subject: Subject) -> bool {
        self.subject == Subject::All || self.subject == subject
    }

    /// Whether a cube is within 70 % of the tolerance of its goal, or is not part of the goal.
    fn is_placed(&self, cube: usize) -> bool {
        !self.includes(Subject::Cube(cube)) || distance(self.cubes[cube].0, self.goals[cube].0) <= 0.7 * GOAL_TOLERANCE
    }

    /// The cube on top of a cube.
    fn on_top(&self, cube: usize) -> Option<usize> {
        let at = self.cubes[cube].0;
        (0..self.cubes.len()).find(|&other| {
            let position = self.cubes[other].0;
            other != cube && position[2] > at[2] + 0.015 && horizontal_distance(position, at) < 0.03
        })
    }

    /// The cube, other than `cube`, that occupies a position.
    fn obstacle(&self, cube: usize, position: Vec3) -> Option<usize> {
        (0..self.cubes.len()).find(|&other| {
            let at = self.cubes[other].0;
            other != cube && horizontal_distance(at, position) < 0.045 && at[2] > position[2] - 0.02
        })
    }

    /// The free position on the table nearest to a cube, away from all cubes and goals.
    fn free_position(&self, cube: usize) -> Vec3 {
        let is_free = |position: &Vec3| {
            let far = |other: &Vec3| horizontal_distance(*other, *position) >= 1.3 * OBSTACLE_DISTANCE;
            (0..self.cubes.len()).all(|i| i == cube || far(&self.cubes[i].0))
                && self.goals.iter().all(|(goal, _)| far(goal))
        };
        let grid =
            (0..6).flat_map(|i| (0..13).map(move |j| [0.3 + 0.05 * f64::from(i), -0.3 + 0.05 * f64::from(j), 0.02]));
        let cube_position = self.cubes[cube].0;
        let free = grid.filter(is_free);
        free.min_by(|a, b| horizontal_distance(*a, cube_position).total_cmp(&horizontal_distance(*b, cube_position)))
            .unwrap_or([0.425, 0.0, 0.02])
    }

    /// The next job; `None` when the goal is reached.
    fn next_job(&self) -> Option<Job> {
        self.next_drawer_job().or_else(|| self.next_cube_job()).or_else(|| self.next_fixture_job())
    }

    /// The next job that moves the cube into the drawer or out of it, or prepares this move.
    fn next_drawer_job(&self) -> Option<Job> {
        let fixtures = self.fixtures.as_ref()?;
        let (cube, goal) = (self.cubes[0], self.goals[0]);
        let inside = |position: Vec3| position[1] < DRAWER_EDGE;
        if self.is_placed(0) || !(inside(goal.0) || inside(cube.0)) {
            return None;
        }
        if fixtures.openings[0] > OPEN[0] + 0.03 {
            // A cube in the drawer moves with the drawer.
            let both_inside = inside(cube.0) && inside(goal.0);
            return if both_inside { None } else { Some(fixtures.slide(0, OPEN[0])) };
        }
        match inside(goal.0) {
            true if !inside(cube.0) => Some(Job::Carry(0, OVER_DRAWER, cube.1)),
            true => None,
            false => Some(Job::Carry(0, goal.0, goal.1)),
        }
    }

    /// The next cube to carry: to its goal, or away from the goal of another cube.
    fn next_cube_job(&self) -> Option<Job> {
        let mut unplaced: Vec<usize> = (0..self.cubes.len()).filter(|&cube| !self.is_placed(cube)).collect();
        if self.fixtures.is_some() && self.goals[0].0[1] < DRAWER_EDGE {
            return None;
        }
        unplaced.sort_by(|&a, &b| self.goals[a].0[2].total_cmp(&self.goals[b].0[2]));
        let mut obstacle = None;
        for &cube in &unplaced {
            let (goal, yaw) = self.goals[cube];
            let supported = goal[2] < 0.03
                || (0..self.cubes.len()).any(|other| {
                    let at = self.cubes[other].0;
                    let is_below = (at[2] - goal[2]).abs() > 0.015 && at[2] < goal[2];
                    other != cube && horizontal_distance(at, goal) < 0.03 && is_below
                });
            if !supported {
                continue;
            }
            match self.on_top(cube).or_else(|| self.obstacle(cube, goal)) {
                None => return Some(Job::Carry(cube, goal, yaw)),
                Some(other) => obstacle = obstacle.or(Some(other)),
            }
        }
        // Cubes on top of the obstacle are removed first.
        let mut other = obstacle.or_else(|| unplaced.first().copied())?;
        while let Some(top) = self.on_top(other) {
            other = top;
        }
        Some(Job::Carry(other, self.free_position(other), self.cubes[other].1))
    }

    /// The next job for the drawer, the window or, last, a lock.
    fn next_fixture_job(&self) -> Option<Job> {
        let fixtures = self.fixtures.as_ref()?;
        for (i, subject) in [Subject::Drawer, Subject::Window].into_iter().enumerate() {
            let away = (fixtures.openings[i] - fixtures.goal_openings[i]).abs();
            if self.includes(subject) && away > 0.75 * GOAL_TOLERANCE {
                return Some(fixtures.slide(i, fixtures.goal_openings[i]));
            }
        }
        let wrong = |i: &usize| self.includes(Subject::Button(*i)) && fixtures.locks[*i] != fixtures.goal_locks[*i];
        (0..2).find(wrong).map(Job::Press)
    }
}

impl FixtureInputs {
    fn new(row: RowRef<'_>) -> Result<Self> {
        let pair = |name: &str| -> Result<[i64; 2]> {
            let value = row.to_f64(name)?;
            Ok([value[0] as i64, value[1] as i64])
        };
        let handle = |name: &str| -> Result<(Vec3, f64)> {
            let (position, yaw) = (format!("privileged/{name}_handle_pos"), format!("privileged/{name}_handle_yaw"));
            Ok((vector(row, &position)?, scalar(row, &yaw)?))
        };
        Ok(Self {
            locks: pair("button_states")?,
            goal_locks: pair("goal/button_states")?,
            openings: [scalar(row, "privileged/drawer_pos")?, scalar(row, "privileged/window_pos")?],
            goal_openings: [scalar(row, "goal/drawer_pos")?, scalar(row, "goal/window_pos")?],
            handles: [handle("drawer")?, handle("window")?],
            tops: [vector(row, "privileged/button_0_top_pos")?, vector(row, "privileged/button_1_top_pos")?],
        })
    }

    /// The job that slides the drawer (0) or the window (1), or first unlocks it.
    fn slide(&self, index: usize, to: f64) -> Job {
        if self.locks[index] == 0 { Job::Press(index) } else { Job::Slide(index, to) }
    }
}

/// The horizontal distance of two points, in metres.
fn horizontal_distance(a: Vec3, b: Vec3) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// The smallest rotation (rad) from `from` to an angle equivalent to `to`, for objects with rotational symmetry
/// `period`.
fn symmetric_rotation(from: f64, to: f64, period: f64) -> f64 {
    let difference = wrap(to - from);
    difference - (difference / period).round() * period
}

/// The motion of the gripper in a step.
struct Move {
    /// The target position, in metres.
    to: Vec3,
    /// The remaining rotation, in radians.
    rotation: f64,
    /// Whether the fingers close.
    close: bool,
}

impl TableExpert {
    /// Creates an expert whose actions that move or rotate are at most `speed`, with noise of at most this deviation,
    /// without a job.
    fn new(speed: f64, largest_noise: f64) -> Self {
        let noise = (0.0, Key::new(0).rng());
        Self { speed, largest_noise, noise, job: None, steps: 0, locks: [0; 2], retreating: false }
    }

    /// The move for a job; `None` when the job is done.
    fn perform(&mut self, job: Job, inputs: &Inputs) -> Option<Move> {
        match job {
            Job::Carry(cube, target, yaw) => self.carry(inputs, cube, target, yaw),
            Job::Press(button) => self.press(inputs, button),
            Job::Slide(index, to) => slide(inputs, index, to),
        }
    }

    /// The next move that carries a cube to a position (m) and yaw (rad).
    fn carry(&mut self, inputs: &Inputs, cube: usize, target: Vec3, yaw: f64) -> Option<Move> {
        let (at, cube_yaw) = inputs.cubes[cube];
        let gripper = inputs.gripper;
        let offset = sub(gripper, at);
        let grasped = inputs.contact > GRASP_CONTACT && distance(gripper, at) < 0.035;
        let above_target = horizontal_distance(at, target) <= RELEASE_TOLERANCE;
        let grasp_rotation = symmetric_rotation(inputs.yaw, cube_yaw, FRAC_PI_2);
        if above_target && (at[2] - target[2]).abs() <= RELEASE_TOLERANCE.max(0.5 * (target[2] - 0.05)) {
            self.retreating = true;
            return None;
        }
        if grasped {
            let gripper_goal = yaw + symmetric_rotation(cube_yaw, inputs.yaw, FRAC_PI_2);
            let rotation = symmetric_rotation(inputs.yaw, gripper_goal, FRAC_PI_2);
            let cruise = (target[2].max(at[2].min(0.12)) + HOVER).min(0.3);
            let to = if above_target {
                add(target, offset)
            } else if at[2] < cruise - 0.03 && horizontal_distance(at, target) > OBSTACLE_DISTANCE {
                [gripper[0], gripper[1], cruise + 0.02]
            } else {
                [target[0] + offset[0], target[1] + offset[1], cruise]
            };
            return Some(Move { to, rotation, close: true });
        }
        let near = horizontal_distance(gripper, at);
        let to = if near > ABOVE_TOLERANCE && gripper[2] < at[2] + CLEARANCE && near > 0.03 {
            [gripper[0], gripper[1], at[2] + HOVER + 0.03]
        } else if near > ABOVE_TOLERANCE || (grasp_rotation.abs() > 0.15 && gripper[2] > at[2] + 0.03) {
            [at[0], at[1], (at[2] + HOVER).min(gripper[2].max(at[2]))]
        } else {
            at
        };
        let close = distance(gripper, at) <= GRASP_TOLERANCE
            || (inputs.closed > 0.3 && near < 0.02 && gripper[2] < at[2] + 0.02);
        Some(Move { to, rotation: grasp_rotation, close })
    }

    /// The next move that presses a button.
    fn press(&mut self, inputs: &Inputs, button: usize) -> Option<Move> {
        let fixtures = inputs.fixtures.as_ref()?;
        if fixtures.locks[button] != self.locks[button] {
            self.retreating = true;
            return None;
        }
        let (top, gripper) = (fixtures.tops[button], inputs.gripper);
        let to = if horizontal_distance(gripper, top) > 0.02 {
            let height = top[2] + CLEARANCE;
            if gripper[2] < height - 0.03 { [gripper[0], gripper[1], height + 0.05] } else { [top[0], top[1], height] }
        } else {
            [top[0], top[1], top[2] - PRESS_DEPTH]
        };
        Some(Move { to, rotation: 0.0, close: true })
    }

    /// Updates `retreating`: the gripper retreats until it is open and above all nearby objects.
    fn update_retreat(&mut self, inputs: &Inputs) {
        let height = inputs.gripper[2];
        let cubes = inputs.cubes.iter().map(|(at, _)| height - at[2]).fold(height, f64::min);
        let fixtures = inputs.fixtures.as_ref().map_or(f64::MAX, |fixtures| {
            let points = fixtures.handles.iter().map(|(at, _)| *at).chain(fixtures.tops);
            let near = points.filter(|at| horizontal_distance(*at, inputs.gripper) < OBSTACLE_DISTANCE);
            near.map(|at| height - at[2]).fold(f64::MAX, f64::min)
        });
        self.retreating = cubes.min(fixtures) < CLEARANCE || (inputs.closed > 0.25 && self.steps < 2 * MAX_JOB_STEPS);
        if !self.retreating {
            self.steps = 0;
        }
    }
}

/// The next move that slides the drawer (0) or the window (1) to an opening (m).
fn slide(inputs: &Inputs, index: usize, to: f64) -> Option<Move> {
    let fixtures = inputs.fixtures.as_ref()?;
    let (handle, yaw) = fixtures.handles[index];
    let remaining = to - fixtures.openings[index];
    if remaining.abs() <= 0.01 {
        return None;
    }
    // The drawer opens along y, the window along x.
    let along = if index == 0 { [0.0, -remaining, 0.0] } else { [remaining, 0.0, 0.0] };
    let rotation = symmetric_rotation(inputs.yaw, yaw, PI);
    let gripper = inputs.gripper;
    let near = horizontal_distance(gripper, handle);
    let gripped = near <= 0.025 && gripper[2] < handle[2] + 0.03;
    let target = if gripped {
        add(handle, along)
    } else if near > ABOVE_TOLERANCE {
        let height = handle[2] + CLEARANCE + 0.02;
        if gripper[2] < height - 0.03 && near > 0.03 {
            [gripper[0], gripper[1], height + 0.03]
        } else {
            [handle[0], handle[1], height]
        }
    } else {
        handle
    };
    Some(Move { to: target, rotation, close: gripped && index == 1 })
}

impl Expert for TableExpert {
    fn begin(&mut self, key: Key) {
        *self = Self::new(self.speed, self.largest_noise);
        if self.largest_noise > 0.0 {
            let mut rng = key.rng();
            self.noise = (rng.random_range(0.0..self.largest_noise), rng);
        }
    }

    fn act(&mut self, row: RowRef<'_>, action: &mut [f64]) -> Result<()> {
        let inputs = Inputs::new(row)?;
        if self.steps >= MAX_JOB_STEPS {
            (self.job, self.retreating) = (None, true);
        }
        let mut chosen = None;
        for _ in 0..2 {
            if self.retreating {
                break;
            }
            if self.job.is_none() {
                self.job = inputs.next_job();
                self.steps = 0;
                self.locks = inputs.fixtures.as_ref().map_or([0; 2], |fixtures| fixtures.locks);
            }
            let Some(job) = self.job else { break };
            chosen = self.perform(job, &inputs);
            if chosen.is_some() {
                break;
            }
            (self.job, self.retreating) = (None, true);
        }
        self.steps += 1;
        // Without a job, the gripper opens and then rises.
        let [x, y, z] = inputs.gripper;
        let to = if inputs.closed > 0.25 { inputs.gripper } else { [x, y, z + 0.04] };
        let motion = chosen.unwrap_or(Move { to, rotation: 0.0, close: false });
        if self.retreating {
            self.update_retreat(&inputs);
        }
        let step = scale(sub(motion.to, inputs.gripper), GAIN / ACTION_POSITION);
        for (i, element) in action.iter_mut().enumerate() {
            let clamped = |value: f64| value.clamp(-self.speed, self.speed);
            *element = match i {
                0..3 => clamped(step[i]),
                3 => clamped(motion.rotation / ACTION_YAW),
                _ if motion.close => 1.0,
                _ => -1.0,
            };
            let (deviation, rng) = &mut self.noise;
            if *deviation > 0.0 {
                let noise: f64 = StandardNormal.sample(rng);
                *element = (*element + NOISE_SCALES[i] * *deviation * noise).clamp(-1.0, 1.0);
            }
        }
        Ok(())
    }
}
