//! The broad phase: finds the pairs of shapes that may touch, in the order of Chipmunk.

use super::bounds_tree::{NONE, widened};
use super::simulation::Simulation;
use bytemuck::{Pod, Zeroable};

/// The maximal number of moving shapes, and of neighbours of one shape.
const MAX_SHAPES: usize = 16;

/// Two shapes whose widened bounding boxes touch, in the order in which they were found.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub struct CandidatePair {
    a: u32,
    b: u32,
    /// The hint with which the contact search starts.
    hint: u32,
}

impl Simulation {
    /// Updates shapes and trees, and finds all contacts.
    pub(super) fn find_contacts(&mut self) {
        let walls = self.walls();
        for i in walls..self.shapes.len() as u32 {
            self.update_shape(i);
        }
        for i in 0..self.order.len() {
            let leaf = self.order[i];
            let bounds = self.shapes[(leaf + walls) as usize].bounds;
            if !self.tree.node(leaf).bounds.contains(&bounds) {
                let velocity = self.velocity_of(leaf + walls);
                self.tree.remove(leaf);
                self.tree.insert(leaf, widened(bounds, velocity), self.tree_stamp);
                let shape = leaf + walls;
                self.pairs.retain(|pair| pair.a != shape && pair.b != shape);
            }
        }
        let mut leaves = [NONE; MAX_SHAPES];
        let mut count = 0;
        self.tree.each_leaf(|leaf| {
            leaves[count] = leaf;
            count += 1;
        });
        for &leaf in &leaves[..count] {
            self.update_pairs(leaf, true);
        }
        self.tree_stamp += 1;
    }

    /// Finds the contacts of a leaf's pairs, if `collide` is set. If the leaf has moved within the tree in this step,
    /// its pairs are found first.
    pub(super) fn update_pairs(&mut self, leaf: u32, collide: bool) {
        let walls = self.walls();
        let shape = leaf + walls;
        if self.tree.node(leaf).stamp != self.tree_stamp {
            for i in (0..self.pairs.len()).rev() {
                let CandidatePair { a, b, hint } = self.pairs[i];
                if b == shape {
                    self.pairs[i].hint = self.collide(a, shape, hint);
                }
            }
            return;
        }
        let mut found = Neighbours::default();
        let bounds = self.tree.node(leaf).bounds;
        self.static_tree.query(self.static_tree.root, &bounds, |wall| found.push(wall, true, false));
        let mut at = leaf;
        while self.tree.node(at).parent != NONE {
            let parent = self.tree.node(at).parent;
            let [first, second] = self.tree.node(parent).children;
            if at == first {
                self.tree.query(second, &bounds, |other| found.push(other + walls, true, true));
            } else {
                self.tree.query(first, &bounds, |other| {
                    let older = self.tree.node(other).stamp < self.tree.node(leaf).stamp;
                    found.push(other + walls, older, false);
                });
            }
            at = parent;
        }
        for &Neighbour { shape: other, becomes_pair, comes_second } in found.as_slice() {
            if becomes_pair {
                let (a, b) = if comes_second { (shape, other) } else { (other, shape) };
                self.pairs.push(CandidatePair { a, b, hint: 0 });
            }
            if collide && !comes_second {
                self.collide(shape, other, 0);
            }
        }
    }
}

/// A shape whose bounding box touches that of the queried shape.
#[derive(Clone, Copy, Default)]
struct Neighbour {
    shape: u32,
    /// True if the queried shape and the neighbour become a new pair.
    becomes_pair: bool,
    /// True if the neighbour is the second shape of the pair. The contacts of the pair are then found when the
    /// neighbour is updated.
    comes_second: bool,
}

/// The neighbours of a shape, in the order of the search.
#[derive(Default)]
struct Neighbours {
    neighbours: [Neighbour; MAX_SHAPES],
    len: usize,
}

impl Neighbours {
    fn push(&mut self, shape: u32, becomes_pair: bool, comes_second: bool) {
        self.neighbours[self.len] = Neighbour { shape, becomes_pair, comes_second };
        self.len += 1;
    }

    fn as_slice(&self) -> &[Neighbour] {
        &self.neighbours[..self.len]
    }
}
