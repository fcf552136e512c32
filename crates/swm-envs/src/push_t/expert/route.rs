//! Ways around the block that do not touch it.

use super::room::Room;
use crate::push_t::physics::Vec2;

/// Pixels that a way keeps from touching the block, where it does not begin or end nearer.
const SPARE: f64 = 3.0;

/// The shortest ways from one place to every other, past corners of obstacles.
pub struct Ways<'a> {
    room: &'a Room,
    /// The start, then the corners a way may pass.
    nodes: Vec<Vec2>,
    /// How far each is from the start, and which comes before it.
    reached: Vec<(f64, usize)>,
}

impl<'a> Ways<'a> {
    /// All ways from a place: Dijkstra over the corners that see each other.
    pub fn from(room: &'a Room, start: Vec2) -> Self {
        let corners = room.obstacles.iter().flat_map(|obstacle| obstacle.around(SPARE + 0.5));
        let mut nodes = vec![start];
        nodes.extend(corners.filter(|&corner| room.holds(corner) && room.clearance(corner) > SPARE));
        let mut reached = vec![(f64::INFINITY, 0); nodes.len()];
        reached[0].0 = 0.0;
        let mut open: Vec<usize> = (0..nodes.len()).collect();
        while let Some(place) = (0..open.len()).min_by(|&a, &b| reached[open[a]].0.total_cmp(&reached[open[b]].0)) {
            let at = open.swap_remove(place);
            if reached[at].0.is_infinite() {
                break;
            }
            for &next in &open {
                let length = reached[at].0 + (nodes[next] - nodes[at]).length();
                if length < reached[next].0 && is_free(room, nodes[at], nodes[next]) {
                    reached[next] = (length, at);
                }
            }
        }
        Self { room, nodes, reached }
    }

    /// The length of the shortest way to a place, and the last node on it; `None` where there is no way.
    pub fn to(&self, place: Vec2) -> Option<(f64, usize)> {
        let mut best: Option<(f64, usize)> = None;
        for (node, (&at, &(length, _))) in self.nodes.iter().zip(&self.reached).enumerate() {
            let length = length + (place - at).length();
            if length.is_finite() && best.is_none_or(|(b, _)| length < b) && is_free(self.room, at, place) {
                best = Some((length, node));
            }
        }
        best
    }

    /// The places to pass on the way to a place by way of a node, the first one last.
    pub fn places(&self, place: Vec2, mut node: usize) -> Vec<Vec2> {
        let mut places = vec![place];
        while node != 0 {
            places.push(self.nodes[node]);
            node = self.reached[node].1;
        }
        places
    }
}

/// Whether one can go straight from place to place. Who already is nearer to an obstacle than a way should be may leave
/// it, but not come nearer.
fn is_free(room: &Room, from: Vec2, to: Vec2) -> bool {
    room.obstacles.iter().all(|obstacle| {
        let margin = SPARE.min(obstacle.clearance(from) - 0.01).min(obstacle.clearance(to) - 0.01);
        !obstacle.blocks(from, to, margin)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ways_lead_around_the_block() {
        let square = [(200.0, 200.0), (300.0, 200.0), (300.0, 300.0), (200.0, 300.0)].map(|(x, y)| Vec2::new(x, y));
        let agent: Vec<Vec2> =
            [(-15.0, -15.0), (15.0, -15.0), (15.0, 15.0), (-15.0, 15.0)].map(|(x, y)| Vec2::new(x, y)).to_vec();
        let room = Room::new(&[agent], &[square]);
        let (from, to) = (Vec2::new(150.0, 250.0), Vec2::new(350.0, 250.0));
        let ways = Ways::from(&room, from);
        let (length, node) = ways.to(to).expect("a way");
        let places = ways.places(to, node);
        assert!(places.len() == 3 && places[0] == to, "past two corners: {places:?}");
        let mut at = from;
        let mut walked = 0.0;
        for &next in places.iter().rev() {
            for k in 0..=20 {
                assert!(room.clearance(at.lerp(next, f64::from(k) / 20.0)) > SPARE - 0.1);
            }
            walked += (next - at).length();
            at = next;
        }
        assert!((walked - length).abs() < 1e-9);
        // Straight ahead where nothing is between, away from the block where the agent touches it, and not through it.
        let (_, node) = ways.to(Vec2::new(150.0, 50.0)).expect("a way");
        assert_eq!(node, 0);
        let touching = Ways::from(&room, Vec2::new(186.0, 250.0));
        assert_eq!(touching.to(from).expect("a way").1, 0);
        assert!(touching.to(to).expect("a way").0 > 250.0);
    }
}
