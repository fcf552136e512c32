//! Integration tests: golden rollouts of the Python reference, the conformance suite, and the visual wrappers.

mod allocation;
mod conformance;
mod golden_classic;
mod golden_point_agents;
mod golden_push_t;
mod push_t_experts;
mod recorded_starts;
mod wrappers;
