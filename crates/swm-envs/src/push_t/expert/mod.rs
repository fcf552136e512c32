//! The experts of Push-T: [`Pusher`] plans pushes in a copy of the simulation, [`WeakExpert`] takes random actions near
//! the block.

mod configuration_space;
mod pace;
mod paths;
mod push_model;
mod pusher;
mod weak;

pub use pace::Pace;
pub use pusher::Pusher;
pub use weak::WeakExpert;
