//! [`BoundsTree`]: a binary tree of bounding boxes for finding pairs of shapes that may touch.
//!
//! The order in which pairs are found decides the order in which contacts are solved, and with it the last digits of
//! every trajectory. The tree is therefore built exactly as Chipmunk's (`cpBBTree.c`): a leaf is inserted where the
//! areas of the boxes grow least, and moves only when its shape leaves a box that was widened by its velocity.

use super::bounds::Bounds;
use super::vec2::Vec2;
use bytemuck::{Pod, Zeroable};

/// Marks the absence of a node where an index of a node is stored.
pub const NONE: u32 = u32::MAX;

/// A leaf (the first nodes of a tree, one per shape) or an inner node with two children.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub struct Node {
    /// The bounding box of all leaves below.
    pub bounds: Bounds,
    /// The parent, or [`NONE`].
    pub parent: u32,
    /// The children of an inner node.
    pub children: [u32; 2],
    /// The stamp of the last insertion of a leaf.
    pub stamp: u32,
}

/// A tree of the bounding boxes of a fixed set of shapes.
#[derive(Clone, Debug)]
pub struct BoundsTree {
    /// Leaves, then inner nodes.
    pub nodes: Vec<Node>,
    /// The root, or [`NONE`].
    pub root: u32,
    /// The number of leaves.
    pub leaves: u32,
    /// An unused inner node, or [`NONE`]: removing a leaf frees an inner node, inserting the leaf again uses it.
    pub spare: u32,
}

impl BoundsTree {
    /// Makes an empty tree for `leaves` shapes.
    pub fn new(leaves: usize) -> Self {
        let leaf = Node { bounds: Bounds::default(), parent: NONE, children: [NONE; 2], stamp: 0 };
        let mut nodes = Vec::with_capacity(2 * leaves);
        nodes.resize(leaves, leaf);
        Self { nodes, root: NONE, leaves: leaves as u32, spare: NONE }
    }

    /// Returns whether a node is a leaf.
    pub fn is_leaf(&self, node: u32) -> bool {
        node < self.leaves
    }

    /// Returns a node.
    pub fn node(&self, node: u32) -> &Node {
        &self.nodes[node as usize]
    }

    fn node_mut(&mut self, node: u32) -> &mut Node {
        &mut self.nodes[node as usize]
    }

    fn bounds(&self, node: u32) -> Bounds {
        self.node(node).bounds
    }

    /// Inserts a leaf with these bounds.
    pub fn insert(&mut self, leaf: u32, bounds: Bounds, stamp: u32) {
        *self.node_mut(leaf) = Node { bounds, parent: NONE, children: [NONE; 2], stamp };
        if self.root == NONE {
            self.root = leaf;
            return;
        }
        let mut at = self.root;
        while !self.is_leaf(at) {
            let [a, b] = self.node(at).children;
            let (box_a, box_b) = (self.bounds(a), self.bounds(b));
            let mut cost_a = box_b.area() + box_a.merged(bounds).area();
            let mut cost_b = box_a.area() + box_b.merged(bounds).area();
            if cost_a == cost_b {
                cost_a = box_a.proximity(&bounds);
                cost_b = box_b.proximity(&bounds);
            }
            at = if cost_b < cost_a { b } else { a };
        }
        let parent = self.node(at).parent;
        let joint = self.join(leaf, at);
        if parent == NONE {
            self.root = joint;
        } else {
            self.replace_child(parent, at, joint);
            let mut up = parent;
            while up != NONE {
                let node = self.node_mut(up);
                node.bounds = node.bounds.merged(bounds);
                up = node.parent;
            }
        }
    }

    /// Removes a leaf.
    pub fn remove(&mut self, leaf: u32) {
        let parent = self.node(leaf).parent;
        if parent == NONE {
            self.root = NONE;
            return;
        }
        let [a, b] = self.node(parent).children;
        let sibling = if a == leaf { b } else { a };
        let grandparent = self.node(parent).parent;
        self.node_mut(sibling).parent = grandparent;
        self.spare = parent;
        if grandparent == NONE {
            self.root = sibling;
            return;
        }
        self.replace_child(grandparent, parent, sibling);
        let mut up = grandparent;
        while up != NONE {
            let [a, b] = self.node(up).children;
            let bounds = self.bounds(a).merged(self.bounds(b));
            let node = self.node_mut(up);
            node.bounds = bounds;
            up = node.parent;
        }
    }

    /// Calls `found` for the leaves below `from` whose boxes touch `bounds`, depth first, first children first.
    pub fn query(&self, from: u32, bounds: &Bounds, mut found: impl FnMut(u32)) {
        let mut stack = Stack::of(from);
        while let Some(at) = stack.pop() {
            let node = self.node(at);
            if !node.bounds.intersects(bounds) {
                continue;
            }
            if self.is_leaf(at) {
                found(at);
            } else {
                stack.push(node.children[1]);
                stack.push(node.children[0]);
            }
        }
    }

    /// Calls `found` for every leaf, depth first, first children first.
    pub fn each_leaf(&self, mut found: impl FnMut(u32)) {
        let mut stack = Stack::of(self.root);
        while let Some(at) = stack.pop() {
            if self.is_leaf(at) {
                found(at);
            } else {
                let [a, b] = self.node(at).children;
                stack.push(b);
                stack.push(a);
            }
        }
    }

    fn join(&mut self, a: u32, b: u32) -> u32 {
        let bounds = self.bounds(a).merged(self.bounds(b));
        let node = Node { bounds, parent: NONE, children: [a, b], stamp: 0 };
        let at = if self.spare == NONE {
            self.nodes.push(node);
            self.nodes.len() as u32 - 1
        } else {
            let at = std::mem::replace(&mut self.spare, NONE);
            *self.node_mut(at) = node;
            at
        };
        self.node_mut(a).parent = at;
        self.node_mut(b).parent = at;
        at
    }

    fn replace_child(&mut self, parent: u32, child: u32, with: u32) {
        let children = &mut self.node_mut(parent).children;
        children[usize::from(children[0] != child)] = with;
        self.node_mut(with).parent = parent;
    }
}

/// Returns the box of a moving shape, widened so that the shape stays inside for some steps.
pub fn widened(bounds: Bounds, velocity: Vec2) -> Bounds {
    // A single-precision constant in Chipmunk, whose rounding decides ties between boxes.
    const MARGIN_FRACTION: f64 = 0.1f32 as f64;
    let margin = (bounds.high - bounds.low) * MARGIN_FRACTION;
    let ahead = velocity * MARGIN_FRACTION;
    Bounds {
        low: bounds.low + Vec2::new((-margin.x).min(ahead.x), (-margin.y).min(ahead.y)),
        high: bounds.high + Vec2::new(margin.x.max(ahead.x), margin.y.max(ahead.y)),
    }
}

/// The nodes that a traversal has yet to visit. The capacity suffices for a tree of a dozen leaves.
struct Stack {
    nodes: [u32; 16],
    len: usize,
}

impl Stack {
    fn of(node: u32) -> Self {
        let mut stack = Self { nodes: [NONE; 16], len: 0 };
        if node != NONE {
            stack.push(node);
        }
        stack
    }

    fn push(&mut self, node: u32) {
        self.nodes[self.len] = node;
        self.len += 1;
    }

    fn pop(&mut self) -> Option<u32> {
        self.len = self.len.checked_sub(1)?;
        Some(self.nodes[self.len])
    }
}
