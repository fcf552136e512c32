//! The conformance suite over every native environment.

use swm_conformance::Suite;
use swm_envs::ENVS;

/// The reason why `goal.scale` has no effect.
const GOAL_SCALE: &str = "the reference samples it and draws the goal pose as large as the block";

static SUITE: Suite = Suite {
    inert_factors: &[("swm/PushT-v1", "goal.scale", GOAL_SCALE), ("swm/PushT-Discrete-v1", "goal.scale", GOAL_SCALE)],
    ..Suite::of(ENVS.rows)
};

swm_conformance::tests!(SUITE);
