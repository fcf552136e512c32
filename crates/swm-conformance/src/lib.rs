//! What every environment must keep, checked on every row of a registry: a new one is tested by being listed.
//!
//! ```ignore
//! static WORLDS: Worlds = Worlds::of(my_crate::ENVS.rows);
//! swm_conformance::tests!(WORLDS);
//! ```
//! makes a test of each of the [`checks`]. They panic, as tests do.

pub mod allocation;
pub mod checks;
pub mod golden;

use swm_core::EnvEntry;

/// Environments to check, and how thoroughly: worlds that draw slowly are looked at less often.
pub struct Worlds {
    /// The environments.
    pub rows: &'static [EnvEntry],
    /// Whether each must have an expert.
    pub demonstrated: bool,
    /// Height and width of the pictures compared: not square, so that mixed-up axes show.
    pub size: (usize, usize),
    /// Sizes at which pictures are written completely.
    pub sizes: &'static [(usize, usize)],
    /// Steps over which episodes are compared, picture by picture.
    pub steps: u64,
    /// Goals sampled for each.
    pub goals: u64,
    /// Rows restored for each.
    pub rows_restored: u64,
    /// Values tried for each factor, beside each of these many other choices of all others.
    pub values: usize,
    /// See [`Worlds::values`].
    pub contexts: u64,
    /// Requests for each factor and group.
    pub requests: usize,
    /// Resets with everything varied.
    pub resets: u64,
    /// Factors that change nothing: environment, factor, why.
    pub idle: &'static [(&'static str, &'static str, &'static str)],
}

impl Worlds {
    /// Environments that are fast, each with an expert.
    pub const fn of(rows: &'static [EnvEntry]) -> Self {
        Self {
            rows,
            demonstrated: true,
            size: (72, 96),
            sizes: &[(1, 1), (7, 13), (64, 64), (96, 33), (224, 224), (256, 300)],
            steps: 8,
            goals: 40,
            rows_restored: 10,
            values: 12,
            contexts: 8,
            requests: 5,
            resets: 10_000,
            idle: &[],
        }
    }
}

/// A test of each of the [`checks`].
#[macro_export]
macro_rules! tests {
    ($worlds:expr) => {
        $crate::tests!(
            $worlds,
            rows_declare_what_they_are,
            results_do_not_depend_on_threads_or_neighbours,
            environments_share_nothing_and_forget_the_past,
            rows_and_pictures_are_written_completely,
            wrong_actions_are_errors_and_change_nothing,
            what_follows_a_restore_followed_the_snapshot,
            sampled_goals_are_new_and_count_when_reached,
            dataset_rows_bring_back_their_world,
            factors_change_what_they_name,
            random_variations_never_fail,
            many_resets_of_everything_never_fail,
            groups_single_factors_and_pinned_values_go_together,
            goal_distances_fall_to_the_goal,
            impossible_resets_are_errors,
            experts_stay_in_the_action_space_and_follow_their_key
        );
    };
    ($worlds:expr, $($check:ident),+) => {
        $(
            #[test]
            fn $check() {
                $crate::checks::$check(&$worlds);
            }
        )+
    };
}
