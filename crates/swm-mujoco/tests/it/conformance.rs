//! What every environment must keep. Pictures take tens of milliseconds here, so everything is looked at less often than
//! in worlds of two dimensions.

use swm_conformance::Worlds;
use swm_mujoco::ENVS;

static WORLDS: Worlds = Worlds {
    demonstrated: false,
    size: (24, 32),
    sizes: &[(1, 1), (13, 7)],
    goals: 2,
    rows_restored: 1,
    values: 1,
    contexts: 1,
    requests: 1,
    resets: 20,
    idle: &[],
    ..Worlds::of(ENVS.rows)
};

swm_conformance::tests!(WORLDS);
