//! The steps that were played, with snapshots: a tree, because a page goes back and on from any step with something else.

use serde::Serialize;
use std::collections::BTreeMap;
use swm_core::{Error, Result, Snapshot};

/// The largest number of steps.
pub const MOST_NODES: usize = 4_000;
/// The largest size of all snapshots and plans, in bytes.
pub const MOST_BYTES: usize = 64 << 20;
/// What a step takes beside its snapshot and its plan, about.
const NODE_BYTES: usize = 256;

/// A step.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Node {
    /// The id; later steps have larger ones.
    pub id: usize,
    /// The step before it; `None` for the first.
    pub parent: Option<usize>,
    /// The branch: the first child of a step is of its branch, another one begins a branch.
    pub branch: usize,
    /// Steps of the episode so far.
    pub step: usize,
    /// The reward of the step to it.
    pub reward: f64,
    /// The sum of all rewards.
    pub total: f64,
    /// The distance to the goal.
    pub distance: f64,
    /// Whether the goal is reached.
    pub success: bool,
    /// Whether the episode has ended.
    pub ended: bool,
    /// The cost of the plan that was made here.
    pub cost: Option<f32>,
    /// What was changed for the step to it, if anything was.
    pub change: Option<String>,
    /// Its positions on the frame, in fractions of the sides.
    pub at: Vec<[f32; 2]>,
}

/// A step with what it takes to continue from it.
struct Kept {
    node: Node,
    snapshot: Snapshot,
    plan: Option<String>,
}

impl Kept {
    fn bytes(&self) -> usize {
        NODE_BYTES + self.snapshot.0.len() + self.plan.as_ref().map_or(0, String::len)
    }
}

/// The steps.
pub struct Tree {
    all: BTreeMap<usize, Kept>,
    present: usize,
    next: usize,
    branches: usize,
    bytes: usize,
}

impl Tree {
    /// A tree of one step. Its id is new.
    pub fn new(root: Node, snapshot: Snapshot, id: usize) -> Self {
        let mut tree = Self { all: BTreeMap::new(), present: id, next: id, branches: 0, bytes: 0 };
        tree.insert(Node { parent: None, ..root }, snapshot);
        tree
    }

    /// The id that the next step gets.
    pub fn next(&self) -> usize {
        self.next
    }

    fn insert(&mut self, node: Node, snapshot: Snapshot) {
        let kept = Kept { node: Node { id: self.next, ..node }, snapshot, plan: None };
        self.bytes += kept.bytes();
        self.all.insert(self.next, kept);
        self.present = self.next;
        self.next += 1;
    }

    /// Checks that there is room for another step.
    ///
    /// # Errors
    /// When the tree is full.
    pub fn check_room(&self) -> Result<()> {
        if self.all.len() < MOST_NODES && self.bytes < MOST_BYTES {
            return Ok(());
        }
        let problem = format!("it has {} steps of {} MiB, the most that it may have", self.all.len(), self.bytes >> 20);
        Err(Error::config("the tree of steps", problem, "keep this branch only, or reset"))
    }

    /// Adds a step after the present one, and goes there.
    ///
    /// # Errors
    /// When the tree is full.
    pub fn add(&mut self, node: Node, snapshot: Snapshot) -> Result<&Node> {
        self.check_room()?;
        let parent = self.present;
        let branch = if self.all.values().any(|kept| kept.node.parent == Some(parent)) {
            self.branches += 1;
            self.branches
        } else {
            self.node().branch
        };
        self.insert(Node { parent: Some(parent), branch, ..node }, snapshot);
        Ok(self.node())
    }

    fn kept(&self, id: usize) -> Result<&Kept> {
        let unknown =
            || Error::config("a step", format!("the tree has no step {id}"), "choose one that the page shows");
        self.all.get(&id).ok_or_else(unknown)
    }

    /// Goes to a step.
    ///
    /// # Errors
    /// When there is no such step.
    pub fn go(&mut self, id: usize) -> Result<()> {
        self.kept(id)?;
        self.present = id;
        Ok(())
    }

    /// The present step.
    pub fn node(&self) -> &Node {
        &self.all[&self.present].node
    }

    /// The snapshot of the present step.
    pub fn snapshot(&self) -> &Snapshot {
        &self.all[&self.present].snapshot
    }

    /// The snapshot of a step.
    ///
    /// # Errors
    /// When there is no such step.
    pub fn snapshot_of(&self, id: usize) -> Result<&Snapshot> {
        Ok(&self.kept(id)?.snapshot)
    }

    /// The plan that was made at the present step, as JSON.
    pub fn plan(&self) -> Option<&str> {
        self.all[&self.present].plan.as_deref()
    }

    /// Stores the plan that was made at the present step, as JSON. A full tree does not store it.
    pub fn set_plan(&mut self, plan: &str, cost: Option<f32>) {
        let Some(kept) = self.all.get_mut(&self.present) else { return };
        kept.node.cost = cost;
        self.bytes -= kept.plan.take().map_or(0, |plan| plan.len());
        if self.bytes + plan.len() < MOST_BYTES {
            self.bytes += plan.len();
            kept.plan = Some(plan.to_owned());
        }
    }

    /// Forgets all steps that do not lead to the present one.
    pub fn forget_others(&mut self) {
        let mut path = vec![self.present];
        while let Some(parent) = path.last().and_then(|id| self.all.get(id)).and_then(|kept| kept.node.parent) {
            path.push(parent);
        }
        self.all.retain(|id, _| path.contains(id));
        self.bytes = self.all.values().map(Kept::bytes).sum();
    }

    /// All steps.
    pub fn nodes(&self) -> Vec<Node> {
        self.all.values().map(|kept| kept.node.clone()).collect()
    }

    /// The size of all snapshots and plans, in bytes.
    pub fn bytes(&self) -> usize {
        self.bytes
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn snapshot(size: usize) -> Snapshot {
        Snapshot(vec![7; size])
    }

    #[test]
    fn branches_are_numbered_and_forgotten() {
        let mut tree = Tree::new(Node::default(), snapshot(10), 0);
        for _ in 0..3 {
            tree.add(Node::default(), snapshot(10)).expect("room");
        }
        tree.go(1).expect("a step");
        let added = tree.add(Node::default(), snapshot(10)).expect("room");
        assert_eq!((added.id, added.branch), (4, 1));
        tree.add(Node::default(), snapshot(10)).expect("room");
        assert_eq!(tree.node().branch, 1);
        assert!(tree.go(99).is_err() && tree.snapshot_of(99).is_err());
        tree.set_plan("{}", Some(1.0));
        assert_eq!((tree.plan(), tree.node().cost), (Some("{}"), Some(1.0)));
        tree.forget_others();
        assert_eq!(tree.nodes().iter().map(|node| node.id).collect::<Vec<_>>(), [0, 1, 4, 5]);
        assert_eq!(tree.bytes(), 4 * (NODE_BYTES + 10) + 2);
        assert_eq!(tree.next(), 6);
    }

    #[test]
    fn a_full_tree_says_what_to_do() {
        let mut tree = Tree::new(Node::default(), snapshot(0), 0);
        for _ in 1..MOST_NODES {
            tree.add(Node::default(), snapshot(0)).expect("room");
        }
        let message = tree.add(Node::default(), snapshot(0)).expect_err("no room").to_string();
        assert!(message.contains("keep this branch only"), "{message}");
        let mut tree = Tree::new(Node::default(), snapshot(MOST_BYTES), 0);
        assert!(tree.add(Node::default(), snapshot(0)).is_err());
        tree.set_plan("{}", None);
        assert_eq!(tree.plan(), None, "a full tree stores no plan");
    }
}
