//! Native 2-D environments, one folder each with physics, rendering, experts and a README, and the visual wrappers that
//! change the frames of any environment.
//!
//! "The reference" is the Python package `stable-worldmodel`, whose environments and wrappers this crate reproduces.

pub mod classic;
mod draw;
pub mod piecewise;
mod point_agent;
pub mod point_maze;
pub mod push_t;
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
