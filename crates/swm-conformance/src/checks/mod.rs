//! The conformance checks. Each check runs on every entry of a [`crate::Suite`] and panics with the environment's id on
//! the first failure.

mod effects;
mod entries;
mod experts;
mod goals;
mod independence;
mod outputs;
mod probe;
mod resets;
mod restore;

pub use effects::every_factor_has_an_effect;
pub use entries::entries_are_complete;
pub use experts::experts_are_valid_and_deterministic;
pub use goals::{goal_distance_decreases_to_the_goal, sampled_goals_differ_and_are_unsolved_and_restorable};
pub use independence::{environments_are_independent, results_are_independent_of_threads_and_slots};
pub use outputs::{invalid_actions_are_errors_without_effect, observations_and_frames_are_fully_written};
pub use resets::{
    any_requested_factors_can_be_sampled, groups_factors_and_pinned_values_combine, invalid_resets_are_errors,
    resets_with_all_factors_varied_succeed,
};
pub use restore::{dataset_rows_restore_state_and_factors, restores_snapshot_bit_for_bit};
