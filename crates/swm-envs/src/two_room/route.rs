//! Ways through the world: how long the shortest one is, and where to head next on it.
//!
//! Rooms are convex, so a way is a straight line, or two that meet in a door.

use super::physics::{CENTER, GOAL_RADIUS, Layout};

/// A place in double precision.
pub type Place = [f64; 2];

/// How far inside a door's opening a way stays, where the door is wide enough.
const CLEARANCE: f64 = 3.0;
/// How far from touching the wall a way turns.
const STAND_OFF: f64 = 1.0;
/// From this near a target counts as reached, with something to spare.
const NEAR: f64 = GOAL_RADIUS as f64 - SPARE;
/// What is spared there, and where one stands beside the wall, in pixels.
const SPARE: f64 = 0.05;

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
    for opening in openings(layout) {
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

/// The openings of all doors that can be used.
fn openings(layout: &Layout) -> impl Iterator<Item = [f64; 2]> + use<> {
    let layout = *layout;
    layout.doors.into_iter().filter_map(move |door| opening(&layout, door))
}

/// Where to stand for `to`: there, or, when that is inside the wall, at the place of the wall's faces and the doors
/// that is near enough and has the shortest way; the nearest one where none is near enough.
fn stand(layout: &Layout, from: Place, to: Place) -> Place {
    let (across, along) = (layout.across, 1 - layout.across);
    let beyond = layout.touch() + SPARE;
    if (to[across] - CENTER).abs() > layout.touch() {
        return to;
    }
    let at = |a: f64, b: f64| if across == 0 { [a, b] } else { [b, a] };
    let faces = [-beyond, beyond].map(|depth| at(CENTER + depth, to[along]));
    let doors = openings(layout).map(|opening| {
        let [first, last] = narrowed(opening, 0.25);
        at(to[across], to[along].clamp(first, last))
    });
    let cost = |place: Place| {
        let apart = (place[0] - to[0]).hypot(place[1] - to[1]);
        let way = length(layout, from, place);
        way.map_or((2, apart), |way| if apart < NEAR { (0, way) } else { (1, apart) })
    };
    let best = faces.into_iter().chain(doors).map(|place| (cost(place), place));
    best.min_by(|((a, b), _), ((c, d), _)| a.cmp(c).then(b.total_cmp(d))).map_or(to, |(_, place)| place)
}

/// Where to head from `from` to get to `to`: the target, the mouth of a door, or the other end of it.
///
/// A function of the two places alone, so whoever follows it may be pushed off the way at any time.
pub fn waypoint(layout: &Layout, from: Place, to: Place) -> Place {
    let to = stand(layout, from, to);
    let (across, along) = (layout.across, 1 - layout.across);
    let touch = layout.touch();
    // Towards the wall is positive: the own room lies below -touch, the other one above touch.
    let outward = if from[across] < CENTER { 1.0 } else { -1.0 };
    let depth = |p: Place| (p[across] - CENTER) * outward;
    let in_wall = |p: Place| depth(p).abs() <= touch;
    let within = |p: Place, [first, last]: [f64; 2]| (first..=last).contains(&p[along]);
    let at = |depth: f64, place: f64| {
        let mut p = [place; 2];
        p[across] = CENTER + depth * outward;
        p
    };
    let leave = |opening: [f64; 2]| {
        let [first, last] = narrowed(opening, 0.5);
        at((touch + STAND_OFF).copysign(depth(to)), to[along].clamp(first, last))
    };
    let home = if in_wall(to) { openings(layout).find(|&opening| within(to, opening)) } else { None };

    if in_wall(from) {
        return match openings(layout).find(|&opening| within(from, opening)) {
            Some(opening) if home != Some(opening) => leave(opening),
            _ => to,
        };
    }
    if depth(to) < -touch {
        return to;
    }
    let door = match home {
        Some(opening) => Some((opening, to[along])),
        None => best_door(layout, from, to).map(|(opening, crossing, _)| (opening, crossing)),
    };
    match door {
        // Nothing to pass through: stay near.
        None => to,
        Some((opening, crossing)) if !within(from, narrowed(opening, 0.5)) => {
            let [first, last] = narrowed(opening, 1.0);
            at(-touch - STAND_OFF, crossing.clamp(first, last))
        }
        Some((opening, _)) => {
            if home.is_some() {
                to
            } else {
                leave(opening)
            }
        }
    }
}
