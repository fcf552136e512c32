//! [`ModelFamily`] for goal-conditioned models, which act without planning and whose encoders can be probed.

use super::{Gcbc, Gciql, Gcivl, GoalConditioned, import};
use crate::checkpoint::Checkpoint;
use crate::family::{FamilyEntry, ModelFamily};
use crate::probe::ImageEncoder;
use crate::train::{DatasetInfo, TrainConfig};
use crate::weights::Naming;
use std::path::Path;
use swm_core::requirements::{DatasetRequirements, RequiredObservations};
use swm_core::{EnvSpec, Policy, Result};

/// The registry row of GCBC.
pub const GCBC: FamilyEntry = FamilyEntry::of::<Gcbc>();
/// The registry row of GCIVL.
pub const GCIVL: FamilyEntry = FamilyEntry::of::<Gcivl>();
/// The registry row of GCIQL.
pub const GCIQL: FamilyEntry = FamilyEntry::of::<Gciql>();

macro_rules! goal_conditioned_family {
    ($($model:ty, $name:literal);*) => {
        $(impl ModelFamily for $model {
            const ACTS: bool = true;

            fn requirements(config: &TrainConfig<Self>) -> DatasetRequirements {
                DatasetRequirements {
                    model: $name,
                    observations: RequiredObservations::Images,
                    reward: false,
                    // A goal is a later row than the current row.
                    clip_rows: (config.data.num_steps * config.data.frameskip).max(2),
                }
            }

            fn history(config: &TrainConfig<Self>) -> usize {
                config.model.history
            }

            fn policy(checkpoint: &Checkpoint<Self>, spec: &EnvSpec, slots: usize) -> Option<Result<Box<dyn Policy>>> {
                let policy = Self::actor(checkpoint).policy(spec, slots);
                Some(policy.map(|policy| Box::new(policy) as Box<dyn Policy>))
            }

            fn encoder(checkpoint: &Checkpoint<Self>) -> Option<Box<dyn ImageEncoder>> {
                Some(Box::new(Self::actor(checkpoint)))
            }

            fn import(from: &Path, dataset_info: DatasetInfo) -> Option<Result<Checkpoint<Self>>> {
                Some(import::import(from, dataset_info))
            }

            fn export(checkpoint: &Checkpoint<Self>, folder: &Path) -> Option<Result<()>> {
                Some(import::export(checkpoint, folder, Naming::default()))
            }
        })*
    };
}
goal_conditioned_family!(Gcbc, "GCBC"; Gcivl, "GCIVL"; Gciql, "GCIQL");
