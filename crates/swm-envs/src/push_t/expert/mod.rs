//! Who demonstrates.

mod pusher;
mod route;
mod weak;

pub use pusher::Pusher;
pub use weak::Weak;
