//! Options that table and maze environments have in common.

use swm_core::columns;
use swm_core::registry::EnvOption;

/// The value of `ob_type` for agents that observe frames, which is the name of the frame column.
pub const PIXELS: &str = columns::PIXELS;

/// Whether an episode terminates at its goal.
pub const TERMINATE_AT_GOAL: EnvOption = EnvOption {
    key: "terminate_at_goal",
    summary: "whether an episode terminates at its goal",
    values: &["true", "false"],
};
