//! The goal of a table environment: its objects, its success criterion, and the distance to the goal.

use super::config::FixtureState;
use super::objects::Objects;
use crate::ogbench::arm::pose::{Quat, Vec3, distance};

/// The distance within which cubes and openings are at their goal, in metres.
pub const GOAL_TOLERANCE: f64 = 0.04;
/// The distance that a lock in the wrong state adds, in metres.
const WRONG_LOCK_DISTANCE: f64 = 0.1;

/// The objects that a goal includes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Subject {
    /// All objects.
    All,
    /// One cube.
    Cube(usize),
    /// One button.
    Button(usize),
    /// The drawer.
    Drawer,
    /// The window.
    Window,
}

impl Subject {
    /// The integer that the column `goal/subject` contains.
    pub fn code(self) -> i64 {
        match self {
            Self::All => -1,
            Self::Cube(i) => i as i64,
            Self::Button(i) => 100 + i as i64,
            Self::Drawer => 200,
            Self::Window => 300,
        }
    }

    /// The subject with a code; [`Subject::All`] for an unknown code.
    pub fn from_code(code: i64) -> Self {
        match code {
            i @ 0..100 => Self::Cube(i as usize),
            i @ 100..200 => Self::Button(i as usize - 100),
            200 => Self::Drawer,
            300 => Self::Window,
            _ => Self::All,
        }
    }
}

/// One object of a goal.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GoalTerm {
    /// The distance of the object from its goal, in metres.
    pub distance: f64,
    /// Whether the object is at its goal.
    pub reached: bool,
    /// The position at which the gripper manipulates the object, in metres.
    pub grip: Vec3,
}

/// The comparison of a state with a goal.
pub struct GoalCheck<'a> {
    /// The indices of all objects.
    pub objects: &'a Objects,
    /// The joint positions of the state.
    pub qpos: &'a [f64],
    /// The positions of all sites, in metres.
    pub sites: &'a [Vec3],
    /// The present state of the fixtures.
    pub now: FixtureState,
    /// The goal pose of each cube.
    pub cubes: &'a [(Vec3, Quat)],
    /// The goal state of the fixtures.
    pub goal: FixtureState,
}

impl GoalCheck<'_> {
    /// The terms of a goal: cubes, then buttons, drawer and window.
    pub fn terms(&self, subject: Subject) -> impl Iterator<Item = GoalTerm> {
        let included = move |one: Subject| subject == Subject::All || subject == one;
        let within = |distance: f64, grip| GoalTerm { distance, reached: distance <= GOAL_TOLERANCE, grip };
        let cubes = self.objects.cubes.iter().enumerate().filter(move |(i, _)| included(Subject::Cube(*i))).map(
            move |(i, cube)| {
                let position = cube.position(self.qpos);
                within(distance(position, self.cubes[i].0), position)
            },
        );
        let fixtures = self.objects.fixtures.iter().flat_map(move |fixtures| {
            let button = |i: usize| {
                let is_equal = self.now.buttons[i] == self.goal.buttons[i];
                let distance = if is_equal { 0.0 } else { WRONG_LOCK_DISTANCE };
                let grip = self.sites[fixtures.buttons[i].top];
                (Subject::Button(i), GoalTerm { distance, reached: is_equal, grip })
            };
            let opening =
                |subject, now: f64, goal: f64, site: usize| (subject, within((now - goal).abs(), self.sites[site]));
            let (now, goal) = (self.now, self.goal);
            [
                button(0),
                button(1),
                opening(Subject::Drawer, now.drawer, goal.drawer, fixtures.drawer.handles[0]),
                opening(Subject::Window, now.window, goal.window, fixtures.window.handles[0]),
            ]
            .into_iter()
            .filter(move |(one, _)| included(*one))
            .map(|(_, term)| term)
        });
        cubes.chain(fixtures)
    }

    /// Whether all terms are reached.
    pub fn reached(&self, subject: Subject) -> bool {
        self.terms(subject).all(|term| term.reached)
    }

    /// The sum of the distances of all terms that are not reached, plus the distance of the gripper from the nearest
    /// object that is not at its goal, in metres.
    pub fn distance(&self, subject: Subject, gripper: Vec3) -> f64 {
        let open = || self.terms(subject).filter(|term| !term.reached);
        let terms: f64 = open().map(|term| term.distance).sum();
        let reach = open().map(|term| distance(term.grip, gripper)).min_by(f64::total_cmp);
        terms + reach.unwrap_or(0.0)
    }
}
