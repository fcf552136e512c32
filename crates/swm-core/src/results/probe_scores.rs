//! [`ProbeScores`]: what probes read from the latents of a model, beside what a trivial predictor knows.

use serde::{Deserialize, Serialize};

/// How well probes predict the state of an environment from the latents of a model, on episodes that they were not fitted on.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ProbeScores {
    /// The dataset that the probes are fitted on.
    pub dataset: String,
    /// The columns of the trivial predictor, which sees no image; `None` if the dataset has none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub trivial: Option<String>,
    /// The scores, element by element.
    pub elements: Vec<ProbeScore>,
}

/// The coefficients of determination of one element of the state: 1 for perfect predictions, 0 for those of the mean. `None` for
/// a constant element.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ProbeScore {
    /// The element, such as `state[2]` or `sin state[4]`.
    pub element: String,
    /// That of a linear map of the latents.
    pub linear: Option<f64>,
    /// That of a network with two hidden layers on the latents.
    pub network: Option<f64>,
    /// That of such a network on the columns of the trivial predictor.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub trivial: Option<f64>,
}

impl ProbeScores {
    /// What the scores do not show, in a sentence.
    pub fn note(&self) -> String {
        self.trivial.as_ref().map_or_else(
            || "The dataset has no column of the position of the agent, so there is no trivial predictor; the R² of the mean is 0."
                    .to_owned(),
            |columns| {
                format!(
                    "What {columns} predicts alone needs no image: an R² that is not above it does not show that the latents hold \
                     more than {columns}."
                )
            },
        )
    }
}
