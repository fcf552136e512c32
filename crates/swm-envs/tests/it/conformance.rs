//! The conformance suite over every native environment.

use swm_conformance::Worlds;
use swm_envs::ENVS;

/// Why `goal.scale` changes nothing.
const GOAL_SCALE: &str = "the reference samples it and draws the goal pose as large as the block";

static WORLDS: Worlds = Worlds {
    idle: &[("swm/PushT-v1", "goal.scale", GOAL_SCALE), ("swm/PushT-Discrete-v1", "goal.scale", GOAL_SCALE)],
    ..Worlds::of(ENVS.rows)
};

swm_conformance::tests!(WORLDS);
