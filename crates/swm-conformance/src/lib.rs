//! Conformance tests of environments: every check runs on every entry of a registry, so a new environment is tested as
//! soon as it is listed.
//!
//! ```ignore
//! static SUITE: Suite = Suite::of(my_crate::ENVS.rows);
//! swm_conformance::tests!(SUITE);
//! ```
//! The macro makes one test of each function of [`checks`].

pub mod allocation;
pub mod checks;
pub mod golden;

use swm_core::EnvEntry;

/// The environments to check and the extent of the checks. Suites of environments that render slowly use smaller
/// counts.
pub struct Suite {
    /// The environments.
    pub rows: &'static [EnvEntry],
    /// Whether each environment must have an expert.
    pub require_experts: bool,
    /// Height and width of compared frames, in pixels; not square, to reveal swapped axes.
    pub frame_size: (usize, usize),
    /// Frame sizes at which every pixel must be written.
    pub frame_sizes: &'static [(usize, usize)],
    /// Environment steps over which episodes are compared, frame by frame.
    pub steps: u64,
    /// Goals sampled per environment.
    pub goals: u64,
    /// Dataset rows restored per environment.
    pub restored_rows: u64,
    /// Values tried per factor in each context. A context is an assignment of values to all other factors.
    pub values: usize,
    /// The number of contexts with random values, besides the context of all defaults.
    pub contexts: u64,
    /// The number of resets that vary one factor, for each factor, and that vary one group of factors, for each group. A
    /// group is the factors whose names have the same first part, such as `agent`.
    pub requests: usize,
    /// The number of resets per environment with all factors varied.
    pub resets: u64,
    /// Factors without effect: environment, factor, reason.
    pub inert_factors: &'static [(&'static str, &'static str, &'static str)],
}

impl Suite {
    /// A thorough suite, for environments that are fast and have experts.
    pub const fn of(rows: &'static [EnvEntry]) -> Self {
        Self {
            rows,
            require_experts: true,
            frame_size: (72, 96),
            frame_sizes: &[(1, 1), (7, 13), (64, 64), (96, 33), (224, 224), (256, 300)],
            steps: 8,
            goals: 40,
            restored_rows: 10,
            values: 12,
            contexts: 8,
            requests: 5,
            resets: 10_000,
            inert_factors: &[],
        }
    }
}

/// Makes a test of each function of [`checks`], or of the named functions only.
#[macro_export]
macro_rules! tests {
    ($suite:expr) => {
        $crate::tests!(
            $suite,
            entries_are_complete_and_have_unique_ids,
            results_are_independent_of_threads_and_slots,
            environments_do_not_affect_each_other,
            observations_and_frames_are_fully_written,
            invalid_actions_are_errors_without_effect,
            restores_snapshot_bit_for_bit,
            sampled_goals_are_not_reached_yet_and_goal_states_succeed,
            dataset_rows_restore_state_and_factors,
            every_factor_changes_an_output,
            every_factor_and_group_can_be_sampled,
            resets_with_all_factors_varied_succeed,
            requests_combine_groups_factors_and_pinned_values,
            goal_distance_decreases_to_the_goal,
            invalid_resets_are_errors,
            expert_actions_are_in_the_action_space_and_independent_of_other_slots
        );
    };
    ($suite:expr, $($check:ident),+) => {
        $(
            #[test]
            fn $check() {
                $crate::checks::$check(&$suite);
            }
        )+
    };
}
