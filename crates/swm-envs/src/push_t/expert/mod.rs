//! Who demonstrates.

mod model;
mod pusher;
mod room;
mod route;
mod weak;

pub use pusher::Pusher;
pub use weak::Weak;
