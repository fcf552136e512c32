//! A small rigid-body solver with the results of pymunk 7.3, whose solver Munk2D derives from Chipmunk 7. Datasets and
//! published checkpoints depend on pymunk's trajectories, so the order of operations is the same.
//!
//! There are two bodies (the agent and the block) between four walls, without gravity, friction and restitution, and
//! with a damping that stops every body between two steps. [`Simulation::step`] moves the bodies with the velocities of
//! the last step, finds contacts ([`bounds_tree`] finds the pairs, [`collide`] their contacts), and solves for the
//! velocities that separate overlapping shapes by sequential impulses, warm-started from the impulses of the previous
//! step.

mod body;
mod bounds;
mod bounds_tree;
mod broad_phase;
mod collide;
mod contact;
mod shape;
mod simulation;
mod snapshot;
mod vec2;

pub use body::{Body, Pose};
pub use shape::Shape;
pub use simulation::{AGENT, BLOCK, DT, Simulation, WALLS, visiting_order};
pub use snapshot::{append_items, take_array};
pub use vec2::Vec2;
