//! Compares a dataset with the requirements of models.

use serde::Serialize;
use swm_core::columns::{ACTION, PIXELS, REWARD, STATE};
use swm_core::requirements::{DatasetRequirements, RequiredObservations};
use swm_core::{ColumnSpec, DType, Schema};

/// The observation column of environments with a single, unnamed observation.
const OBSERVATION: &str = "observation";

/// The result of comparing a dataset with the requirements of a model.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct ModelFit {
    /// Name of the model.
    pub model: &'static str,
    /// The unmet requirements; empty if the dataset can train the model.
    pub missing: Vec<String>,
    /// Number of episodes that are long enough for a training clip.
    pub episodes: usize,
}

impl ModelFit {
    /// Compares requirements with a dataset that has the columns of `schema` and episodes of `lengths` rows.
    pub fn new(required: &DatasetRequirements, schema: &Schema, lengths: &[usize]) -> Self {
        let mut missing = vec![];
        let images = schema.column(PIXELS).is_ok_and(ColumnSpec::is_image);
        let has = |name| schema.find(name).is_some();
        let state = [STATE, OBSERVATION].iter().any(|name| schema.column(name).is_ok_and(|column| !column.is_image()));
        match required.observations {
            RequiredObservations::Images if images => {}
            RequiredObservations::Images if has(PIXELS) => missing.push(format!("'{PIXELS}' holds no RGB images")),
            RequiredObservations::Images => missing.push(format!("there are no images ('{PIXELS}')")),
            RequiredObservations::ImagesOrState if images || state => {}
            RequiredObservations::ImagesOrState => {
                missing.push(format!("there are neither images ('{PIXELS}') nor a state"));
            }
            RequiredObservations::State if state => {}
            RequiredObservations::State => missing.push(format!("there is no state ('{STATE}' or '{OBSERVATION}')")),
        }
        match schema.column(ACTION).map(|column| column.dtype) {
            Err(_) => missing.push(format!("there are no actions ('{ACTION}')")),
            Ok(DType::Float32 | DType::Float64) => {}
            Ok(other) => missing.push(format!("actions are discrete ({})", other.name())),
        }
        if required.reward && !has(REWARD) {
            missing.push(format!("there is no '{REWARD}'"));
        }
        let rows = required.clip_rows;
        let episodes = lengths.iter().filter(|&&length| length >= rows).count();
        if episodes == 0 {
            let longest = lengths.iter().max().copied().unwrap_or(0);
            missing.push(format!("no intact episode has the {rows} rows of a clip; the longest has {longest}"));
        }
        Self { model: required.model, missing, episodes }
    }

    /// Whether the dataset can train the model.
    pub fn fits(&self) -> bool {
        self.missing.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn model_fit_lists_the_requirements_that_a_dataset_does_not_meet() {
        let world_model = DatasetRequirements {
            model: "world model",
            observations: RequiredObservations::Images,
            reward: false,
            clip_rows: 20,
        };
        let from_rewards = DatasetRequirements {
            model: "from rewards",
            observations: RequiredObservations::ImagesOrState,
            reward: true,
            clip_rows: 4,
        };
        let pixels = ColumnSpec::image(PIXELS, 8, 8);
        let action = |dtype| ColumnSpec::new(ACTION, dtype, [2]);
        let reward = ColumnSpec::new(REWARD, DType::Float32, []);
        let missing = |columns: &[ColumnSpec], lengths: &[usize]| -> Vec<usize> {
            let schema = Schema::new(columns.to_vec()).expect("creating the schema");
            [world_model, from_rewards]
                .iter()
                .map(|required| ModelFit::new(required, &schema, lengths).missing.len())
                .collect()
        };
        let all = [pixels.clone(), action(DType::Float32), reward.clone()];
        assert_eq!(missing(&all, &[30, 3]), [0, 0]);
        assert_eq!(missing(&all[..2], &[19]), [1, 1]);
        let states = [ColumnSpec::new(STATE, DType::Float64, [4]), action(DType::Float32), reward.clone()];
        assert_eq!(missing(&states, &[30]), [1, 0]);
        let bytes = [ColumnSpec::new(STATE, DType::U8, [3]), action(DType::Float64), reward.clone()];
        assert_eq!(missing(&bytes, &[30]), [1, 0]);
        let frames = [ColumnSpec::image(STATE, 8, 8), action(DType::Float32), reward.clone()];
        assert_eq!(missing(&frames, &[30]), [1, 1]);
        assert_eq!(missing(&[pixels, action(DType::Int64), reward], &[30]), [1, 1]);
        let schema = Schema::new(states.to_vec()).expect("creating the schema");
        assert_eq!(ModelFit::new(&world_model, &schema, &[30]).missing, ["there are no images ('pixels')"]);
    }
}
