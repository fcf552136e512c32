//! Ways through the world: how long the shortest one is, and where to head next on it.
//!
//! Rooms are convex, so a way is a straight line, or two that meet in a door.

use super::physics::{CENTER, GOAL_RADIUS, Layout, MAX_DOORS};

/// A place in double precision.
pub type Place = [f64; 2];

/// How far inside a door's opening a way stays, where the door is wide enough.
const CLEARANCE: f64 = 3.0;
/// How far from touching the wall a way turns.
const STAND_OFF: f64 = 1.0;
/// From this near a target counts as reached, a step's rounding allowed for.
const NEAR: f64 = GOAL_RADIUS as f64 - 0.5;

/// The opening of a door that the agent's centre can really use, if any.
fn opening(layout: &Layout, door: [f64; 2]) -> Option<[f64; 2]> {
    let [low, high] = layout.reach();
    let (first, last) = (door[0].max(low), door[1].min(high));
    (first < last).then_some([first, last])
}

/// An opening narrowed on both sides by `share` of the clearance.
fn narrowed([first, last]: [f64; 2], share: f64) -> [f64; 2] {
    let inset = CLEARANCE.min((last - first) / 4.0) * share;
    [first + inset, last - inset]
}

/// The best door between two rooms: its opening, where along the wall to cross, and the length of the way.
fn best_door(layout: &Layout, from: Place, to: Place) -> Option<([f64; 2], f64, f64)> {
    let (across, along) = (layout.across, 1 - layout.across);
    let before = (from[across] - CENTER).abs();
    let after = (to[across] - CENTER).abs();
    // Where the straight line meets the wall; the nearest place of a door to it is where to cross.
    let straight = from[along] + (to[along] - from[along]) * before / (before + after).max(1e-9);
    let mut best = None;
    let doors: [_; MAX_DOORS] = layout.doors;
    for opening in doors.into_iter().filter_map(|door| opening(layout, door)) {
        let [first, last] = narrowed(opening, 1.0);
        let crossing = straight.clamp(first, last);
        let length = before.hypot(from[along] - crossing) + after.hypot(to[along] - crossing);
        if best.is_none_or(|(_, _, shortest)| length < shortest) {
            best = Some((opening, crossing, length));
        }
    }
    best
}

/// The length of the shortest way between two places in the rooms; `None` when no door can be passed.
pub fn length(layout: &Layout, from: Place, to: Place) -> Option<f64> {
    let side = |p: Place| p[layout.across] < CENTER;
    if side(from) == side(to) {
        return Some((from[0] - to[0]).hypot(from[1] - to[1]));
    }
    best_door(layout, from, to).map(|(_, _, length)| length)
}

/// Where to head from `from` to get to `to`: the target, the mouth of a door, or the other end of it.
///
/// A function of the two places alone, so whoever follows it may be pushed off the way at any time.
pub fn waypoint(layout: &Layout, from: Place, to: Place) -> Place {
    let (across, along) = (layout.across, 1 - layout.across);
    let touch = layout.touch();
    // Towards the wall is positive: the own room lies below -touch, the other one above touch.
    let outward = if from[across] < CENTER { 1.0 } else { -1.0 };
    let depth = |p: Place| (p[across] - CENTER) * outward;
    let at = |depth: f64, place: f64| {
        let mut p = [place; 2];
        p[across] = CENTER + depth * outward;
        p
    };
    let in_wall = |p: Place| depth(p).abs() <= touch;

    if in_wall(from) {
        let mut doors = layout.doors.into_iter().filter_map(|door| opening(layout, door));
        let within = |p: Place, [first, last]: [f64; 2]| (first..=last).contains(&p[along]);
        return match doors.find(|&opening| within(from, opening)) {
            Some(opening) if !(in_wall(to) && within(to, opening)) => {
                let [first, last] = narrowed(opening, 0.5);
                at((touch + STAND_OFF).copysign(depth(to)), to[along].clamp(first, last))
            }
            _ => to,
        };
    }
    if depth(to) < -touch {
        return to;
    }
    match best_door(layout, from, to) {
        // Nothing to pass through: stay near.
        None => to,
        Some((opening, crossing, _)) => {
            let [first, last] = narrowed(opening, 0.5);
            let within = |p: Place| (first..=last).contains(&p[along]);
            if in_wall(to) && !within(to) && (depth(to) <= 0.0 || depth(to) + touch + STAND_OFF < NEAR) {
                // A target inside the wall, near enough to be reached from this side.
                to
            } else if !within(from) {
                at(-touch - STAND_OFF, crossing)
            } else if in_wall(to) && within(to) {
                to
            } else {
                at(touch + STAND_OFF, to[along].clamp(first, last))
            }
        }
    }
}
