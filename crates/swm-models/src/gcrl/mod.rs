//! Goal-conditioned learning from offline data: behavioural cloning (GCBC) and implicit value and Q-learning (GCIVL,
//! GCIQL), on the patches of a frozen or trained encoder. The policies act without planning. See `docs/models/gcrl.md`.

mod cells;
pub mod config;
mod family;
pub mod heads;
pub mod import;
pub mod loss;
pub mod model;
pub mod policy;
pub mod step;
mod train;
pub mod transformer;

pub use config::GcrlConfig;
pub use family::{GCBC, GCIQL, GCIVL};
pub use model::{Gcbc, Gciql, Gcivl};
pub use policy::{Actor, GcrlPolicy};
pub use train::GoalConditioned;
