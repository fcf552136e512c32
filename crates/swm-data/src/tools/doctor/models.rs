//! What models need of a dataset.

use super::is_picture;
use serde::Serialize;
use swm_core::columns::ACTION;
use swm_core::{DType, Schema};

/// Whether a model can be trained on a dataset.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Fitness {
    /// The model.
    pub model: &'static str,
    /// What is in the way; nothing if it can be trained.
    pub missing: Vec<String>,
    /// Episodes long enough for its clips.
    pub episodes: usize,
}

impl Fitness {
    /// Whether the model can be trained.
    pub fn fits(&self) -> bool {
        self.missing.is_empty()
    }
}

/// What a model reads.
struct Needs {
    model: &'static str,
    /// Whether it learns from pictures alone, or from a state as well.
    pictures_only: bool,
    reward: bool,
    /// Rows of its clips.
    rows: usize,
}

const fn needs(model: &'static str, pictures_only: bool, reward: bool, rows: usize) -> Needs {
    Needs { model, pictures_only, reward, rows }
}

/// The baselines of the paper. World models train on clips of 4 frames, 5 rows apart; goal-conditioned learners on a row
/// and a later one; TD-MPC2 on 4 rows in succession.
const MODELS: [Needs; 7] = [
    needs("LeWM", true, false, 20),
    needs("PLDM", true, false, 20),
    needs("DINO-WM", true, false, 20),
    needs("TD-MPC2", false, true, 4),
    needs("GCBC", true, false, 2),
    needs("GCIVL", true, false, 2),
    needs("GCIQL", true, false, 2),
];

/// Which models a dataset with these columns, and episodes of these lengths, can train.
pub fn fitness(schema: &Schema, lengths: &[usize]) -> Vec<Fitness> {
    MODELS.iter().map(|needs| fit(needs, schema, lengths)).collect()
}

fn fit(needs: &Needs, schema: &Schema, lengths: &[usize]) -> Fitness {
    let mut missing = vec![];
    let pictures = is_picture(schema, "pixels");
    let has = |name| schema.find(name).is_some();
    match (pictures, needs.pictures_only) {
        (true, _) => {}
        (false, true) if has("pixels") => missing.push("'pixels' holds no RGB pictures".to_owned()),
        (false, true) => missing.push("there are no pictures ('pixels')".to_owned()),
        (false, false) if has("state") || has("observation") => {}
        (false, false) => missing.push("there are neither pictures ('pixels') nor a state".to_owned()),
    }
    match schema.column(ACTION).map(|column| column.dtype) {
        Err(_) => missing.push("there are no actions ('action')".to_owned()),
        Ok(DType::Float32 | DType::Float64) => {}
        Ok(other) => missing.push(format!("actions are discrete ({})", other.name())),
    }
    if needs.reward && !has("reward") {
        missing.push("there is no 'reward'".to_owned());
    }
    let episodes = lengths.iter().filter(|&&length| length >= needs.rows).count();
    if episodes == 0 {
        let longest = lengths.iter().max().copied().unwrap_or(0);
        missing.push(format!("no sound episode has the {} rows of a clip; the longest has {longest}", needs.rows));
    }
    Fitness { model: needs.model, missing, episodes }
}

#[cfg(test)]
mod tests {
    use super::*;
    use swm_core::ColumnSpec;

    #[test]
    fn models_say_what_they_miss() {
        let picture = ColumnSpec::image("pixels", 8, 8);
        let action = |dtype| ColumnSpec::new("action", dtype, [2]);
        let reward = ColumnSpec::new("reward", DType::Float32, []);
        let fits = |columns: &[ColumnSpec], lengths: &[usize]| -> Vec<&str> {
            let schema = Schema::new(columns.to_vec()).expect("schema");
            fitness(&schema, lengths).iter().filter(|fitness| fitness.fits()).map(|fitness| fitness.model).collect()
        };
        let all = [picture.clone(), action(DType::Float32), reward.clone()];
        assert_eq!(fits(&all, &[30, 3]).len(), 7);
        assert_eq!(fits(&all[..2], &[19]), ["GCBC", "GCIVL", "GCIQL"]);
        let states = [ColumnSpec::new("state", DType::Float64, [4]), action(DType::Float32), reward.clone()];
        assert_eq!(fits(&states, &[30]), ["TD-MPC2"]);
        assert!(fits(&[picture, action(DType::Int64), reward], &[30]).is_empty());
        let schema = Schema::new(states.to_vec()).expect("schema");
        let lewm = &fitness(&schema, &[30])[0];
        assert_eq!(lewm.missing, ["there are no pictures ('pixels')"]);
    }
}
