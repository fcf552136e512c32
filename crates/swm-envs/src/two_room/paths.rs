//! Shortest paths through the doors: their length, and the next waypoint.
//!
//! Rooms are convex, so a shortest path is a straight line, or two lines that meet in a door.

use super::physics::{Layout, WALL_CENTER};
use crate::point_agent::room::GOAL_RADIUS;
use crate::point_agent::{Position64, distance64};

/// Distance that a path keeps from the edges of a door if the door is wide enough, in pixels.
const CLEARANCE: f64 = 3.0;
/// Gap between the agent and the wall at which a path turns into a door, in pixels.
const STAND_OFF: f64 = 1.0;
/// A target counts as reached within this distance, which is a little less than the environment requires, in pixels.
const NEAR: f64 = GOAL_RADIUS as f64 - SPARE;
/// Safety distance against rounding, in pixels.
const SPARE: f64 = 0.05;

/// Returns the part of a door that the agent's centre can reach, if any.
fn usable_opening(layout: &Layout, door: [f64; 2]) -> Option<[f64; 2]> {
    let [low, high] = layout.reach();
    let (first, last) = (door[0].max(low), door[1].min(high));
    (first < last).then_some([first, last])
}

/// Narrows an opening on both sides by `share` of the clearance.
fn narrowed([first, last]: [f64; 2], share: f64) -> [f64; 2] {
    let inset = CLEARANCE.min((last - first) / 4.0) * share;
    [first + inset, last - inset]
}

/// Returns the door of the shortest path between two rooms: its opening, the coordinate along the wall at which the
/// path crosses it, and the length of the path.
fn best_door(layout: &Layout, from: Position64, to: Position64) -> Option<([f64; 2], f64, f64)> {
    let (across, along) = (layout.across, 1 - layout.across);
    let before = (from[across] - WALL_CENTER).abs();
    let after = (to[across] - WALL_CENTER).abs();
    // The coordinate along the wall at which the straight line crosses it. A path crosses each door at the point
    // nearest to this coordinate.
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

/// Returns the length of the shortest path between two positions in pixels, or `None` when no door is passable.
pub fn length(layout: &Layout, from: Position64, to: Position64) -> Option<f64> {
    let side = |p: Position64| p[layout.across] < WALL_CENTER;
    if side(from) == side(to) {
        return Some(distance64(from, to));
    }
    best_door(layout, from, to).map(|(_, _, length)| length)
}

/// Returns the openings of all passable doors.
fn openings(layout: &Layout) -> impl Iterator<Item = [f64; 2]> + use<> {
    let layout = *layout;
    layout.doors.into_iter().filter_map(move |door| usable_opening(&layout, door))
}

/// Returns the end of the path to `to`, which is `to` itself if it lies outside the wall.
///
/// Otherwise the candidates are positions at the wall's faces and in the doors. The result is the candidate within
/// [`NEAR`] of `to` that has the shortest path, or else the reachable candidate nearest to `to`.
fn reachable_end(layout: &Layout, from: Position64, to: Position64) -> Position64 {
    let (across, along) = (layout.across, 1 - layout.across);
    let beyond = layout.contact_depth() + SPARE;
    if (to[across] - WALL_CENTER).abs() > layout.contact_depth() {
        return to;
    }
    let at = |a: f64, b: f64| if across == 0 { [a, b] } else { [b, a] };
    let faces = [-beyond, beyond].map(|depth| at(WALL_CENTER + depth, to[along]));
    let doors = openings(layout).map(|opening| {
        let [first, last] = narrowed(opening, 0.25);
        at(to[across], to[along].clamp(first, last))
    });
    // The order of candidates: reachable and near enough, reachable, unreachable.
    let cost = |end: Position64| {
        let gap = distance64(end, to);
        let length = length(layout, from, end);
        length.map_or((2, gap), |length| if gap < NEAR { (0, length) } else { (1, gap) })
    };
    let best = faces.into_iter().chain(doors).map(|end| (cost(end), end));
    best.min_by(|((a, b), _), ((c, d), _)| a.cmp(c).then(b.total_cmp(d))).map_or(to, |(_, end)| end)
}

/// Returns the next waypoint on the path from `from` to `to`: the target, the near end of a door, or the far end of the
/// door.
///
/// The waypoint depends on the two positions alone, so an agent that noise pushes off the path still gets a valid
/// waypoint.
pub fn waypoint(layout: &Layout, from: Position64, to: Position64) -> Position64 {
    let to = reachable_end(layout, from, to);
    let (across, along) = (layout.across, 1 - layout.across);
    let contact = layout.contact_depth();
    // Depth grows towards the other room: the agent's room lies below -contact, the other room above contact.
    let outward = if from[across] < WALL_CENTER { 1.0 } else { -1.0 };
    let depth = |p: Position64| (p[across] - WALL_CENTER) * outward;
    let in_wall = |p: Position64| depth(p).abs() <= contact;
    let within = |p: Position64, [first, last]: [f64; 2]| (first..=last).contains(&p[along]);
    let at = |depth: f64, along: f64| {
        let mut p = [along; 2];
        p[across] = WALL_CENTER + depth * outward;
        p
    };
    let exit = |opening: [f64; 2]| {
        let [first, last] = narrowed(opening, 0.5);
        at((contact + STAND_OFF).copysign(depth(to)), to[along].clamp(first, last))
    };
    let target_door = if in_wall(to) { openings(layout).find(|&opening| within(to, opening)) } else { None };

    if in_wall(from) {
        return match openings(layout).find(|&opening| within(from, opening)) {
            Some(opening) if target_door != Some(opening) => exit(opening),
            _ => to,
        };
    }
    if depth(to) < -contact {
        return to;
    }
    let door = match target_door {
        Some(opening) => Some((opening, to[along])),
        None => best_door(layout, from, to).map(|(opening, crossing, _)| (opening, crossing)),
    };
    match door {
        // Without a passable door, the agent stays near the wall.
        None => to,
        Some((opening, crossing)) if !within(from, narrowed(opening, 0.5)) => {
            let [first, last] = narrowed(opening, 1.0);
            at(-contact - STAND_OFF, crossing.clamp(first, last))
        }
        Some((opening, _)) => {
            if target_door.is_some() {
                to
            } else {
                exit(opening)
            }
        }
    }
}
