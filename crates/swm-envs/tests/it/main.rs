//! Integration tests: golden rollouts of the Python reference, and what every environment must keep.

mod allocation;
mod conformance;
mod golden;
mod golden_classic;
mod golden_piecewise;
mod golden_point_maze;
mod golden_push_t;
mod golden_two_room;
mod wrappers;
