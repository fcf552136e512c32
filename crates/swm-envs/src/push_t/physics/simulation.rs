//! [`Simulation`]: the agent, the block and the walls, and the steps that move them.

use super::body::Body;
use super::bounds_tree::{BoundsTree, widened};
use super::broad_phase::CandidatePair;
use super::collide;
use super::contact::Arbiter;
use super::shape::Shape;
use super::vec2::Vec2;
use bytemuck::Zeroable as _;

/// Index of the agent among the bodies.
pub const AGENT: usize = 0;
/// Index of the block among the bodies.
pub const BLOCK: usize = 1;
/// Index of the static body of the walls among the bodies.
pub const WALLS: usize = 2;

/// Duration of one physics step, in seconds (`env.py` of the reference).
pub const DT: f64 = 0.01;
/// Iterations of sequential impulses (Chipmunk's default).
const ITERATIONS: usize = 10;
/// Overlap that is tolerated, in pixels (Chipmunk's default, in single precision).
const SLOP: f64 = 0.1f32 as f64;
/// Fraction of an overlap that remains after 1/60 second (Chipmunk's default, in single precision).
const OVERLAP_LEFT: f64 = (1.0f32 - 0.1f32) as f64;
/// Steps for which the impulses of a vanished contact are stored (Chipmunk's default).
const PERSISTENCE: u32 = 3;

/// A simulation of the agent, the block and the walls.
#[derive(Clone, Debug)]
pub struct Simulation {
    /// The bodies: agent, block, walls.
    pub bodies: [Body; 3],
    /// The shapes of the walls, then of the agent, then of the block.
    pub shapes: Vec<Shape>,
    /// The bounding boxes of the walls; built once.
    pub(super) static_tree: BoundsTree,
    /// The bounding boxes of the moving shapes.
    pub(super) tree: BoundsTree,
    /// The order in which moving shapes are updated.
    pub(super) order: Vec<u32>,
    /// The pairs of shapes whose widened bounding boxes touch.
    pub(super) pairs: Vec<CandidatePair>,
    pub(super) arbiters: Vec<Arbiter>,
    /// Indices of the arbiters of the last step, in the order in which they are solved.
    pub(super) active: Vec<u32>,
    /// Counts steps and insertions into the trees.
    pub(super) tree_stamp: u32,
    /// Counts steps.
    pub(super) stamp: u32,
    /// Share of an overlap that one step removes.
    overlap_correction: f64,
}

impl Simulation {
    /// Makes a simulation of these bodies and shapes; the first `walls` shapes never move.
    pub fn new(agent: Body, block: Body, shapes: Vec<Shape>, walls: usize) -> Self {
        let fixed = Body::new(f64::INFINITY, f64::INFINITY, Vec2::ZERO);
        let moving = shapes.len() - walls;
        let mut simulation = Self {
            bodies: [agent, block, fixed],
            static_tree: BoundsTree::new(walls),
            tree: BoundsTree::new(moving),
            order: visiting_order(walls, moving).into_iter().map(|leaf| leaf as u32).collect(),
            pairs: Vec::with_capacity(shapes.len() * shapes.len()),
            arbiters: Vec::with_capacity(shapes.len() * shapes.len()),
            active: Vec::with_capacity(shapes.len() * shapes.len()),
            shapes,
            tree_stamp: 0,
            stamp: 0,
            overlap_correction: 1.0 - OVERLAP_LEFT.powf(60.0).powf(DT),
        };
        for i in 0..simulation.shapes.len() as u32 {
            simulation.update_shape(i);
            let bounds = simulation.shapes[i as usize].bounds;
            if (i as usize) < walls {
                simulation.static_tree.insert(i, bounds, simulation.tree_stamp);
            } else {
                let leaf = i - walls as u32;
                let velocity = simulation.velocity_of(i);
                simulation.tree.insert(leaf, widened(bounds, velocity), simulation.tree_stamp);
                simulation.update_pairs(leaf, false);
            }
            simulation.tree_stamp += 1;
        }
        simulation
    }

    /// Copies the state of another simulation of the same shapes, without allocating.
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

    /// Advances the simulation by [`DT`] seconds.
    pub fn step(&mut self) {
        self.stamp += 1;
        self.drop_old_arbiters();
        self.bodies[AGENT].integrate_position(DT);
        self.bodies[BLOCK].integrate_position(DT);
        self.find_contacts();
        self.prepare_contacts();
        for body in &mut self.bodies[..WALLS] {
            // Damping 0: every body stops until contacts move it.
            if body.is_dynamic() {
                body.velocity = Vec2::ZERO;
                body.angular_velocity = 0.0;
            }
        }
        for &i in &self.active {
            self.arbiters[i as usize].warm_start(&mut self.bodies);
        }
        for _ in 0..ITERATIONS {
            for &i in &self.active {
                self.arbiters[i as usize].solve(&mut self.bodies);
            }
        }
    }

    /// The arbiters of the last step, in the order in which they are solved.
    pub fn touching(&self) -> impl Iterator<Item = &Arbiter> {
        self.active.iter().map(|&i| &self.arbiters[i as usize])
    }

    /// Returns the number of contacts of the last step.
    pub fn contact_count(&self) -> usize {
        self.touching().map(|arbiter| arbiter.contacts().len()).sum()
    }

    /// Drops the arbiters of shapes that have not touched for [`PERSISTENCE`] steps.
    fn drop_old_arbiters(&mut self) {
        for &i in &self.active {
            self.arbiters[i as usize].is_new = 0;
        }
        self.active.clear();
        let before = self.stamp - 1;
        self.arbiters.retain_mut(|arbiter| {
            let age = before - arbiter.stamp;
            arbiter.separated |= u32::from(age >= 1);
            age < PERSISTENCE
        });
    }

    /// Finds the contacts of two shapes. Returns the hint with which the search starts in the next step.
    pub(super) fn collide(&mut self, a: u32, b: u32, hint: u32) -> u32 {
        let (mut first, mut second) = (a, b);
        if self.shapes[a as usize].kind > self.shapes[b as usize].kind {
            std::mem::swap(&mut first, &mut second);
        }
        let (shape_a, shape_b) = (&self.shapes[first as usize], &self.shapes[second as usize]);
        let bodies = [shape_a.body, shape_b.body];
        if bodies[0] == bodies[1] || !shape_a.bounds.intersects(&shape_b.bounds) {
            return hint;
        }
        // A contact has no effect if neither body is dynamic.
        if !bodies.iter().any(|&body| self.bodies[body].is_dynamic()) {
            return hint;
        }
        let manifold = collide::manifold(shape_a, shape_b, [u64::from(first), u64::from(second)], hint);
        if manifold.count == 0 {
            return manifold.hint;
        }
        let known = self
            .arbiters
            .iter()
            .position(|arbiter| arbiter.shapes == [first, second] || arbiter.shapes == [second, first]);
        let index = known.unwrap_or_else(|| {
            self.arbiters.push(Arbiter { is_new: 1, ..Arbiter::zeroed() });
            self.arbiters.len() - 1
        });
        let arbiter = &mut self.arbiters[index];
        let mut contacts = manifold.contacts;
        for contact in &mut contacts[..manifold.count] {
            for (arm, &body) in contact.arms.iter_mut().zip(&bodies) {
                *arm = *arm - self.bodies[body].centre;
            }
            for old in arbiter.contacts() {
                if old.hash == contact.hash {
                    contact.impulse = old.impulse;
                }
            }
        }
        if arbiter.separated != 0 {
            (arbiter.separated, arbiter.is_new) = (0, 1);
        }
        arbiter.count = manifold.count as u32;
        arbiter.bodies = [bodies[0] as u32, bodies[1] as u32];
        self.active.push(index as u32);
        arbiter.normal = manifold.normal;
        arbiter.contacts = contacts;
        arbiter.shapes = [first, second];
        arbiter.stamp = self.stamp;
        manifold.hint
    }

    /// Computes the effective masses and bias speeds of all contacts.
    fn prepare_contacts(&mut self) {
        for &i in &self.active {
            let arbiter = &mut self.arbiters[i as usize];
            let n = arbiter.normal;
            let [a, b] = arbiter.bodies();
            let (a, b) = (&self.bodies[a], &self.bodies[b]);
            let between = b.centre - a.centre;
            for contact in arbiter.contacts_mut() {
                let [arm_a, arm_b] = contact.arms;
                contact.mass = 1.0 / (a.response(arm_a, n) + b.response(arm_b, n));
                let distance = (arm_b - arm_a + between).dot(n);
                contact.bias_speed = -self.overlap_correction * (distance + SLOP).min(0.0) / DT;
                contact.bias_impulse = 0.0;
            }
        }
    }

    /// Returns the number of wall shapes, which is the index of the first moving shape.
    pub(super) fn walls(&self) -> u32 {
        self.static_tree.leaves
    }

    /// Moves a shape to the pose of its body.
    pub(super) fn update_shape(&mut self, shape: u32) {
        let shape = &mut self.shapes[shape as usize];
        shape.update(&self.bodies[shape.body]);
    }

    /// Returns the velocity of the body of a shape, in pixels per second.
    pub(super) fn velocity_of(&self, shape: u32) -> Vec2 {
        self.bodies[self.shapes[shape as usize].body].velocity
    }
}

/// Returns the order in which Chipmunk updates and draws moving shapes.
///
/// It is the order of Chipmunk's hash table, whose size is the first of the primes 5, 13 and 23 that exceeds the number
/// of moving shapes.
pub fn visiting_order(walls: usize, moving: usize) -> Vec<usize> {
    let size = [5, 13, 23].into_iter().find(|&size| size > moving).unwrap_or(usize::MAX);
    let mut order: Vec<usize> = (0..moving).collect();
    order.sort_by_key(|shape| (shape + walls) % size);
    order
}
