//! [`ModelFamily`] for TD-MPC2.

use super::{Tdmpc2, Tdmpc2Cost, export, import};
use crate::checkpoint::Checkpoint;
use crate::family::{FamilyEntry, ModelFamily, OnlineRun};
use crate::online::{self, OnlineSummary, train_online};
use crate::train::{DatasetInfo, TrainConfig};
use std::path::Path;
use swm_core::requirements::{DatasetRequirements, RequiredObservations};
use swm_core::run::Control;
use swm_core::{CostModel, EnvSpec, Policy, Result};

/// The registry row of TD-MPC2.
pub const ENTRY: FamilyEntry = FamilyEntry::of::<Tdmpc2>();

impl ModelFamily for Tdmpc2 {
    const ACTS: bool = true;

    fn requirements(config: &TrainConfig<Self>) -> DatasetRequirements {
        DatasetRequirements {
            model: "TD-MPC2",
            observations: RequiredObservations::ImagesOrState,
            reward: true,
            clip_rows: config.data.num_steps * config.data.frameskip,
        }
    }

    fn cost(checkpoint: &Checkpoint<Self>) -> Option<Box<dyn CostModel>> {
        Some(Box::new(Tdmpc2Cost::new(checkpoint)))
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

    fn import(from: &Path, dataset_info: DatasetInfo) -> Option<Result<Checkpoint<Self>>> {
        Some(import(from, dataset_info))
    }

    fn export(checkpoint: &Checkpoint<Self>, folder: &Path) -> Option<Result<()>> {
        Some(export(checkpoint, folder))
    }
}
