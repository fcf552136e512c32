//! stable-worldmodel: the facade of the platform, and the `swm` command.
//!
//! The platform collects trajectories from environments with controllable factors of variation, stores and streams
//! them, trains world models, plans with them, and evaluates them under shifted factors. Each part is a crate,
//! re-exported here.

pub use swm_core as core;
pub use swm_data as data;
pub use swm_envs as envs;
pub use swm_eval as eval;
pub use swm_gym as gym;
pub use swm_lab as lab;
pub use swm_models as models;
pub use swm_mujoco as mujoco;
pub use swm_plan as plan;
pub use swm_report as report;

pub mod autopsy;
pub mod capsule;
pub mod cli;
pub mod collect_target;
pub mod describe;
pub mod home;
pub mod leaderboard;
mod library;
mod metadata;
pub mod recorded_env;
mod remote_checkpoint;
pub mod resolver;
pub mod step_subject;
pub mod subject;
pub mod zoo;

use swm_core::registry::{Registry, concat};
use swm_core::{EnvChoice, EnvEntry, Origin, Result};

/// The built-in environments: first the 2-D environments, then the MuJoCo environments.
pub static ENVS: Registry<EnvEntry> = Registry { rows: &ROWS, ..swm_envs::ENVS };

const ROWS: [EnvEntry; swm_envs::ENVS.rows.len() + swm_mujoco::ENVS.rows.len()] =
    concat(swm_envs::ENVS.rows, swm_mujoco::ENVS.rows);

/// Returns the environment that `ID` or `ID,option=value,…` names: one of [`ENVS`], else a third-party environment of
/// Gymnasium (`docs/gymnasium.md`). `origin` is who chose the text.
///
/// # Errors
/// When no built-in environment has the id and the id does not have Gymnasium's form, or a file chose an id that only
/// the user may choose ([`swm_gym::TrustedId`]). An id that is not registered with Gymnasium is an error only when the
/// environment is made.
pub fn env(text: &str, origin: &Origin) -> Result<EnvChoice> {
    let id = text.split(',').next().unwrap_or_default();
    let is_builtin = |id: &str| ENVS.get(id).is_ok();
    if !is_builtin(id) && !is_builtin(&format!("swm/{id}")) && swm_gym::is_gymnasium_id(text) {
        return swm_gym::choose(text, origin);
    }
    ENVS.choose(text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ids_choose_built_in_or_gymnasium_environments() -> Result<()> {
        for text in ["swm/PushT-v1", "swm/OGBCube-v0,env_type=double", "ALE/Pong-v5,frameskip=2", "CartPole-v1"] {
            assert_eq!(env(text, &Origin::User)?.id(), text);
        }
        for (text, message) in [
            ("swm/PusT-v1", "did you mean swm/PushT-v1"),
            ("PushT-v1", "did you mean swm/PushT-v1"),
            ("swm/OGBCube-v0,env_type=dubble", "did you mean double"),
            ("pong", "`swm envs` lists them"),
        ] {
            let error = env(text, &Origin::User).map(|chosen| chosen.id()).expect_err(text).to_string();
            assert!(error.contains(message), "{error}");
        }
        Ok(())
    }
}
