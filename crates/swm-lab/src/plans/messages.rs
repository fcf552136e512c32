//! The messages of a plan session. Those of the page are JSON objects with a `type`; unknown fields and types are errors.

use super::tree::Node;
use super::{Model, Settings};
use serde::{Deserialize, Serialize};

/// A message of the page. Unit variants would accept unknown fields.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(tag = "type", rename_all = "snake_case", deny_unknown_fields)]
pub enum Request {
    /// Starts an episode and an empty tree. `pin` and `variation` have the form of [`crate::still::StillQuery`].
    Reset {
        /// The seed.
        seed: u64,
        /// Pinned factors.
        #[serde(default)]
        pin: String,
        /// Factors to sample; the environment's defaults if left out.
        #[serde(default)]
        variation: Option<String>,
    },
    /// Plans with these settings from now on.
    Settings {
        /// The settings.
        planner: Settings,
    },
    /// Shows what the model imagines as frames, through a decoder that is fitted to a dataset; `null` shows none.
    Decode {
        /// The dataset.
        dataset: Option<Named>,
    },
    /// Executes the present plan, then searches the next one and stops.
    Decide {},
    /// One step of the environment; searches if a plan is due.
    Step {},
    /// Steps at the chosen speed, or stops.
    Play {
        /// Whether to step.
        on: bool,
    },
    /// Sets the number of environment steps a second.
    Speed {
        /// Steps a second, 1 to 60.
        fps: f64,
    },
    /// One step with this action.
    Act {
        /// The action, `[dim]`.
        action: Vec<f64>,
    },
    /// Changes a factor at the present step and goes on from there.
    Change {
        /// The key of the factor.
        factor: String,
        /// Its value.
        value: Vec<f64>,
    },
    /// Goes to a step of the tree.
    Go {
        /// The id of the step.
        node: usize,
    },
    /// Asks for the frame of a step, without going there.
    Peek {
        /// The id of the step.
        node: usize,
    },
    /// Forgets all steps that do not lead to the present one.
    Forget {},
    /// Ends the search that is under way, whose plan is the best so far, or the fit of a decoder.
    Enough {},
    /// The page has shown a frame, and can receive another.
    Shown {},
}

/// A dataset of a folder.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Named {
    /// The index of its folder.
    pub folder: usize,
    /// Its name.
    pub name: String,
}

/// A message of the server. The messages `planned`, whose plans are stored as JSON, and `failed` are not in this list.
#[derive(Clone, Debug, Serialize)]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum Reply {
    /// The settings are in use.
    Ready {
        /// The model.
        model: Model,
        /// Environment steps in a model step.
        block: usize,
        /// The command that evaluates this planner.
        command: String,
    },
    /// All steps.
    Tree {
        /// The steps, by id.
        nodes: Vec<Node>,
        /// The present one.
        present: usize,
        /// What they hold, in bytes.
        bytes: usize,
        /// The largest number of steps.
        most_nodes: usize,
        /// The largest number of bytes.
        most_bytes: usize,
    },
    /// A step was added.
    Node {
        /// The step.
        node: Node,
        /// What all steps hold, in bytes.
        bytes: usize,
    },
    /// A search is under way.
    Searching {
        /// The index of its newest iteration.
        iteration: usize,
        /// The lowest cost of it.
        best: f32,
    },
    /// A decoder is being fitted.
    Fitting {
        /// Steps that were taken.
        done: usize,
        /// All steps.
        total: usize,
    },
    /// What the model imagines is shown as frames from now on, or no longer.
    Decodes {
        /// The fraction of the variance of pixels that the decoder explains on held-out episodes; `None` without a decoder.
        explained: Option<f64>,
    },
    /// The frame of the goal.
    Goal {
        /// The JPEG, in Base64.
        jpeg: String,
    },
    /// The frame of a step.
    Peeked {
        /// The id of the step.
        node: usize,
        /// The JPEG, in Base64.
        jpeg: String,
    },
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unknown_messages_fields_and_settings_are_errors() {
        let parse = |text: &str| serde_json::from_str::<Request>(text).ok();
        assert_eq!(parse(r#"{"type": "go", "node": 3}"#), Some(Request::Go { node: 3 }));
        assert_eq!(parse(r#"{"type": "step"}"#), Some(Request::Step {}));
        assert!(matches!(
            parse(
                r#"{"type": "settings", "planner": {"model": "simulator", "solver": "cem", "horizon": 5,
            "receding": 1, "block": 5, "score": "terminal", "warm": true}}"#
            ),
            Some(Request::Settings { .. })
        ));
        for text in [
            r#"{"type": "go", "node": -1}"#,
            r#"{"type": "go", "node": 1.5}"#,
            r#"{"type": "go", "path": "/etc"}"#,
            r#"{"type": "exec", "shell": "ls"}"#,
            r#"{"type": "decide", "node": 1}"#,
            r#"{"type": "step", "count": 2}"#,
            r#"{"type": "forget", "node": 1}"#,
            r#"{"type": "enough", "node": 1}"#,
            r#"{"type": "shown", "frame": 1}"#,
            r#"{"type": "settings", "planner": {"model": "simulator"}}"#,
            r#"{"type": "settings", "planner": {"model": "simulator", "solver": "cem", "horizon": 5, "receding": 1,
                "block": 5, "score": "terminal", "warm": true, "module": "os"}}"#,
        ] {
            assert_eq!(parse(text), None, "{text}");
        }
    }
}
