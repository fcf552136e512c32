//! [`FamilyEntry`]: the row of a model family in a registry.

use super::config::TrainableConfig;
use super::contract::ModelFamily;
use super::loaded::LoadedModel;
use crate::checkpoint::Checkpoint;
use crate::stored::{StoredCheckpoint, write_unused};
use crate::train::{DatasetInfo, Preset, TrainConfig};
use burn::tensor::Device;
use std::path::Path;
use swm_core::requirements::DatasetRequirements;
use swm_core::{Named, Result};
use swm_data::Reader;

/// Loads a configuration from a preset and `key=value` settings.
type LoadConfig = fn(&str, &[String]) -> Result<Box<dyn TrainableConfig>>;

/// The entry of a model family in a registry: id, constructors and presets.
#[derive(Clone, Copy)]
pub struct FamilyEntry {
    /// The id, such as `lewm`.
    pub id: &'static str,
    /// One sentence about the family.
    pub summary: &'static str,
    /// The configurations that come with the family; the first is the default.
    pub presets: &'static [Preset],
    /// The family of the checkpoint whose encoder training uses; `None` for a family that trains its own.
    pub borrows_encoder: Option<&'static str>,
    /// Loads a configuration from a preset (its name or the path of a TOML file) and `key=value` settings.
    pub config: LoadConfig,
    /// Returns the dataset requirements of the default preset; `None` for a family that also requires another
    /// checkpoint.
    pub requirements: fn() -> Result<Option<DatasetRequirements>>,
    /// Loads a stored checkpoint.
    pub load: fn(&StoredCheckpoint, &Device) -> Result<Box<dyn LoadedModel>>,
    /// Converts a checkpoint of the reference implementation (`weights.pt` and `config.json` in the first folder),
    /// which was trained on the given dataset, into a checkpoint in the last folder, which holds none; returns the hash
    /// of the weights. `None` if the reference implementation has no such family.
    pub import: fn(&Path, &dyn Reader, &Path) -> Option<Result<String>>,
}

impl FamilyEntry {
    /// Creates the entry of a family.
    pub const fn of<M: ModelFamily>() -> Self {
        Self {
            id: M::FAMILY,
            summary: M::SUMMARY,
            presets: M::PRESETS,
            borrows_encoder: None,
            config: |preset, settings| Ok(Box::new(TrainConfig::<M>::load(preset, settings)?)),
            requirements: || Ok(Some(M::requirements(&TrainConfig::<M>::load(M::PRESETS[0].id, &[])?))),
            load: |stored, device| Ok(Box::new(Checkpoint::<M>::of(stored, device)?)),
            import: import::<M>,
        }
    }
}

impl Named for FamilyEntry {
    fn id(&self) -> &'static str {
        self.id
    }
}

fn import<M: ModelFamily>(from: &Path, reader: &dyn Reader, out: &Path) -> Option<Result<String>> {
    let columns: Vec<String> = reader.schema().columns().iter().map(|column| column.name.clone()).collect();
    let dataset_info = match DatasetInfo::from_reader(reader, &columns, M::BOUNDED_ACTIONS) {
        Ok(dataset_info) => dataset_info,
        Err(error) => return Some(Err(error)),
    };
    Some(M::import(from, dataset_info)?.and_then(|mut checkpoint| write_unused(out, || checkpoint.save_to(out))))
}
