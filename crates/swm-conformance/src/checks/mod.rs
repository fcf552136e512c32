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

pub use effects::every_factor_changes_an_output;
pub use entries::entries_are_complete_and_have_unique_ids;
pub use experts::expert_actions_are_in_the_action_space_and_independent_of_other_slots;
pub use goals::{goal_distance_decreases_to_the_goal, sampled_goals_are_not_reached_yet_and_goal_states_succeed};
pub use independence::{environments_do_not_affect_each_other, results_are_independent_of_threads_and_slots};
pub use outputs::{invalid_actions_are_errors_without_effect, observations_and_frames_are_fully_written};
pub use resets::{
    every_factor_and_group_can_be_sampled, invalid_resets_are_errors,
    requests_combine_groups_factors_and_pinned_values, resets_with_all_factors_varied_succeed,
};
pub use restore::{dataset_rows_restore_state_and_factors, restores_snapshot_bit_for_bit};
