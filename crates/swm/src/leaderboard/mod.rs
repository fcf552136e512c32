//! The leaderboard: results that anybody can submit, and that everybody can verify by playing them again.
//!
//! [`Entry`] is a file with the results of one trained policy. [`verify`] plays all of its episodes, or a random share of
//! them. [`board`] collects the entries of a folder for the pages of [`swm_report::write_leaderboard`].

mod board;
mod entry;
mod verify;

pub use board::{Found, board, entries};
pub use entry::{Entry, Submission};
pub use verify::{Class, How, REWARD_TOLERANCE, TOLERANCE, Verification, verify};
