//! Who sets a table: one job after the other, each told from where things are, so that a slip is mended.
//!
//! OGBench's oracles carry out one job at a time (above, down, grasp, up, over, down, release). So do these; what to do next
//! is planned here, as a goal may ask for several: lower cubes before those on top of them, whatever is in the way aside,
//! unlocking before pulling, and locks last.

use super::goal::{NEAR, Subject};
use super::start::OPEN;
use crate::ogbench::arm::pose::{Vec3, add, distance, scale, sub, wrap};
use std::f64::consts::{FRAC_PI_2, PI};
use swm_core::policy::Expert;
use swm_core::{ExpertEntry, Key, Result, RowRef};

/// The experts of both tables.
pub const EXPERTS: &[ExpertEntry] = &[ExpertEntry {
    id: "expert",
    summary: "puts one cube after the other in its place, unlocks, opens and closes drawer and window, sets the locks",
    make: || Box::<Setter>::default(),
}];

/// Metres an action of 1 asks for, and radians.
const REACH: f64 = 0.05;
const TURN: f64 = 0.3;
/// How much more than the way left is asked for: the arm gives way to its weight and to what it holds.
const EAGER: f64 = 1.6;
/// How high one hovers over things, and carries cubes, in metres above them.
const HOVER: f64 = 0.09;
/// How exactly one is above something before going down, and at something before grasping it.
const ABOVE: f64 = 0.012;
const AT: f64 = 0.012;
/// How near to its place a cube is set down.
const PLACED: f64 = 0.012;
/// From where on a contact is a grasp, and until where none.
const HELD: f64 = 0.5;
/// How high one lifts away from a cube, a handle or a button.
const CLEAR: f64 = 0.06;
/// Cubes nearer than this are in each other's way.
const WIDE: f64 = 0.06;
/// How far a button is pressed below its top.
const PRESS: f64 = 0.035;
/// Where a cube is let go to fall into the open drawer.
const OVER_DRAWER: Vec3 = [0.33, -0.24, 0.09];
/// What is beyond this is in the drawer.
const DRAWER_EDGE: f64 = -0.16;
/// Steps after which a job is thought over.
const PATIENCE: usize = 120;

/// One thing to do.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Job {
    /// A cube goes somewhere, turned somehow.
    Carry(usize, Vec3, f64),
    /// A button is pressed.
    Press(usize),
    /// The drawer (0) or the window (1) goes to an opening.
    Slide(usize, f64),
}

/// Does one job after the other.
#[derive(Default)]
struct Setter {
    job: Option<Job>,
    /// Steps spent on it.
    spent: usize,
    /// How the locks stood when it began.
    locks: [i64; 2],
    /// Whether the gripper leaves what it worked on before the next job.
    leaving: bool,
}

/// What one sees.
struct View {
    hand: Vec3,
    yaw: f64,
    closed: f64,
    contact: f64,
    cubes: Vec<(Vec3, f64)>,
    goals: Vec<(Vec3, f64)>,
    subject: Subject,
    fixtures: Option<Fixtures>,
}

struct Fixtures {
    locks: [i64; 2],
    wanted_locks: [i64; 2],
    openings: [f64; 2],
    wanted: [f64; 2],
    handles: [(Vec3, f64); 2],
    tops: [Vec3; 2],
}

impl View {
    fn new(row: RowRef<'_>) -> Result<Self> {
        let vector = |name: &str| -> Result<Vec3> {
            let value = row.to_f64(name)?;
            Ok([value[0], value[1], value[2]])
        };
        let number = |name: &str| Ok(row.to_f64(name)?[0]);
        let places = row.to_f64("goal/block_pos")?;
        let yaws = row.to_f64("goal/block_yaw")?;
        let goals: Vec<(Vec3, f64)> =
            places.chunks_exact(3).zip(yaws).map(|(place, yaw)| ([place[0], place[1], place[2]], yaw)).collect();
        let cube = |i: usize| {
            let name = format!("privileged/block_{i}");
            Ok((vector(&format!("{name}_pos"))?, number(&format!("{name}_yaw"))?))
        };
        let subject = Subject::from_number(number("goal/subject")? as i64);
        Ok(Self {
            hand: vector("proprio/effector_pos")?,
            yaw: number("proprio/effector_yaw")?,
            closed: number("proprio/gripper_opening")?,
            contact: number("proprio/gripper_contact")?,
            cubes: (0..goals.len()).map(cube).collect::<Result<_>>()?,
            goals,
            subject,
            fixtures: match row.schema().find("button_states") {
                Some(_) => Some(Fixtures::new(row)?),
                None => None,
            },
        })
    }

    /// Whether something must be as the goal says.
    fn asks(&self, one: Subject) -> bool {
        self.subject == Subject::All || self.subject == one
    }

    fn is_home(&self, cube: usize) -> bool {
        !self.asks(Subject::Cube(cube)) || distance(self.cubes[cube].0, self.goals[cube].0) <= 0.7 * NEAR
    }

    /// The cube that stands on this one.
    fn on_top(&self, cube: usize) -> Option<usize> {
        let at = self.cubes[cube].0;
        (0..self.cubes.len()).find(|&other| {
            let place = self.cubes[other].0;
            other != cube && place[2] > at[2] + 0.015 && across(place, at) < 0.03
        })
    }

    /// The cube that is where another one should go.
    fn in_the_way(&self, cube: usize, place: Vec3) -> Option<usize> {
        (0..self.cubes.len()).find(|&other| {
            let at = self.cubes[other].0;
            other != cube && across(at, place) < 0.045 && at[2] > place[2] - 0.02
        })
    }

    /// Somewhere on the table where nothing is and nothing should go.
    fn aside(&self, cube: usize) -> Vec3 {
        let free = |place: &Vec3| {
            let far = |other: &Vec3| across(*other, *place) >= 1.3 * WIDE;
            (0..self.cubes.len()).all(|i| i == cube || far(&self.cubes[i].0))
                && self.goals.iter().all(|(goal, _)| far(goal))
        };
        let grid =
            (0..6).flat_map(|i| (0..13).map(move |j| [0.3 + 0.05 * f64::from(i), -0.3 + 0.05 * f64::from(j), 0.02]));
        let here = self.cubes[cube].0;
        grid.filter(free).min_by(|a, b| across(*a, here).total_cmp(&across(*b, here))).unwrap_or([0.425, 0.0, 0.02])
    }

    /// What to do next, `None` when all is done.
    fn next(&self) -> Option<Job> {
        self.next_of_scene().or_else(|| self.next_cube()).or_else(|| self.next_fixture())
    }

    /// What must be done before a cube can go into the drawer or out of it.
    fn next_of_scene(&self) -> Option<Job> {
        let fixtures = self.fixtures.as_ref()?;
        let (cube, goal) = (self.cubes[0], self.goals[0]);
        let inside = |place: Vec3| place[1] < DRAWER_EDGE;
        if self.is_home(0) || !(inside(goal.0) || inside(cube.0)) {
            return None;
        }
        if fixtures.openings[0] > OPEN[0] + 0.03 {
            // A cube in the drawer moves with it.
            let there = inside(cube.0) && inside(goal.0);
            return if there { None } else { Some(fixtures.slide(0, OPEN[0])) };
        }
        match inside(goal.0) {
            true if !inside(cube.0) => Some(Job::Carry(0, OVER_DRAWER, cube.1)),
            true => None,
            false => Some(Job::Carry(0, goal.0, goal.1)),
        }
    }

    /// The next cube to move: to its goal, or out of the way of another.
    fn next_cube(&self) -> Option<Job> {
        let mut open: Vec<usize> = (0..self.cubes.len()).filter(|&cube| !self.is_home(cube)).collect();
        if self.fixtures.is_some() && self.goals[0].0[1] < DRAWER_EDGE {
            return None;
        }
        open.sort_by(|&a, &b| self.goals[a].0[2].total_cmp(&self.goals[b].0[2]));
        let mut obstacle = None;
        for &cube in &open {
            let (place, yaw) = self.goals[cube];
            let supported = place[2] < 0.03
                || (0..self.cubes.len()).any(|other| {
                    let at = self.cubes[other].0;
                    other != cube && across(at, place) < 0.03 && (at[2] - place[2]).abs() > 0.015 && at[2] < place[2]
                });
            if !supported {
                continue;
            }
            match self.on_top(cube).or_else(|| self.in_the_way(cube, place)) {
                None => return Some(Job::Carry(cube, place, yaw)),
                Some(other) => obstacle = obstacle.or(Some(other)),
            }
        }
        // Whatever stands on what is in the way goes first.
        let mut other = obstacle.or_else(|| open.first().copied())?;
        while let Some(top) = self.on_top(other) {
            other = top;
        }
        Some(Job::Carry(other, self.aside(other), self.cubes[other].1))
    }

    /// Drawer, window, and at last the locks.
    fn next_fixture(&self) -> Option<Job> {
        let fixtures = self.fixtures.as_ref()?;
        for (i, subject) in [Subject::Drawer, Subject::Window].into_iter().enumerate() {
            let away = (fixtures.openings[i] - fixtures.wanted[i]).abs();
            if self.asks(subject) && away > 0.75 * NEAR {
                return Some(fixtures.slide(i, fixtures.wanted[i]));
            }
        }
        let wrong = |i: &usize| self.asks(Subject::Button(*i)) && fixtures.locks[*i] != fixtures.wanted_locks[*i];
        (0..2).find(wrong).map(Job::Press)
    }
}

impl Fixtures {
    fn new(row: RowRef<'_>) -> Result<Self> {
        let vector = |name: &str| -> Result<Vec3> {
            let value = row.to_f64(name)?;
            Ok([value[0], value[1], value[2]])
        };
        let number = |name: &str| -> Result<f64> { Ok(row.to_f64(name)?[0]) };
        let pair = |name: &str| -> Result<[i64; 2]> {
            let value = row.to_f64(name)?;
            Ok([value[0] as i64, value[1] as i64])
        };
        let handle = |name: &str| -> Result<(Vec3, f64)> {
            Ok((vector(&format!("privileged/{name}_handle_pos"))?, number(&format!("privileged/{name}_handle_yaw"))?))
        };
        Ok(Self {
            locks: pair("button_states")?,
            wanted_locks: pair("goal/button_states")?,
            openings: [number("privileged/drawer_pos")?, number("privileged/window_pos")?],
            wanted: [number("goal/drawer_pos")?, number("goal/window_pos")?],
            handles: [handle("drawer")?, handle("window")?],
            tops: [vector("privileged/button_0_top_pos")?, vector("privileged/button_1_top_pos")?],
        })
    }

    /// Moving the drawer or the window, or unlocking it first.
    fn slide(&self, which: usize, to: f64) -> Job {
        if self.locks[which] == 0 { Job::Press(which) } else { Job::Slide(which, to) }
    }
}

/// How far two places are apart, seen from above.
fn across(a: Vec3, b: Vec3) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// The turn nearest to `from` that looks like `to`, when a turn by `period` changes nothing.
fn alike(from: f64, to: f64, period: f64) -> f64 {
    let apart = wrap(to - from);
    apart - (apart / period).round() * period
}

/// Where the hand goes, how it turns, and whether it closes.
struct Move {
    to: Vec3,
    turn: f64,
    close: bool,
}

impl Setter {
    /// The move for a job, `None` when it is done.
    fn carry_out(&mut self, job: Job, view: &View) -> Option<Move> {
        match job {
            Job::Carry(cube, place, yaw) => self.carry(view, cube, place, yaw),
            Job::Press(button) => self.press(view, button),
            Job::Slide(which, to) => slide(view, which, to),
        }
    }

    fn carry(&mut self, view: &View, cube: usize, place: Vec3, yaw: f64) -> Option<Move> {
        let (at, turn) = view.cubes[cube];
        let away = sub(view.hand, at);
        let grasped = view.contact > HELD && distance(view.hand, at) < 0.035;
        let there = across(at, place) <= PLACED;
        let turn_to_grasp = alike(view.yaw, turn, FRAC_PI_2);
        if there && (at[2] - place[2]).abs() <= PLACED.max(0.5 * (place[2] - 0.05)) {
            self.leaving = true;
            return None;
        }
        if grasped {
            let turn = alike(view.yaw, yaw + alike(turn, view.yaw, FRAC_PI_2), FRAC_PI_2);
            let cruise = (place[2].max(at[2].min(0.12)) + HOVER).min(0.3);
            let to = if there {
                add(place, away)
            } else if at[2] < cruise - 0.03 && across(at, place) > WIDE {
                [view.hand[0], view.hand[1], cruise + 0.02]
            } else {
                [place[0] + away[0], place[1] + away[1], cruise]
            };
            return Some(Move { to, turn, close: true });
        }
        let near = across(view.hand, at);
        let to = if near > ABOVE && view.hand[2] < at[2] + CLEAR && near > 0.03 {
            [view.hand[0], view.hand[1], at[2] + HOVER + 0.03]
        } else if near > ABOVE || (turn_to_grasp.abs() > 0.15 && view.hand[2] > at[2] + 0.03) {
            [at[0], at[1], (at[2] + HOVER).min(view.hand[2].max(at[2]))]
        } else {
            at
        };
        let close = distance(view.hand, at) <= AT || (view.closed > 0.3 && near < 0.02 && view.hand[2] < at[2] + 0.02);
        Some(Move { to, turn: turn_to_grasp, close })
    }

    fn press(&mut self, view: &View, button: usize) -> Option<Move> {
        let fixtures = view.fixtures.as_ref()?;
        if fixtures.locks[button] != self.locks[button] {
            self.leaving = true;
            return None;
        }
        let top = fixtures.tops[button];
        let to = if across(view.hand, top) > 0.02 {
            let height = top[2] + CLEAR;
            if view.hand[2] < height - 0.03 {
                [view.hand[0], view.hand[1], height + 0.05]
            } else {
                [top[0], top[1], height]
            }
        } else {
            [top[0], top[1], top[2] - PRESS]
        };
        Some(Move { to, turn: 0.0, close: true })
    }
}

fn slide(view: &View, which: usize, to: f64) -> Option<Move> {
    let fixtures = view.fixtures.as_ref()?;
    let (handle, yaw) = fixtures.handles[which];
    let left = to - fixtures.openings[which];
    if left.abs() <= 0.01 {
        return None;
    }
    // The drawer opens along y, the window along x.
    let along = if which == 0 { [0.0, -left, 0.0] } else { [left, 0.0, 0.0] };
    let turn = alike(view.yaw, yaw, PI);
    let near = across(view.hand, handle);
    let gripped = near <= 0.025 && view.hand[2] < handle[2] + 0.03;
    let target = if gripped {
        add(handle, along)
    } else if near > ABOVE {
        let height = handle[2] + CLEAR + 0.02;
        if view.hand[2] < height - 0.03 && near > 0.03 {
            [view.hand[0], view.hand[1], height + 0.03]
        } else {
            [handle[0], handle[1], height]
        }
    } else {
        handle
    };
    Some(Move { to: target, turn, close: gripped && which == 1 })
}

impl Expert for Setter {
    fn begin(&mut self, _: Key) {
        *self = Self::default();
    }

    fn act(&mut self, row: RowRef<'_>, action: &mut [f64]) -> Result<()> {
        let view = View::new(row)?;
        if self.spent >= PATIENCE {
            (self.job, self.leaving) = (None, true);
        }
        let mut chosen = None;
        for _ in 0..2 {
            if self.leaving {
                break;
            }
            if self.job.is_none() {
                self.job = view.next();
                self.spent = 0;
                self.locks = view.fixtures.as_ref().map_or([0; 2], |fixtures| fixtures.locks);
            }
            let Some(job) = self.job else { break };
            chosen = self.carry_out(job, &view);
            if chosen.is_some() {
                break;
            }
            (self.job, self.leaving) = (None, true);
        }
        self.spent += 1;
        // Let go and rise before anything else.
        let lifted = [view.hand[0], view.hand[1], view.hand[2] + 0.04];
        let rising = Move { to: if view.closed > 0.25 { view.hand } else { lifted }, turn: 0.0, close: false };
        let way = chosen.unwrap_or(rising);
        if self.leaving {
            let nearest = view.cubes.iter().map(|(at, _)| view.hand[2] - at[2]).fold(view.hand[2], f64::min);
            let handles = view.fixtures.as_ref().map_or(f64::MAX, |fixtures| {
                let near = fixtures.handles.iter().map(|(at, _)| *at).chain(fixtures.tops);
                near.filter(|at| across(*at, view.hand) < WIDE).map(|at| view.hand[2] - at[2]).fold(f64::MAX, f64::min)
            });
            self.leaving = nearest.min(handles) < CLEAR || (view.closed > 0.25 && self.spent < 2 * PATIENCE);
            if !self.leaving {
                self.spent = 0;
            }
        }
        let step = scale(sub(way.to, view.hand), EAGER / REACH);
        for (i, part) in action.iter_mut().enumerate() {
            *part = match i {
                0..3 => step[i],
                3 => way.turn / TURN,
                _ => {
                    if way.close {
                        1.0
                    } else {
                        -1.0
                    }
                }
            }
            .clamp(-1.0, 1.0);
        }
        Ok(())
    }
}
