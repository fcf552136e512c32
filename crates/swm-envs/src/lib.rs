//! Native 2-D worlds: one folder each, with physics, render, expert and a README side by side.

pub mod classic;
mod draw;
mod factors;
pub mod piecewise;
pub mod point_maze;
pub mod push_t;
#[cfg(test)]
mod trial;
pub mod two_room;
pub mod wrappers;

use swm_core::{EnvEntry, Registry};

/// Every native environment.
pub static ENVS: Registry<EnvEntry> = Registry {
    kind: "environment",
    hint: "`swm envs` lists them",
    rows: &[
        push_t::ENTRY,
        push_t::discrete::ENTRY,
        two_room::ENTRY,
        point_maze::ENTRY,
        piecewise::ENTRY,
        classic::cart_pole::ENTRY,
        classic::mountain_car::ENTRY,
        classic::mountain_car::CONTINUOUS,
        classic::acrobot::ENTRY,
        classic::pendulum::ENTRY,
    ],
};
