//! The start of episodes, and the sampling of goals.

use super::config::{AWAY, Bounds, CUBE_HEIGHT, FixtureState, OPEN};
use super::goal::{GOAL_TOLERANCE, Subject};
use super::task::{Mode, Table};
use crate::Physics;
use crate::ogbench::arm::pose::{IDENTITY, Quat, Vec3, about_z, distance};
use crate::ogbench::arm::{ACTION, HOME};
use rand::Rng as _;
use rand::seq::{IndexedRandom as _, SliceRandom as _};
use std::f64::consts::{PI, TAU};
use swm_core::{Error, FactorValues, Key, Result, Rng};

/// Largest distance of cubes, drawer and window from their initial positions in the task, in metres.
const START_NOISE: f64 = 0.01;
/// The number of random actions in which objects settle at the goal.
const SETTLE_STEPS: usize = 2;
/// Height of a cube's centre above the centre of the cube below it, in metres; for cubes of any size, as in the
/// reference.
const STACK_HEIGHT: f64 = 0.04;
/// The position of a cube in an open drawer, in metres.
const IN_OPEN_DRAWER: Vec3 = [0.33, -0.24, 0.066];
/// The position of a cube in a closed drawer, in metres.
const IN_CLOSED_DRAWER: Vec3 = [0.33, -0.356, 0.065986];
/// Probability that a goal of `mode=data_collection` or `mode=play` stacks the cube.
const P_STACK: f64 = 0.5;
/// Probability that a goal puts the cube into the drawer.
const P_DRAWER: f64 = 0.3;
/// Weight of a locked drawer or window among the subjects of these modes; all other weights are 1.
const LOCKED_WEIGHT: f64 = 0.25;
/// Height of the gripper above every cube at which the next goal of `mode=play` follows, in metres.
const CLEAR_HEIGHT: f64 = 0.12;
/// Closure of the fingers (0 to 1) below which the next goal of `mode=play` follows.
const CLEAR_CLOSURE: f64 = 0.25;
/// Probability that a sampled goal stacks a cube.
const P_GOAL_STACK: f64 = 0.3;
/// The smallest distance of two cubes on the table at a sampled goal, in metres: the gripper fits between them.
const MIN_DISTANCE: f64 = 0.08;
/// The maximal number of goals drawn before sampling fails, and of positions drawn for each cube.
const TRIES: usize = 256;

/// Draws a point within bounds.
fn within<const N: usize>([low, high]: Bounds<N>, rng: &mut Rng) -> [f64; N] {
    std::array::from_fn(|i| rng.random_range(low[i]..=high[i]))
}

impl Table {
    /// Starts an episode.
    pub(super) fn begin(&mut self, physics: &mut Physics, factors: &FactorValues, key: Key) {
        let rng = &mut key.rng();
        self.arm.set_joints(physics, HOME);
        let task = match self.mode {
            Mode::DataCollection | Mode::Play => None,
            Mode::RandomTask => Some(rng.random_range(0..self.config.tasks.len())),
            Mode::FixedTask(task) => Some(task),
        };
        match task {
            Some(task) => self.begin_task(physics, task, factors, rng),
            None => self.begin_from_factors(physics, factors, rng),
        }
        self.contact = 0.0;
        self.store_previous(physics);
        self.update_model(physics);
        physics.forward();
    }

    /// Starts a task. The goal is simulated first, to compute its observation; then the start is set.
    fn begin_task(&mut self, physics: &mut Physics, task: usize, factors: &FactorValues, rng: &mut Rng) {
        let task = &self.config.tasks[task];
        let mut order: Vec<usize> = (0..self.config.cubes).collect();
        if self.permute {
            order.shuffle(rng);
        }
        let gripper = factors.get("agent.ee_start_position");
        let initial_qpos = physics.data().qpos().to_vec();
        let cubes = order.iter().map(|&i| (task.goals[i], IDENTITY)).collect();
        let [start, goal] = task.fixtures;
        self.settle_goal(physics, gripper, cubes, goal, rng);
        // Joints that the start does not set, such as the fingers, return to their initial positions.
        physics.data_mut().qpos_mut().copy_from_slice(&initial_qpos);
        physics.data_mut().qvel_mut().fill(0.0);
        self.set_gripper(physics, gripper, rng);
        for (cube, &i) in self.objects.cubes.iter().zip(&order) {
            let [x, y, z] = task.starts[i];
            let mut noise = || rng.random_range(-START_NOISE..=START_NOISE);
            let position = [x + noise(), y + noise(), z];
            cube.set_pose(physics, position, about_z(rng.random_range(0.0..TAU)));
        }
        let mut near =
            |at: f64, [low, high]: [f64; 2]| (at + rng.random_range(-START_NOISE..=START_NOISE)).clamp(low, high);
        let (drawer, window) = (near(start.drawer, [OPEN[0], 0.0]), near(start.window, [0.0, OPEN[1]]));
        self.set_fixtures(physics, FixtureState { buttons: start.buttons, drawer, window });
    }

    /// Puts all objects at their goals, lets them settle, and stores the result as the goal.
    fn settle_goal(
        &mut self,
        physics: &mut Physics,
        gripper: &[f64],
        cubes: Vec<(Vec3, Quat)>,
        fixtures: FixtureState,
        rng: &mut Rng,
    ) {
        (self.goal.subject, self.goal.cubes, self.goal.fixtures) = (Subject::All, cubes, fixtures);
        self.set_gripper(physics, gripper, rng);
        for (cube, &(position, rotation)) in self.objects.cubes.iter().zip(&self.goal.cubes) {
            cube.set_pose(physics, position, rotation);
        }
        self.move_marker_bodies(physics);
        self.set_fixtures(physics, fixtures);
        self.update_model(physics);
        physics.forward();
        for _ in 0..SETTLE_STEPS {
            let action: [f32; ACTION] = std::array::from_fn(|_| rng.random_range(-1.0..=1.0));
            self.advance(physics, &action);
        }
        self.store_goal(physics);
    }

    /// Stores the present pose as the goal pose. The physics has the derived quantities of the goal afterwards.
    fn store_goal(&mut self, physics: &mut Physics) {
        let (qpos, qvel) = (physics.data().qpos(), physics.data().qvel());
        self.goal.pose[..qpos.len()].copy_from_slice(qpos);
        self.goal.pose[qpos.len()..].copy_from_slice(qvel);
        self.goal.contact = self.contact;
        self.observe_goal(physics);
    }

    /// Sets the gripper's position (m), with a random yaw.
    fn set_gripper(&self, physics: &mut Physics, position: &[f64], rng: &mut Rng) {
        let yaw = rng.random_range(-PI..=PI);
        let joints = self.arm.solve([position[0], position[1], position[2]], yaw, HOME);
        self.arm.set_joints(physics, joints);
    }

    /// Sets drawer, window and locks.
    fn set_fixtures(&mut self, physics: &mut Physics, state: FixtureState) {
        if let Some(fixtures) = self.objects.fixtures {
            self.buttons = state.buttons;
            fixtures.set_openings(physics, state);
        }
    }

    /// Starts an episode of `mode=data_collection` or `mode=play`: the factors set the start, and the goal is one object.
    fn begin_from_factors(&mut self, physics: &mut Physics, factors: &FactorValues, rng: &mut Rng) {
        self.set_gripper(physics, factors.get("agent.ee_start_position"), rng);
        let (positions, yaws) = (factors.get("cube.start_position"), factors.get("cube.start_yaw"));
        for (i, cube) in self.objects.cubes.iter().enumerate() {
            cube.set_pose(physics, [positions[2 * i], positions[2 * i + 1], CUBE_HEIGHT], about_z(yaws[i]));
        }
        let fixtures = FixtureState {
            buttons: [rng.random_range(0..2), rng.random_range(0..2)],
            drawer: rng.random_range(OPEN[0]..=0.0),
            window: rng.random_range(0.0..=OPEN[1]),
        };
        self.set_fixtures(physics, fixtures);
        let goal = factors.get("cube.goal_position");
        self.set_subject_goal(physics, ([goal[0], goal[1]], factors.get("cube.goal_yaw")[0]), rng);
    }

    /// Whether the gripper is open and above all cubes, so that the next goal of `mode=play` may follow.
    pub(super) fn is_clear(&self, physics: &Physics) -> bool {
        let (gripper, qpos) = (self.proprioception(physics), physics.data().qpos());
        let mut heights = self.objects.cubes.iter().map(|cube| gripper.position[2] - cube.position(qpos)[2]);
        gripper.closed < CLEAR_CLOSURE && heights.all(|height| height > CLEAR_HEIGHT)
    }

    /// Draws the next goal of `mode=play`. The pose is the key of the draw, so that a restored state has the same next goal.
    pub(super) fn follow_goal(&mut self, physics: &mut Physics) {
        let bits = physics.data().qpos().iter().map(|value| value.to_bits());
        let rng = &mut bits.fold(Key::new(0).with("next goal"), Key::at).rng();
        let place = (within(self.config.object_bounds, rng), rng.random_range(0.0..TAU));
        self.set_subject_goal(physics, place, rng);
        self.update_model(physics);
    }

    /// Draws the subject of the goal and sets the goal's pose: the present one with the subject at its goal. A cube that
    /// goes to the table has the position (m) and yaw (rad) `place`.
    fn set_subject_goal(&mut self, physics: &mut Physics, place: ([f64; 2], f64), rng: &mut Rng) {
        self.draw_subject(physics, place, rng);
        self.move_marker_bodies(physics);
        let start = physics.data().qpos().to_vec();
        if let Subject::Cube(i) = self.goal.subject {
            let (position, rotation) = self.goal.cubes[i];
            self.objects.cubes[i].set_pose(physics, position, rotation);
        }
        if let Some(fixtures) = self.objects.fixtures {
            fixtures.set_openings(physics, self.goal.fixtures);
        }
        self.store_goal(physics);
        physics.data_mut().qpos_mut().copy_from_slice(&start);
    }

    /// Draws the subject of the goal, with the probabilities of the reference's data collection.
    fn draw_subject(&mut self, physics: &Physics, place: ([f64; 2], f64), rng: &mut Rng) {
        let now = self.fixture_state(physics.data().qpos());
        self.goal.fixtures = now;
        self.goal.cubes.fill((AWAY, IDENTITY));
        let weight = |button: usize| if now.buttons[button] == 0 { LOCKED_WEIGHT } else { 1.0 };
        let kinds = [
            (Subject::Cube(0), 1.0),
            (Subject::Button(0), 1.0),
            (Subject::Drawer, weight(0)),
            (Subject::Window, weight(1)),
        ];
        let kinds = if self.config.fixtures { &kinds[..] } else { &kinds[..1] };
        self.goal.subject = kinds.choose_weighted(rng, |kind| kind.1).map_or(Subject::Cube(0), |kind| kind.0);
        match self.goal.subject {
            Subject::Button(_) => {
                let button = rng.random_range(0..2);
                self.goal.subject = Subject::Button(button);
                self.goal.fixtures.buttons[button] ^= 1;
            }
            Subject::Drawer => self.goal.fixtures.drawer = if now.drawer >= OPEN[0] / 2.0 { OPEN[0] } else { 0.0 },
            Subject::Window => self.goal.fixtures.window = if now.window <= OPEN[1] / 2.0 { OPEN[1] } else { 0.0 },
            Subject::Cube(_) | Subject::All => self.draw_cube(physics, now, place, rng),
        }
    }

    /// Draws a cube without another cube on top, and its goal: on another cube, in the open drawer, or at `place`.
    fn draw_cube(&mut self, physics: &Physics, now: FixtureState, place: ([f64; 2], f64), rng: &mut Rng) {
        let qpos = physics.data().qpos();
        let positions: Vec<Vec3> = self.objects.cubes.iter().map(|cube| cube.position(qpos)).collect();
        let above = |a: Vec3, b: Vec3| b[2] > a[2] && (a[0] - b[0]).hypot(a[1] - b[1]) < 0.02;
        let is_top = |&i: &usize| !positions.iter().any(|&b| above(positions[i], b));
        let tops: Vec<usize> = (0..positions.len()).filter(is_top).collect();
        let cube = tops.choose(rng).copied().unwrap_or(0);
        let others: Vec<usize> = tops.into_iter().filter(|&other| other != cube).collect();
        let drawer = self.config.fixtures && now.drawer < -0.12 && rng.random_bool(P_DRAWER);
        let below = others.choose(rng).copied().filter(|_| rng.random_bool(P_STACK));
        let position = match below {
            _ if drawer => {
                let [x, y, z] = IN_OPEN_DRAWER;
                [x + rng.random_range(-0.005..=0.005), y + rng.random_range(-0.005..=0.005), z]
            }
            Some(below) => {
                let [x, y, z] = positions[below];
                [x, y, z + STACK_HEIGHT]
            }
            None => [place.0[0], place.0[1], CUBE_HEIGHT],
        };
        self.goal.subject = Subject::Cube(cube);
        self.goal.cubes[cube] = (position, about_z(place.1));
    }

    /// Samples a goal that is not reached: cubes on the table, on each other or in the drawer; locks, drawer and window
    /// in random states. The physics is in the goal state afterwards.
    ///
    /// # Errors
    /// When no such goal was drawn.
    pub(super) fn draw_goal(&mut self, physics: &mut Physics, key: Key) -> Result<()> {
        let rng = &mut key.rng();
        let buttons = [self.buttons, self.previous_buttons];
        let (contact, previous) = (self.contact, self.previous.clone());
        let qpos = physics.data().qpos();
        let now = self.fixture_state(qpos);
        let positions: Vec<Vec3> = self.objects.cubes.iter().map(|cube| cube.position(qpos)).collect();
        for _ in 0..TRIES {
            let Some(mut cubes) = self.draw_cube_poses(rng) else { continue };
            let mut fixtures = now;
            if self.config.fixtures {
                fixtures.buttons = [rng.random_range(0..2), rng.random_range(0..2)];
                fixtures.drawer = if rng.random() { 0.0 } else { OPEN[0] };
                fixtures.window = if rng.random() { 0.0 } else { OPEN[1] };
                if rng.random_bool(P_DRAWER) {
                    (cubes[0].0, fixtures.drawer) = (IN_CLOSED_DRAWER, 0.0);
                }
            }
            let mut pairs = positions.iter().zip(&cubes);
            let differs = pairs.any(|(position, (goal, _))| distance(*position, *goal) > GOAL_TOLERANCE)
                || now.buttons != fixtures.buttons
                || (now.drawer - fixtures.drawer).abs() > GOAL_TOLERANCE
                || (now.window - fixtures.window).abs() > GOAL_TOLERANCE;
            if differs {
                let gripper = within(self.config.arm_bounds, rng);
                physics.reset();
                self.settle_goal(physics, &gripper, cubes, fixtures, rng);
                [self.buttons, self.previous_buttons] = buttons;
                (self.contact, self.previous) = (contact, previous);
                return Ok(());
            }
        }
        Err(Error::Unsatisfiable {
            factor: "goal".to_owned(),
            constraint: "cubes apart from each other, and not already reached".to_owned(),
            tries: TRIES,
        })
    }

    /// Draws poses for the cubes, apart from each other or stacked; `None` if no free position was drawn.
    fn draw_cube_poses(&self, rng: &mut Rng) -> Option<Vec<(Vec3, Quat)>> {
        let mut poses: Vec<(Vec3, Quat)> = vec![];
        let mut tops: Vec<usize> = vec![];
        let mut order: Vec<usize> = (0..self.config.cubes).collect();
        order.shuffle(rng);
        for _ in 0..self.config.cubes {
            let rotation = about_z(rng.random_range(0.0..TAU));
            let base = tops.choose(rng).copied().filter(|_| rng.random_bool(P_GOAL_STACK));
            let position = match base {
                Some(base) => {
                    tops.retain(|&top| top != base);
                    let [x, y, z] = poses[base].0;
                    [x, y, z + STACK_HEIGHT]
                }
                None => {
                    let is_free =
                        |[x, y]: &[f64; 2]| poses.iter().all(|(at, _)| (at[0] - x).hypot(at[1] - y) >= MIN_DISTANCE);
                    let [x, y] = (0..TRIES).map(|_| within(self.config.object_bounds, rng)).find(is_free)?;
                    [x, y, CUBE_HEIGHT]
                }
            };
            tops.push(poses.len());
            poses.push((position, rotation));
        }
        Some(order.into_iter().map(|i| poses[i]).collect())
    }
}
