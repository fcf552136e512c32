//! A small rigid-body solver with the semantics of Chipmunk 7 as pymunk 7 runs it, because datasets and published
//! checkpoints depend on them: two bodies (the agent and the block) between four walls, no gravity, no friction,
//! no bounce, and a damping that stops everything between two steps.
//!
//! A [`World::step`] moves the bodies with the velocities of the last step, finds contacts ([`tree`] says which
//! pairs and in which order, [`collide`] where they touch), and solves for the velocities that part what overlaps
//! with a few rounds of sequential impulses, started from the impulses of the same contacts one step before.

mod body;
mod bounds;
mod collide;
mod shape;
mod snapshot;
mod tree;
mod vec2;

pub use body::{Body, Pose};
pub use bounds::Bounds;
pub use shape::Shape;
pub use snapshot::{put, take_array};
pub use vec2::Vec2;

use bytemuck::{Pod, Zeroable};
use tree::{NONE, Tree};

/// The place of the agent among the bodies.
pub const AGENT: usize = 0;
/// The place of the block among the bodies.
pub const BLOCK: usize = 1;
/// The place of what never moves among the bodies.
pub const WALLS: usize = 2;

/// Seconds of one physics step (reference: env.py).
pub const DT: f64 = 0.01;
/// Rounds of sequential impulses (Chipmunk's default).
const ITERATIONS: usize = 10;
/// Overlap that is left alone, in pixels (Chipmunk's default, a single-precision constant there).
const SLOP: f64 = 0.1f32 as f64;
/// The share of an overlap that is left after a 60th of a second (Chipmunk's default, single precision there).
const OVERLAP_LEFT: f64 = (1.0f32 - 0.1f32) as f64;
/// Steps for which the impulses of a vanished contact are remembered (Chipmunk's default).
const PERSISTENCE: u32 = 3;

/// A point where two shapes touch.
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
#[repr(C)]
pub struct Contact {
    /// From the centres of gravity of both bodies to the surfaces of their shapes.
    pub arms: [Vec2; 2],
    /// By which it is known again in the next step.
    pub hash: u64,
    /// What has been pressed so far.
    pub impulse: f64,
    /// What has been pushed apart so far, in this step.
    push: f64,
    /// The speed at which overlap goes away.
    push_speed: f64,
    /// Mass that an impulse along the normal moves.
    mass: f64,
}

/// What two touching shapes remember of each other.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub struct Arbiter {
    /// From the first shape to the second.
    pub normal: Vec2,
    contacts: [Contact; 2],
    count: u32,
    /// The shapes.
    shapes: [u32; 2],
    /// Their bodies.
    bodies: [u32; 2],
    /// The last step in which they touched.
    stamp: u32,
    /// Whether they did not touch the step before: nothing to start from.
    fresh: u32,
    /// Whether they touched once and do not any more.
    parted: u32,
}

impl Arbiter {
    /// The points where they touch.
    pub fn contacts(&self) -> &[Contact] {
        &self.contacts[..self.count as usize]
    }

    /// The bodies that touch.
    pub fn bodies(&self) -> [usize; 2] {
        [self.bodies[0] as usize, self.bodies[1] as usize]
    }
}

/// Two shapes whose wide boxes touch, the first found first.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
struct Pair {
    a: u32,
    b: u32,
    /// Where the contact search may start.
    hint: u32,
}

/// The agent, the block and the walls.
#[derive(Clone, Debug)]
pub struct World {
    /// Agent, block, walls.
    pub bodies: [Body; 3],
    /// Walls first, then the agent's, then the block's.
    pub shapes: Vec<Shape>,
    /// Where the walls are; built once.
    static_tree: Tree,
    /// Where everything else is.
    tree: Tree,
    /// The order in which moving shapes are looked at.
    order: Vec<u32>,
    pairs: Vec<Pair>,
    arbiters: Vec<Arbiter>,
    /// The arbiters of the last step, in solving order.
    active: Vec<u32>,
    /// Counts steps and changes of the trees.
    tree_stamp: u32,
    /// Counts steps.
    stamp: u32,
    /// The share of an overlap that one step takes away.
    push_share: f64,
}

impl World {
    /// A world of these bodies and shapes; the first `walls` shapes never move.
    pub fn new(agent: Body, block: Body, shapes: Vec<Shape>, walls: usize) -> Self {
        let fixed = Body::new(f64::INFINITY, f64::INFINITY, Vec2::ZERO);
        let moving = shapes.len() - walls;
        let mut world = Self {
            bodies: [agent, block, fixed],
            static_tree: Tree::new(walls),
            tree: Tree::new(moving),
            order: visiting_order(walls, moving).into_iter().map(|leaf| leaf as u32).collect(),
            pairs: Vec::with_capacity(shapes.len() * shapes.len()),
            arbiters: Vec::with_capacity(shapes.len() * shapes.len()),
            active: Vec::with_capacity(shapes.len() * shapes.len()),
            shapes,
            tree_stamp: 0,
            stamp: 0,
            push_share: 1.0 - OVERLAP_LEFT.powf(60.0).powf(DT),
        };
        #[allow(clippy::cast_possible_truncation)]
        for i in 0..world.shapes.len() as u32 {
            world.update_shape(i);
            let bounds = world.shapes[i as usize].bounds;
            if (i as usize) < walls {
                world.static_tree.insert(i, bounds, world.tree_stamp);
            } else {
                let leaf = i - walls as u32;
                let velocity = world.velocity_of(i);
                world.tree.insert(leaf, tree::widened(bounds, velocity), world.tree_stamp);
                world.visit(leaf, false);
            }
            world.tree_stamp += 1;
        }
        world
    }

    /// Becomes like another world of the same shapes, without allocating.
    pub fn copy_from(&mut self, other: &Self) {
        self.bodies = other.bodies;
        self.shapes.clone_from(&other.shapes);
        self.tree.nodes.clone_from(&other.tree.nodes);
        (self.tree.root, self.tree.spare) = (other.tree.root, other.tree.spare);
        self.pairs.clone_from(&other.pairs);
        self.arbiters.clone_from(&other.arbiters);
        self.active.clone_from(&other.active);
        (self.tree_stamp, self.stamp) = (other.tree_stamp, other.stamp);
    }

    /// Lets [`DT`] seconds pass.
    pub fn step(&mut self) {
        self.stamp += 1;
        self.forget();
        self.bodies[AGENT].integrate_position(DT);
        self.bodies[BLOCK].integrate_position(DT);
        self.find_contacts();
        self.prepare();
        for body in &mut self.bodies[..WALLS] {
            // Damping 0: what was moving stands, until contacts move it.
            if body.is_dynamic() {
                body.velocity = Vec2::ZERO;
                body.spin = 0.0;
            }
        }
        self.warm_start();
        for _ in 0..ITERATIONS {
            self.solve();
        }
    }

    /// The arbiters of the last step, in solving order.
    pub fn touching(&self) -> impl Iterator<Item = &Arbiter> {
        self.active.iter().map(|&i| &self.arbiters[i as usize])
    }

    /// How many contacts the last step had.
    pub fn contacts(&self) -> usize {
        self.touching().map(|arbiter| arbiter.contacts().len()).sum()
    }

    /// Drops what two shapes knew of each other when they have not touched for a while.
    fn forget(&mut self) {
        for &i in &self.active {
            self.arbiters[i as usize].fresh = 0;
        }
        self.active.clear();
        let before = self.stamp - 1;
        self.arbiters.retain_mut(|arbiter| {
            let age = before - arbiter.stamp;
            arbiter.parted |= u32::from(age >= 1);
            age < PERSISTENCE
        });
    }

    fn find_contacts(&mut self) {
        let walls = self.walls();
        #[allow(clippy::cast_possible_truncation)]
        for i in walls..self.shapes.len() as u32 {
            self.update_shape(i);
        }
        for i in 0..self.order.len() {
            let leaf = self.order[i];
            let bounds = self.shapes[(leaf + walls) as usize].bounds;
            if !self.tree.node(leaf).bounds.contains(&bounds) {
                let velocity = self.velocity_of(leaf + walls);
                self.tree.remove(leaf);
                self.tree.insert(leaf, tree::widened(bounds, velocity), self.tree_stamp);
                let shape = leaf + walls;
                self.pairs.retain(|pair| pair.a != shape && pair.b != shape);
            }
        }
        let mut leaves = [NONE; 16];
        let mut count = 0;
        self.tree.each_leaf(|leaf| {
            leaves[count] = leaf;
            count += 1;
        });
        for &leaf in &leaves[..count] {
            self.visit(leaf, true);
        }
        self.tree_stamp += 1;
    }

    /// Finds the pairs of a leaf, anew if it has moved within the tree, and their contacts where asked.
    fn visit(&mut self, leaf: u32, collide: bool) {
        let walls = self.walls();
        let shape = leaf + walls;
        if self.tree.node(leaf).stamp != self.tree_stamp {
            for i in (0..self.pairs.len()).rev() {
                let Pair { a, b, hint } = self.pairs[i];
                if b == shape {
                    self.pairs[i].hint = self.collide(a, shape, hint);
                }
            }
            return;
        }
        let mut found = Found::default();
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
        for &Neighbour { shape: other, pair, ours } in found.as_slice() {
            if pair {
                let (a, b) = if ours { (shape, other) } else { (other, shape) };
                self.pairs.push(Pair { a, b, hint: 0 });
            }
            if collide && !ours {
                self.collide(shape, other, 0);
            }
        }
    }

    /// Looks for contacts of two shapes; returns where to start next time.
    fn collide(&mut self, a: u32, b: u32, hint: u32) -> u32 {
        let (mut first, mut second) = (a, b);
        if self.shapes[a as usize].kind > self.shapes[b as usize].kind {
            std::mem::swap(&mut first, &mut second);
        }
        let (shape_a, shape_b) = (&self.shapes[first as usize], &self.shapes[second as usize]);
        let bodies = [shape_a.body, shape_b.body];
        if bodies[0] == bodies[1] || !shape_a.bounds.intersects(&shape_b.bounds) {
            return hint;
        }
        // Where neither body can be moved, a contact changes nothing.
        if !bodies.iter().any(|&body| self.bodies[body].is_dynamic()) {
            return hint;
        }
        let touch = collide::touch(shape_a, shape_b, [u64::from(first), u64::from(second)], hint);
        if touch.count == 0 {
            return touch.hint;
        }
        let known = self
            .arbiters
            .iter()
            .position(|arbiter| arbiter.shapes == [first, second] || arbiter.shapes == [second, first]);
        let index = known.unwrap_or_else(|| {
            self.arbiters.push(Arbiter { fresh: 1, ..Arbiter::zeroed() });
            self.arbiters.len() - 1
        });
        let arbiter = &mut self.arbiters[index];
        let mut contacts = touch.contacts;
        for contact in &mut contacts[..touch.count] {
            for (arm, &body) in contact.arms.iter_mut().zip(&bodies) {
                *arm = *arm - self.bodies[body].centre;
            }
            for old in arbiter.contacts() {
                if old.hash == contact.hash {
                    contact.impulse = old.impulse;
                }
            }
        }
        if arbiter.parted != 0 {
            (arbiter.parted, arbiter.fresh) = (0, 1);
        }
        #[allow(clippy::cast_possible_truncation)]
        {
            arbiter.count = touch.count as u32;
            arbiter.bodies = [bodies[0] as u32, bodies[1] as u32];
            self.active.push(index as u32);
        }
        arbiter.normal = touch.normal;
        arbiter.contacts = contacts;
        arbiter.shapes = [first, second];
        arbiter.stamp = self.stamp;
        touch.hint
    }

    /// Masses and wanted speeds of all contacts.
    fn prepare(&mut self) {
        for &i in &self.active {
            let arbiter = &mut self.arbiters[i as usize];
            let n = arbiter.normal;
            let [a, b] = arbiter.bodies();
            let (a, b) = (&self.bodies[a], &self.bodies[b]);
            let between = b.centre - a.centre;
            for contact in &mut arbiter.contacts[..arbiter.count as usize] {
                let [arm_a, arm_b] = contact.arms;
                contact.mass = 1.0 / (a.response(arm_a, n) + b.response(arm_b, n));
                let distance = (arm_b - arm_a + between).dot(n);
                contact.push_speed = -self.push_share * (distance + SLOP).min(0.0) / DT;
                contact.push = 0.0;
            }
        }
    }

    /// Presses as in the last step, where there was a contact.
    fn warm_start(&mut self) {
        for &i in &self.active {
            let arbiter = &self.arbiters[i as usize];
            if arbiter.fresh != 0 {
                continue;
            }
            let [a, b] = arbiter.bodies();
            for contact in arbiter.contacts() {
                let impulse = arbiter.normal * contact.impulse;
                self.bodies[a].apply_impulse(-impulse, contact.arms[0]);
                self.bodies[b].apply_impulse(impulse, contact.arms[1]);
            }
        }
    }

    /// One round of sequential impulses.
    fn solve(&mut self) {
        for &i in &self.active {
            let arbiter = &mut self.arbiters[i as usize];
            let n = arbiter.normal;
            let [a, b] = arbiter.bodies();
            for contact in &mut arbiter.contacts[..arbiter.count as usize] {
                let [arm_a, arm_b] = contact.arms;
                let push_speed = (self.bodies[b].push_at(arm_b) - self.bodies[a].push_at(arm_a)).dot(n);
                let speed = (self.bodies[b].velocity_at(arm_b) - self.bodies[a].velocity_at(arm_a)).dot(n);

                let push = (contact.push + (contact.push_speed - push_speed) * contact.mass).max(0.0);
                let impulse = (contact.impulse + -speed * contact.mass).max(0.0);
                let (more_push, more) = (n * (push - contact.push), n * (impulse - contact.impulse));
                (contact.push, contact.impulse) = (push, impulse);

                self.bodies[a].apply_push(-more_push, arm_a);
                self.bodies[b].apply_push(more_push, arm_b);
                self.bodies[a].apply_impulse(-more, arm_a);
                self.bodies[b].apply_impulse(more, arm_b);
            }
        }
    }

    fn walls(&self) -> u32 {
        self.static_tree.leaves
    }

    fn update_shape(&mut self, shape: u32) {
        let shape = &mut self.shapes[shape as usize];
        shape.update(&self.bodies[shape.body]);
    }

    fn velocity_of(&self, shape: u32) -> Vec2 {
        self.bodies[self.shapes[shape as usize].body].velocity
    }
}

/// The order in which Chipmunk visits moving shapes, to step and to draw them: that of its hash table, whose size is
/// the first of these primes that is greater than their number.
pub fn visiting_order(walls: usize, moving: usize) -> Vec<usize> {
    let size = [5, 13, 23].into_iter().find(|&size| size > moving).unwrap_or(usize::MAX);
    let mut order: Vec<usize> = (0..moving).collect();
    order.sort_by_key(|shape| (shape + walls) % size);
    order
}

/// A shape whose box touches the one in question.
#[derive(Clone, Copy, Default)]
struct Neighbour {
    shape: u32,
    /// Whether the two become a pair.
    pair: bool,
    /// Whether the one in question comes first in the pair, so that contacts are found when the other is visited.
    ours: bool,
}

/// The neighbours of a shape, in the order of the search.
#[derive(Default)]
struct Found {
    neighbours: [Neighbour; 16],
    len: usize,
}

impl Found {
    fn push(&mut self, shape: u32, pair: bool, ours: bool) {
        self.neighbours[self.len] = Neighbour { shape, pair, ours };
        self.len += 1;
    }

    fn as_slice(&self) -> &[Neighbour] {
        &self.neighbours[..self.len]
    }
}
