//! The messages of a live environment. Those of the page are JSON objects with a `type`; unknown fields and types are errors.
//! Those of the server are JSON objects as well, except frames ([`super::Frame`]).

use serde::{Deserialize, Serialize};
use swm_core::{EnvEntry, EnvSpec};

/// A message of the page. Unit variants would accept unknown fields.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(tag = "type", rename_all = "snake_case", deny_unknown_fields)]
pub enum Request {
    /// Starts an episode. All fields have the form of [`crate::still::StillQuery`].
    Reset {
        /// The seed.
        seed: u64,
        /// Pinned factors.
        #[serde(default)]
        pin: String,
        /// Factors to sample; the environment's defaults if left out.
        #[serde(default)]
        variation: Option<String>,
        /// The camera view; the colour of the default camera if left out.
        #[serde(default)]
        view: Option<String>,
        /// Wrappers of the frames.
        #[serde(default)]
        wrappers: String,
        /// Whether wrappers change the goal, too.
        #[serde(default)]
        wrap_goal: bool,
    },
    /// Steps at the chosen speed, or stops.
    Play {
        /// Whether to step.
        on: bool,
    },
    /// One step.
    Step {},
    /// Sets the number of steps a second.
    Speed {
        /// Steps a second, 1 to 240.
        fps: f64,
    },
    /// Chooses who acts: `hand`, `random`, or an expert.
    Drive {
        /// The name.
        by: String,
    },
    /// The action of `hand` from now on.
    Act {
        /// The action, `[dim]`.
        action: Vec<f64>,
    },
    /// The page has shown a frame, and can receive another.
    Shown {},
    /// Records the episodes from the next reset on into a dataset, which is created or continued.
    Record {
        /// The name of the dataset.
        dataset: String,
    },
    /// Stores the recorded episode.
    Keep {},
    /// Drops the recorded episode.
    Discard {},
    /// Ends recording.
    Finish {},
}

/// A message of the server.
#[derive(Clone, Debug, Serialize)]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum Reply {
    /// An episode started.
    Started {
        /// The seed.
        seed: u64,
        /// The value of every factor.
        factors: serde_json::Map<String, serde_json::Value>,
        /// The command that writes the first frame.
        command: String,
        /// The Python program that renders it; none for another view or with wrappers.
        python: Option<String>,
    },
    /// What is recorded.
    Recording {
        /// The name of the dataset; none if nothing is recorded.
        dataset: Option<String>,
        /// The number of its episodes.
        episodes: usize,
        /// The rows of the episode that is recorded.
        rows: usize,
        /// Whether the episode has ended and waits to be kept or discarded.
        complete: bool,
    },
    /// A request failed.
    Failed {
        /// What was given, what was expected, what to do.
        message: String,
    },
}

/// What a page needs to know about an environment: its factors with their spaces, its actions, its policies.
pub fn describe(entry: &EnvEntry, spec: &EnvSpec) -> serde_json::Value {
    use serde_json::json;
    let factors = spec.variation_space.factors().iter().map(|factor| {
        let sampled = spec.variation_space.defaults().contains(&factor.key);
        json!({"key": factor.key, "space": factor.space, "default": factor.init_value, "sampled": sampled})
    });
    let named = |id: &str, summary: &str| json!({"id": id, "summary": summary});
    json!({
        "id": spec.id,
        "summary": entry.summary,
        "factors": factors.collect::<Vec<_>>(),
        "action": spec.action_space,
        "max_episode_steps": spec.max_episode_steps,
        "experts": entry.experts.iter().map(|expert| named(expert.id, expert.summary)).collect::<Vec<_>>(),
        "options": entry.options.iter().map(|o| json!({"key": o.key, "summary": o.summary, "values": o.values})).collect::<Vec<_>>(),
        "cameras": spec.cameras,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unknown_messages_and_fields_are_errors() {
        let parse = |text: &str| serde_json::from_str::<Request>(text).ok();
        assert_eq!(parse(r#"{"type": "play", "on": true}"#), Some(Request::Play { on: true }));
        assert_eq!(parse(r#"{"type": "step"}"#), Some(Request::Step {}));
        let reset = Request::Reset {
            seed: 7,
            pin: "a=1".to_owned(),
            variation: None,
            view: Some("depth".to_owned()),
            wrappers: String::new(),
            wrap_goal: false,
        };
        assert_eq!(parse(r#"{"type": "reset", "seed": 7, "pin": "a=1", "view": "depth"}"#), Some(reset));
        for text in [
            "",
            "[]",
            "null",
            r#"{"type": "exec", "command": "ls"}"#,
            r#"{"type": "reset"}"#,
            r#"{"type": "reset", "seed": -1}"#,
            r#"{"type": "reset", "seed": 1, "env": "module:x"}"#,
            r#"{"type": "act", "action": ["1"]}"#,
            r#"{"type": "step", "count": 2}"#,
            r#"{"type": "shown", "frame": 1}"#,
            r#"{"type": "keep", "dataset": "x"}"#,
            r#"{"type": "discard", "dataset": "x"}"#,
            r#"{"type": "finish", "dataset": "x"}"#,
        ] {
            assert_eq!(parse(text), None, "{text}");
        }
    }
}
