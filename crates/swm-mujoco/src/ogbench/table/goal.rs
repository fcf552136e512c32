//! What should become of a table, and how far it is from that.

use super::parts::Parts;
use super::setup::Fixed;
use crate::ogbench::arm::pose::{Quat, Vec3, distance};

/// How near is near enough: metres for cubes and for the openings of drawer and window.
pub const NEAR: f64 = 0.04;
/// What a lock that stands wrong counts, in metres.
const WRONG_LOCK: f64 = 0.1;

/// What must be as the goal says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Subject {
    /// Everything.
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
    /// Numbers for [`Subject::from_number`], which the memory of a task holds.
    pub fn number(self) -> i64 {
        match self {
            Self::All => -1,
            Self::Cube(i) => i as i64,
            Self::Button(i) => 100 + i as i64,
            Self::Drawer => 200,
            Self::Window => 300,
        }
    }

    /// The subject of a number; what is none is everything.
    pub fn from_number(number: i64) -> Self {
        match number {
            i @ 0..100 => Self::Cube(i as usize),
            i @ 100..200 => Self::Button(i as usize - 100),
            200 => Self::Drawer,
            300 => Self::Window,
            _ => Self::All,
        }
    }
}

/// One thing that is not as it should be.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gap {
    /// How far from its goal, in metres.
    pub size: f64,
    /// Whether that is near enough.
    pub closed: bool,
    /// Where the gripper has to go to change it.
    pub grip: Vec3,
}

/// Where things are that goals are about.
pub struct Sight<'a> {
    /// Where everything is found.
    pub parts: &'a Parts,
    /// Positions of all joints.
    pub qpos: &'a [f64],
    /// Places of all sites.
    pub sites: &'a [Vec3],
    /// How the fixtures stand.
    pub now: Fixed,
    /// Where the cubes should be.
    pub cubes: &'a [(Vec3, Quat)],
    /// How the fixtures should stand.
    pub goal: Fixed,
}

impl Sight<'_> {
    /// What the goal is about: the cubes, then buttons, drawer and window.
    pub fn gaps(&self, subject: Subject) -> impl Iterator<Item = Gap> {
        let asked = move |one: Subject| subject == Subject::All || subject == one;
        let near = |size: f64, grip| Gap { size, closed: size <= NEAR, grip };
        let cubes =
            self.parts.cubes.iter().enumerate().filter(move |(i, _)| asked(Subject::Cube(*i))).map(move |(i, cube)| {
                let place = cube.place(self.qpos);
                near(distance(place, self.cubes[i].0), place)
            });
        let fixtures = self.parts.fixtures.iter().flat_map(move |fixtures| {
            let button = |i: usize| {
                let right = self.now.buttons[i] == self.goal.buttons[i];
                let size = if right { 0.0 } else { WRONG_LOCK };
                (Subject::Button(i), Gap { size, closed: right, grip: self.sites[fixtures.buttons[i].top] })
            };
            let opening =
                |subject, now: f64, goal: f64, site: usize| (subject, near((now - goal).abs(), self.sites[site]));
            let (now, goal) = (self.now, self.goal);
            [
                button(0),
                button(1),
                opening(Subject::Drawer, now.drawer, goal.drawer, fixtures.drawer.handles[0]),
                opening(Subject::Window, now.window, goal.window, fixtures.window.handles[0]),
            ]
            .into_iter()
            .filter(move |(one, _)| asked(*one))
            .map(|(_, gap)| gap)
        });
        cubes.chain(fixtures)
    }

    /// Whether everything is near enough.
    pub fn reached(&self, subject: Subject) -> bool {
        self.gaps(subject).all(|gap| gap.closed)
    }

    /// How far everything that is not near enough is from its goal, and the gripper at `grip` from the nearest of it, in
    /// metres.
    pub fn distance(&self, subject: Subject, grip: Vec3) -> f64 {
        let open = || self.gaps(subject).filter(|gap| !gap.closed);
        let away: f64 = open().map(|gap| gap.size).sum();
        let reach = open().map(|gap| distance(gap.grip, grip)).min_by(f64::total_cmp);
        away + reach.unwrap_or(0.0)
    }
}
