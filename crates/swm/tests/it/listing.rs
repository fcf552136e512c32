//! What there is: `envs`, `fovs`, `datasets`, `models`, `checkpoints`.

use crate::{Swm, text};
use serde_json::Value;

/// Facts of the reference's environments in two dimensions, cut from `reference/envs.json`; no bound is null.
const REFERENCE: &str = include_str!("reference_envs.json");

#[test]
fn environments_declare_the_factors_of_the_reference() {
    let ours = Swm::new().json(&["envs"]);
    let theirs: Value = serde_json::from_str(REFERENCE).expect("the fixture is JSON");
    for (id, wanted) in theirs.as_object().expect("an object") {
        let found = &ours[id];
        assert!(same(&found["action_space"], &wanted["action_space"]), "{id}");
        assert!(same(&found["observation_space"], &wanted["observation_space"]), "{id}");
        assert_eq!(found["sampling_order"], wanted["sampling_order"], "{id}");
        assert_eq!(found["default_variations"], wanted["default_variations"], "{id}");
        let names = |value: &Value| -> Vec<String> {
            value["variation"].as_object().expect("an object").keys().cloned().collect()
        };
        assert_eq!(names(found), names(wanted), "{id}");
        for (key, factor) in wanted["variation"].as_object().expect("an object") {
            for (field, value) in factor.as_object().expect("an object") {
                let ours = &found["variation"][key][field];
                assert!(same(ours, value), "{id} {key}.{field}: {ours}, the reference has {value}");
            }
        }
    }
}

/// Whether a value is the wanted one, whether numbers are written as 1 or 1.0; it may have further fields.
fn same(found: &Value, wanted: &Value) -> bool {
    match (found, wanted) {
        (Value::Array(a), Value::Array(b)) => a.len() == b.len() && a.iter().zip(b).all(|(a, b)| same(a, b)),
        (Value::Object(a), Value::Object(b)) => b.iter().all(|(key, b)| a.get(key).is_some_and(|a| same(a, b))),
        (Value::Number(a), Value::Number(b)) => a.as_f64() == b.as_f64(),
        (a, b) => a == b,
    }
}

#[test]
fn tables_are_for_people() {
    let swm = Swm::new();
    for (args, words) in [
        (&["envs"][..], &["swm/PushT-v1", "swm/TwoRoom-v1"][..]),
        (&["fovs", "swm/TwoRoom-v1"], &["door.position", "agent.speed"]),
        (&["datasets"], &["no datasets"]),
        (&["checkpoints"], &["no checkpoints"]),
        (&["models"], &["lewm", "tiny", "paper"]),
        (&["formats"], &["lance"]),
        (&["solvers"], &["cem", "samples=300"]),
        (&["wrappers"], &["noise", "chroma-key"]),
    ] {
        let output = swm.run(args);
        assert!(output.status.success(), "{args:?}: {}", text(&output.stderr));
        for word in words {
            assert!(text(&output.stdout).contains(word), "{args:?} does not show {word}");
        }
    }
}

#[test]
fn wrong_names_get_the_nearest_right_ones() {
    let swm = Swm::new();
    swm.refuses(&["fovs", "swm/PushT"], 2, &["unknown environment 'swm/PushT'", "did you mean swm/PushT-v1"]);
    swm.refuses(&["collect", "tworoom", "-o", "x"], 2, &["did you mean swm/TwoRoom-v1"]);
    swm.refuses(&["inspect", "nothing"], 2, &["unknown dataset 'nothing'", "swm datasets"]);
    swm.refuses(&["eval", "nothing", "--env", "swm/TwoRoom-v1"], 2, &["nothing", "swm checkpoints"]);
    swm.refuses(&["frobnicate"], 2, &["unrecognized subcommand"]);
}
