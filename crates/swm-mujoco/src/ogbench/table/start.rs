//! How episodes begin, and what they are for.

use super::goal::{NEAR, Subject};
use super::setup::{Bounds, Fixed};
use super::{Mode, Table};
use crate::Physics;
use crate::ogbench::arm::pose::{IDENTITY, Quat, Vec3, about_z, distance};
use crate::ogbench::arm::{ACTION, HOME};
use rand::Rng as _;
use rand::seq::{IndexedRandom as _, SliceRandom as _};
use std::f64::consts::{PI, TAU};
use swm_core::{Error, FactorValues, Key, Result, Rng};

/// How far cubes, drawer and window begin from where a task says, at most, in metres.
const JITTER: f64 = 0.01;
/// Random actions that let the world settle where the goal is reached.
const SETTLING: usize = 2;
/// How high the middle of a cube on the table is, and by how much higher one on top of another, in metres. As in the
/// reference, whatever the cubes' size is.
pub const CUBE_HEIGHT: f64 = 0.02;
const STACKED: f64 = 0.04;
/// Where markers go that mark nothing.
pub const AWAY: Vec3 = [0.0, 0.0, -0.3];
/// Where a cube goes in an open drawer, and in a closed one.
const IN_OPEN_DRAWER: Vec3 = [0.33, -0.24, 0.066];
const IN_CLOSED_DRAWER: Vec3 = [0.33, -0.356, 0.065986];
/// Where drawer and window are when they are open.
pub const OPEN: [f64; 2] = [-0.16, 0.2];
/// How often the reference, collecting data, puts a cube on another one, and into an open drawer.
const STACK: f64 = 0.5;
const INTO_DRAWER: f64 = 0.3;
/// How often it asks for a drawer or window that is locked, where it asks for cubes and buttons once.
const LOCKED: f64 = 0.25;
/// How often a sampled goal puts a cube on another one, or into the drawer.
const GOAL_STACK: f64 = 0.3;
/// Room between two cubes side by side at a sampled goal, in metres: the gripper fits between.
const ROOM: f64 = 0.08;
/// Goals tried, and places tried for a cube of one.
const TRIES: usize = 256;

fn within<const N: usize>([low, high]: Bounds<N>, rng: &mut Rng) -> [f64; N] {
    std::array::from_fn(|i| rng.random_range(low[i]..=high[i]))
}

impl Table {
    /// Begins an episode.
    pub(super) fn begin(&mut self, physics: &mut Physics, factors: &FactorValues, key: Key) {
        let rng = &mut key.rng();
        self.arm.put(physics, HOME);
        let task = match self.mode {
            Mode::Collect => None,
            Mode::Task => Some(rng.random_range(0..self.setup.tasks.len())),
            Mode::One(task) => Some(task),
        };
        match task {
            Some(task) => self.begin_task(physics, task, factors, rng),
            None => self.begin_from_factors(physics, factors, rng),
        }
        self.contact = 0.0;
        self.note_pose(physics);
        self.dress(physics);
        physics.forward();
    }

    /// First the goal, for what is observed there; then the start.
    fn begin_task(&mut self, physics: &mut Physics, task: usize, factors: &FactorValues, rng: &mut Rng) {
        let task = &self.setup.tasks[task];
        let mut order: Vec<usize> = (0..self.setup.cubes).collect();
        if self.permute {
            order.shuffle(rng);
        }
        let gripper = factors.get("agent.ee_start_position");
        let rest = physics.data().qpos().to_vec();
        let cubes = order.iter().map(|&i| (task.goals[i], IDENTITY)).collect();
        let [start, goal] = task.fixtures;
        self.settle_goal(physics, gripper, cubes, goal, rng);
        // What episodes do not place, such as the fingers, begins as the model has it.
        physics.data_mut().qpos_mut().copy_from_slice(&rest);
        physics.data_mut().qvel_mut().fill(0.0);
        self.put_arm(physics, gripper, rng);
        for (cube, &i) in self.parts.cubes.iter().zip(&order) {
            let [x, y, z] = task.starts[i];
            let mut jitter = || rng.random_range(-JITTER..=JITTER);
            let place = [x + jitter(), y + jitter(), z];
            cube.put(physics, place, about_z(rng.random_range(0.0..TAU)));
        }
        let mut near = |at: f64, [low, high]: [f64; 2]| (at + rng.random_range(-JITTER..=JITTER)).clamp(low, high);
        let (drawer, window) = (near(start.drawer, [OPEN[0], 0.0]), near(start.window, [0.0, OPEN[1]]));
        self.put_fixtures(physics, Fixed { buttons: start.buttons, drawer, window });
    }

    /// Puts everything where it should go, lets it settle, and takes that for the goal.
    fn settle_goal(
        &mut self,
        physics: &mut Physics,
        gripper: &[f64],
        cubes: Vec<(Vec3, Quat)>,
        fixed: Fixed,
        rng: &mut Rng,
    ) {
        (self.goal.subject, self.goal.cubes, self.goal.fixed) = (Subject::All, cubes, fixed);
        self.put_arm(physics, gripper, rng);
        for (cube, &(place, turn)) in self.parts.cubes.iter().zip(&self.goal.cubes) {
            cube.put(physics, place, turn);
        }
        self.move_marks(physics);
        self.put_fixtures(physics, fixed);
        self.dress(physics);
        physics.forward();
        for _ in 0..SETTLING {
            let action: [f32; ACTION] = std::array::from_fn(|_| rng.random_range(-1.0..=1.0));
            self.advance(physics, &action);
        }
        self.take_goal(physics);
    }

    /// Takes the present pose for the goal's. Derived quantities are those of the goal afterwards.
    fn take_goal(&mut self, physics: &mut Physics) {
        let (qpos, qvel) = (physics.data().qpos(), physics.data().qvel());
        self.goal.pose[..qpos.len()].copy_from_slice(qpos);
        self.goal.pose[qpos.len()..].copy_from_slice(qvel);
        self.goal.contact = self.contact;
        self.look_at_goal(physics);
    }

    /// Puts the gripper somewhere, turned by chance.
    fn put_arm(&self, physics: &mut Physics, place: &[f64], rng: &mut Rng) {
        let joints = self.arm.reach([place[0], place[1], place[2]], rng.random_range(-PI..=PI), HOME);
        self.arm.put(physics, joints);
    }

    /// Puts drawer, window and locks.
    fn put_fixtures(&mut self, physics: &mut Physics, fixed: Fixed) {
        if let Some(fixtures) = self.parts.fixtures {
            self.buttons = fixed.buttons;
            fixtures.put(physics, fixed);
        }
    }

    /// A start from the factors, and one thing to do.
    fn begin_from_factors(&mut self, physics: &mut Physics, factors: &FactorValues, rng: &mut Rng) {
        self.put_arm(physics, factors.get("agent.ee_start_position"), rng);
        let (places, yaws) = (factors.get("cube.start_position"), factors.get("cube.start_yaw"));
        for (i, cube) in self.parts.cubes.iter().enumerate() {
            cube.put(physics, [places[2 * i], places[2 * i + 1], CUBE_HEIGHT], about_z(yaws[i]));
        }
        let fixed = Fixed {
            buttons: [rng.random_range(0..2), rng.random_range(0..2)],
            drawer: rng.random_range(OPEN[0]..=0.0),
            window: rng.random_range(0.0..=OPEN[1]),
        };
        self.put_fixtures(physics, fixed);
        self.choose_subject(physics, factors, rng);
        self.move_marks(physics);
        // The pose at the goal: this one, with the subject where it should be.
        let start = physics.data().qpos().to_vec();
        if let Subject::Cube(i) = self.goal.subject {
            let (place, turn) = self.goal.cubes[i];
            self.parts.cubes[i].put(physics, place, turn);
        }
        if let Some(fixtures) = self.parts.fixtures {
            fixtures.put(physics, self.goal.fixed);
        }
        self.take_goal(physics);
        physics.data_mut().qpos_mut().copy_from_slice(&start);
    }

    /// Something to do, as the reference draws it when it collects data.
    fn choose_subject(&mut self, physics: &Physics, factors: &FactorValues, rng: &mut Rng) {
        let now = self.fixed(physics.data().qpos());
        self.goal.fixed = now;
        self.goal.cubes.fill((AWAY, IDENTITY));
        let weight = |button: usize| if now.buttons[button] == 0 { LOCKED } else { 1.0 };
        let kinds = [
            (Subject::Cube(0), 1.0),
            (Subject::Button(0), 1.0),
            (Subject::Drawer, weight(0)),
            (Subject::Window, weight(1)),
        ];
        let kinds = if self.setup.fixtures { &kinds[..] } else { &kinds[..1] };
        self.goal.subject = kinds.choose_weighted(rng, |kind| kind.1).map_or(Subject::Cube(0), |kind| kind.0);
        match self.goal.subject {
            Subject::Button(_) => {
                let button = rng.random_range(0..2);
                self.goal.subject = Subject::Button(button);
                self.goal.fixed.buttons[button] ^= 1;
            }
            Subject::Drawer => self.goal.fixed.drawer = if now.drawer >= OPEN[0] / 2.0 { OPEN[0] } else { 0.0 },
            Subject::Window => self.goal.fixed.window = if now.window <= OPEN[1] / 2.0 { OPEN[1] } else { 0.0 },
            Subject::Cube(_) | Subject::All => self.choose_cube(physics, now, factors, rng),
        }
    }

    /// A cube that nothing stands on, and where it should go: on another one, into the open drawer, or where the factors
    /// say.
    fn choose_cube(&mut self, physics: &Physics, now: Fixed, factors: &FactorValues, rng: &mut Rng) {
        let places: Vec<Vec3> = self.parts.cubes.iter().map(|cube| cube.place(physics.data().qpos())).collect();
        let above = |a: Vec3, b: Vec3| b[2] > a[2] && (a[0] - b[0]).hypot(a[1] - b[1]) < 0.02;
        let bare: Vec<usize> = (0..places.len()).filter(|&i| !places.iter().any(|&b| above(places[i], b))).collect();
        let cube = bare.choose(rng).copied().unwrap_or(0);
        let others: Vec<usize> = bare.into_iter().filter(|&other| other != cube).collect();
        let drawer = self.setup.fixtures && now.drawer < -0.12 && rng.random_bool(INTO_DRAWER);
        let below = others.choose(rng).copied().filter(|_| rng.random_bool(STACK));
        let place = match below {
            _ if drawer => {
                let [x, y, z] = IN_OPEN_DRAWER;
                [x + rng.random_range(-0.005..=0.005), y + rng.random_range(-0.005..=0.005), z]
            }
            Some(below) => {
                let [x, y, z] = places[below];
                [x, y, z + STACKED]
            }
            None => {
                let goal = factors.get("cube.goal_position");
                [goal[0], goal[1], CUBE_HEIGHT]
            }
        };
        self.goal.subject = Subject::Cube(cube);
        self.goal.cubes[cube] = (place, about_z(factors.get("cube.goal_yaw")[0]));
    }

    /// A goal that is not reached: cubes somewhere on the table or on each other, in the scene perhaps in the drawer; locks,
    /// drawer and window one way or the other. The state is the goal's afterwards.
    pub(super) fn choose_goal(&mut self, physics: &mut Physics, key: Key) -> Result<()> {
        let rng = &mut key.rng();
        let now_and_before = [self.buttons, self.previous_buttons];
        let (contact, previous) = (self.contact, self.previous.clone());
        let now = self.fixed(physics.data().qpos());
        let places: Vec<Vec3> = self.parts.cubes.iter().map(|cube| cube.place(physics.data().qpos())).collect();
        for _ in 0..TRIES {
            let Some(mut cubes) = self.scatter(rng) else { continue };
            let mut fixed = now;
            if self.setup.fixtures {
                fixed.buttons = [rng.random_range(0..2), rng.random_range(0..2)];
                fixed.drawer = if rng.random() { 0.0 } else { OPEN[0] };
                fixed.window = if rng.random() { 0.0 } else { OPEN[1] };
                if rng.random_bool(INTO_DRAWER) {
                    (cubes[0].0, fixed.drawer) = (IN_CLOSED_DRAWER, 0.0);
                }
            }
            let moved = places.iter().zip(&cubes).any(|(place, (goal, _))| distance(*place, *goal) > NEAR)
                || now.buttons != fixed.buttons
                || (now.drawer - fixed.drawer).abs() > NEAR
                || (now.window - fixed.window).abs() > NEAR;
            if moved {
                let gripper = within(self.setup.arm_bounds, rng);
                physics.reset();
                self.settle_goal(physics, &gripper, cubes, fixed, rng);
                [self.buttons, self.previous_buttons] = now_and_before;
                (self.contact, self.previous) = (contact, previous);
                return Ok(());
            }
        }
        Err(Error::Unsatisfiable {
            factor: "goal".to_owned(),
            constraint: "cubes apart from each other, and not reached already".to_owned(),
            tries: TRIES,
        })
    }

    /// Places for the cubes, apart from each other or on top of each other; `None` where chance left no room.
    fn scatter(&self, rng: &mut Rng) -> Option<Vec<(Vec3, Quat)>> {
        let mut places: Vec<(Vec3, Quat)> = vec![];
        let mut tops: Vec<usize> = vec![];
        let mut order: Vec<usize> = (0..self.setup.cubes).collect();
        order.shuffle(rng);
        for _ in 0..self.setup.cubes {
            let turn = about_z(rng.random_range(0.0..TAU));
            let base = tops.choose(rng).copied().filter(|_| rng.random_bool(GOAL_STACK));
            let place = match base {
                Some(base) => {
                    tops.retain(|&top| top != base);
                    let [x, y, z] = places[base].0;
                    [x, y, z + STACKED]
                }
                None => {
                    let apart =
                        |[x, y]: &[f64; 2]| places.iter().all(|(place, _)| (place[0] - x).hypot(place[1] - y) >= ROOM);
                    let [x, y] = (0..TRIES).map(|_| within(self.setup.object_bounds, rng)).find(apart)?;
                    [x, y, CUBE_HEIGHT]
                }
            };
            tops.push(places.len());
            places.push((place, turn));
        }
        Some(order.into_iter().map(|i| places[i]).collect())
    }
}
