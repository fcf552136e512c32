//! Ways around the block that do not touch it.

use crate::push_t::TABLE;
use crate::push_t::physics::Vec2;

/// How many places around the block a way may pass.
const RING: usize = 16;
/// Pixels that a way keeps from the block, and from the edge of the table.
const SPARE: f64 = 2.0;
const EDGE: f64 = 22.0;
/// Pixels between two looks along a line.
const LOOK: f64 = 5.0;
/// So near to where a way starts, nothing is looked at: the agent may just have pushed.
const START: f64 = 10.0;

/// How far a place is from the nearest rectangle, 0 inside.
pub fn clearance(rects: &[[Vec2; 4]], place: Vec2) -> f64 {
    rects.iter().map(|rect| distance(rect, place)).fold(f64::INFINITY, f64::min)
}

fn distance(rect: &[Vec2; 4], place: Vec2) -> f64 {
    let (along, across) = (rect[1] - rect[0], rect[3] - rect[0]);
    let outside = |axis: Vec2| {
        let length = axis.length();
        let at = (place - rect[0]).dot(axis) / length;
        (at - at.clamp(0.0, length)).abs()
    };
    outside(along).hypot(outside(across))
}

/// The shortest way for an agent of this radius, as the places to pass, the first one last. Where there is none, the
/// straight line.
pub fn route(rects: &[[Vec2; 4]], radius: f64, from: Vec2, to: Vec2) -> Vec<Vec2> {
    let free = |a: Vec2, b: Vec2| {
        let length = (b - a).length();
        let mut at = if a == from { START } else { 0.0 };
        while at < length {
            if clearance(rects, a.lerp(b, at / length)) < radius + SPARE {
                return false;
            }
            at += LOOK;
        }
        true
    };
    if free(from, to) {
        return vec![to];
    }
    // Dijkstra over a ring of places around the block, with the start as node 0 and the end as node 1.
    let corners = || rects.iter().flatten().copied();
    #[allow(clippy::cast_precision_loss)]
    let centre = corners().fold(Vec2::ZERO, |sum, corner| sum + corner) * (1.0 / (4 * rects.len()).max(1) as f64);
    let around = corners().map(|corner| (corner - centre).length()).fold(0.0, f64::max) + radius + 3.0 * SPARE;
    let mut nodes = vec![from, to];
    nodes.extend((0..RING).map(|i| {
        #[allow(clippy::cast_precision_loss)]
        let angle = i as f64 * std::f64::consts::TAU / RING as f64;
        let place = centre + Vec2::new(angle.cos(), angle.sin()) * around;
        Vec2::new(place.x.clamp(EDGE, TABLE - EDGE), place.y.clamp(EDGE, TABLE - EDGE))
    }));
    let mut best = vec![(f64::INFINITY, 0); nodes.len()];
    let mut done = vec![false; nodes.len()];
    best[0].0 = 0.0;
    while let Some(at) = (0..nodes.len()).filter(|&i| !done[i]).min_by(|&a, &b| best[a].0.total_cmp(&best[b].0)) {
        if best[at].0.is_infinite() || at == 1 {
            break;
        }
        done[at] = true;
        for next in 1..nodes.len() {
            let length = best[at].0 + (nodes[next] - nodes[at]).length();
            if !done[next] && length < best[next].0 && free(nodes[at], nodes[next]) {
                best[next] = (length, at);
            }
        }
    }
    let mut way = vec![to];
    let mut at = 1;
    while best[1].0.is_finite() && best[at].1 != 0 {
        at = best[at].1;
        way.push(nodes[at]);
    }
    way
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ways_lead_around_the_block() {
        let square = [(200.0, 200.0), (300.0, 200.0), (300.0, 300.0), (200.0, 300.0)].map(|(x, y)| Vec2::new(x, y));
        let (from, to) = (Vec2::new(150.0, 250.0), Vec2::new(350.0, 250.0));
        let way = route(&[square], 15.0, from, to);
        assert!(way.len() > 1 && way[0] == to);
        let mut at = from;
        for &next in way.iter().rev() {
            for k in 0..=20 {
                assert!(clearance(&[square], at.lerp(next, f64::from(k) / 20.0)) > 14.0);
            }
            at = next;
        }
        assert_eq!(route(&[square], 15.0, from, Vec2::new(150.0, 50.0)).len(), 1);
    }
}
