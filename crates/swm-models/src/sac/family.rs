//! [`ModelFamily`] for SAC.

use super::Sac;
use crate::checkpoint::Checkpoint;
use crate::family::{FamilyEntry, ModelFamily, OnlineRun};
use crate::online::{self, OnlineSummary, train_online};
use crate::train::TrainConfig;
use swm_core::requirements::{DatasetRequirements, RequiredObservations};
use swm_core::run::Control;
use swm_core::{EnvSpec, Policy, Result};

/// The registry row of SAC.
pub const ENTRY: FamilyEntry = FamilyEntry::of::<Sac>();

impl ModelFamily for Sac {
    const ACTS: bool = true;

    fn requirements(config: &TrainConfig<Self>) -> DatasetRequirements {
        DatasetRequirements {
            model: "SAC",
            observations: RequiredObservations::State,
            reward: true,
            clip_rows: config.data.num_steps * config.data.frameskip,
        }
    }

    fn policy(checkpoint: &Checkpoint<Self>, spec: &EnvSpec, slots: usize) -> Option<Result<Box<dyn Policy>>> {
        Some(online::policy(checkpoint, spec, slots))
    }

    fn train_online(
        config: &TrainConfig<Self>,
        run: OnlineRun<'_>,
        control: &mut Control<'_>,
    ) -> Option<Result<OnlineSummary>> {
        Some(train_online(config, run.environments, run.out, &run.options, control))
    }
}
