//! [`FAMILIES`]: the model families of this build, and [`load`], which loads a checkpoint of any family.

use crate::family::{FamilyEntry, LoadedModel};
use crate::stored::StoredCheckpoint;
use crate::{dino_wm, gcrl, inverse, lewm, pldm, sac, tdmpc2};
use burn::tensor::Device;
use std::path::Path;
use swm_core::requirements::DatasetRequirements;
use swm_core::{Error, Registry, Result};

/// The model families of this build, in the order of listings.
pub static FAMILIES: Registry<FamilyEntry> = Registry {
    kind: "model",
    hint: "`swm models` lists them",
    rows: &[
        lewm::ENTRY,
        pldm::ENTRY,
        dino_wm::ENTRY,
        tdmpc2::ENTRY,
        gcrl::GCBC,
        gcrl::GCIVL,
        gcrl::GCIQL,
        sac::ENTRY,
        inverse::ENTRY,
    ],
};

/// Returns the dataset requirements of every family that trains on a dataset alone.
///
/// # Errors
/// Never for the presets of this build.
pub fn dataset_requirements() -> Result<Vec<DatasetRequirements>> {
    FAMILIES.rows.iter().filter_map(|family| (family.requirements)().transpose()).collect()
}

/// Loads the checkpoint of a run folder or of a capsule, of any family in [`FAMILIES`].
///
/// # Errors
/// When there is no checkpoint at `run`, or the checkpoint is of an unknown family, is damaged, or has weights that do
/// not fit its configuration.
pub fn load(run: &Path, device: &Device) -> Result<Box<dyn LoadedModel>> {
    load_from(FAMILIES.rows, run, device)
}

/// Loads the checkpoint of a run folder or of a capsule, of any of the given families.
///
/// # Errors
/// As [`load`].
pub fn load_from(families: &[FamilyEntry], run: &Path, device: &Device) -> Result<Box<dyn LoadedModel>> {
    load_stored(families, &StoredCheckpoint::read(run)?, device)
}

/// Loads a stored checkpoint of any of the given families.
///
/// # Errors
/// As [`load`].
pub fn load_stored(
    families: &[FamilyEntry],
    stored: &StoredCheckpoint,
    device: &Device,
) -> Result<Box<dyn LoadedModel>> {
    let family = stored.family();
    let Some(row) = families.iter().find(|row| row.id == family) else {
        let problem = format!("it holds a model of the family '{family}', which this program does not support");
        let fix = "give another checkpoint; `swm models` lists the supported families";
        return Err(Error::corrupt(stored.run(), problem, fix));
    };
    (row.load)(stored, device)
}
