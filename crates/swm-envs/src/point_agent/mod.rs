//! Code shared by the environments in which a disc moves to a goal position: Two-Room, SimplePointMaze and Piecewise.
//!
//! [`PointAgentEnv`] implements [`swm_core::Env`] for any [`PointTask`], which holds the dynamics, the goal rule and
//! the drawing of one environment. [`Explorer`] is the random-walk expert of these environments, and [`room`] the
//! 224-pixel room of Two-Room and Piecewise.

mod env;
mod exploration;
mod position;
pub mod room;
mod task;
#[cfg(test)]
pub mod trial;

pub use env::PointAgentEnv;
pub use exploration::{Explorer, Leg, RandomWalk};
pub use position::{Position, Position64, distance64, position, read_position, widen};
pub use task::{PointTask, farthest_goal};
