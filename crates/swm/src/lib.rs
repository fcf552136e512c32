//! stable-worldmodel: the whole platform behind one name.
//!
//! Collect trajectories from worlds with controllable factors of variation, store and stream them, train world
//! models, plan with them, and measure how they hold up when the world changes. The parts are crates of their
//! own, re-exported here; this crate also builds the `swm` command.

// The command line was written against the facade by its name.
extern crate self as swm;

pub use swm_core as core;
pub use swm_data as data;
pub use swm_envs as envs;
pub use swm_eval as eval;
pub use swm_gym as gym;
pub use swm_models as models;
pub use swm_mujoco as mujoco;
pub use swm_plan as plan;
pub use swm_report as report;

pub mod cli;
pub mod collect;
pub mod describe;
pub mod home;
pub mod resolver;
pub mod subject;

use swm_core::registry::{Registry, concat};
use swm_core::{EnvChoice, EnvEntry, Result};

/// Every environment of this build: those of two dimensions, then those on MuJoCo.
pub static ENVS: Registry<EnvEntry> = Registry { rows: &ROWS, ..swm_envs::ENVS };

const ROWS: [EnvEntry; swm_envs::ENVS.rows.len() + swm_mujoco::ENVS.rows.len()] =
    concat(swm_envs::ENVS.rows, swm_mujoco::ENVS.rows);

/// The environment that a text names, `ID` or `ID,option=value,…`: one of [`ENVS`], or else any that Gymnasium knows
/// (`docs/gymnasium.md`).
///
/// # Errors
/// When there is none of ours and the id is not of Gymnasium's form. What Gymnasium does not know shows when an
/// environment is made.
pub fn env(text: &str) -> Result<EnvChoice> {
    let id = text.split(',').next().unwrap_or_default();
    let ours = |id: &str| ENVS.get(id).is_ok();
    if !ours(id) && !ours(&format!("swm/{id}")) && swm_gym::is_gymnasium_id(text) {
        return swm_gym::choose(text);
    }
    ENVS.choose(text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_not_ours_is_gymnasiums() -> Result<()> {
        for text in ["swm/PushT-v1", "swm/OGBCube-v0,env_type=double", "ALE/Pong-v5,frameskip=2", "CartPole-v1"] {
            assert_eq!(env(text)?.id(), text);
        }
        for (text, words) in [
            ("swm/PusT-v1", "did you mean swm/PushT-v1"),
            ("PushT-v1", "did you mean swm/PushT-v1"),
            ("swm/OGBCube-v0,env_type=dubble", "did you mean double"),
            ("pong", "`swm envs` lists them"),
        ] {
            let error = env(text).map(|chosen| chosen.id()).expect_err(text).to_string();
            assert!(error.contains(words), "{error}");
        }
        Ok(())
    }
}
