//! [`ShortestPaths`]: paths of the agent around the block.

use super::configuration_space::ConfigurationSpace;
use crate::push_t::physics::Vec2;

/// Distance that a path keeps from touching the block, unless it starts or ends nearer, in pixels.
const SPARE: f64 = 3.0;

/// The shortest paths from one point to every other point, around the corners of obstacles.
pub struct ShortestPaths<'a> {
    space: &'a ConfigurationSpace,
    /// The start, then the corners that a path may pass.
    nodes: Vec<Vec2>,
    /// For each node the length of the path to it, in pixels, and the node before it.
    reached: Vec<(f64, usize)>,
}

impl<'a> ShortestPaths<'a> {
    /// Finds all paths from a point, by Dijkstra's algorithm on the visibility graph of the corners.
    pub fn from(space: &'a ConfigurationSpace, start: Vec2) -> Self {
        let corners = space.obstacles.iter().flat_map(|obstacle| obstacle.around(SPARE + 0.5));
        let mut nodes = vec![start];
        nodes.extend(corners.filter(|&corner| space.contains(corner) && space.clearance(corner) > SPARE));
        let mut reached = vec![(f64::INFINITY, 0); nodes.len()];
        reached[0].0 = 0.0;
        let mut open: Vec<usize> = (0..nodes.len()).collect();
        while let Some(nearest) = (0..open.len()).min_by(|&a, &b| reached[open[a]].0.total_cmp(&reached[open[b]].0)) {
            let at = open.swap_remove(nearest);
            if reached[at].0.is_infinite() {
                break;
            }
            for &next in &open {
                let length = reached[at].0 + (nodes[next] - nodes[at]).length();
                if length < reached[next].0 && is_free(space, nodes[at], nodes[next]) {
                    reached[next] = (length, at);
                }
            }
        }
        Self { space, nodes, reached }
    }

    /// Returns the length of the shortest path to a point and the last node on it, or `None` if there is no path.
    pub fn to(&self, end: Vec2) -> Option<(f64, usize)> {
        let mut best: Option<(f64, usize)> = None;
        for (node, (&at, &(length, _))) in self.nodes.iter().zip(&self.reached).enumerate() {
            let length = length + (end - at).length();
            if length.is_finite() && best.is_none_or(|(b, _)| length < b) && is_free(self.space, at, end) {
                best = Some((length, node));
            }
        }
        best
    }

    /// Returns the waypoints of the path to a point by way of a node, in reverse order.
    pub fn waypoints(&self, end: Vec2, mut node: usize) -> Vec<Vec2> {
        let mut waypoints = vec![end];
        while node != 0 {
            waypoints.push(self.nodes[node]);
            node = self.reached[node].1;
        }
        waypoints
    }
}

/// Returns whether the straight path between two points is free. The required distance from an obstacle is at most that
/// of the ends, so that an agent near the obstacle can leave it.
fn is_free(space: &ConfigurationSpace, from: Vec2, to: Vec2) -> bool {
    space.obstacles.iter().all(|obstacle| {
        let margin = SPARE.min(obstacle.clearance(from) - 0.01).min(obstacle.clearance(to) - 0.01);
        !obstacle.blocks(from, to, margin)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_lead_around_the_block() {
        let square = [(200.0, 200.0), (300.0, 200.0), (300.0, 300.0), (200.0, 300.0)].map(|(x, y)| Vec2::new(x, y));
        let agent: Vec<Vec2> =
            [(-15.0, -15.0), (15.0, -15.0), (15.0, 15.0), (-15.0, 15.0)].map(|(x, y)| Vec2::new(x, y)).to_vec();
        let space = ConfigurationSpace::new(&[agent], &[square]);
        let (from, to) = (Vec2::new(150.0, 250.0), Vec2::new(350.0, 250.0));
        let paths = ShortestPaths::from(&space, from);
        let (length, node) = paths.to(to).expect("finding a path");
        let waypoints = paths.waypoints(to, node);
        assert!(waypoints.len() == 3 && waypoints[0] == to, "past two corners: {waypoints:?}");
        let mut at = from;
        let mut walked = 0.0;
        for &next in waypoints.iter().rev() {
            for k in 0..=20 {
                assert!(space.clearance(at.lerp(next, f64::from(k) / 20.0)) > SPARE - 0.1);
            }
            walked += (next - at).length();
            at = next;
        }
        assert!((walked - length).abs() < 1e-9);
        // A path is straight if nothing is between its ends, leads away from a block that the agent touches, and never
        // leads through the block.
        let (_, node) = paths.to(Vec2::new(150.0, 50.0)).expect("finding a path");
        assert_eq!(node, 0);
        let touching = ShortestPaths::from(&space, Vec2::new(186.0, 250.0));
        assert_eq!(touching.to(from).expect("finding a path").1, 0);
        assert!(touching.to(to).expect("finding a path").0 > 250.0);
    }
}
