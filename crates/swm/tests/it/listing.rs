//! Tests of the commands that print lists, such as `envs`, `fovs`, `datasets`, `models` and `checkpoints`.

use crate::{Swm, text};
use serde_json::Value;

/// The spaces of the 2-D environments, recorded from the reference implementation.
const REFERENCE: &str = include_str!("reference_envs.json");

#[test]
fn environments_have_the_spaces_of_the_reference() {
    let ours = Swm::new().json(&["envs"]);
    let reference: Value = serde_json::from_str(REFERENCE).expect("the fixture is JSON");
    for (id, expected) in reference.as_object().expect("a JSON object") {
        let found = &ours[id];
        assert!(same(&found["action_space"], &expected["action_space"]), "{id}");
        assert!(same(&found["observation_space"], &expected["observation_space"]), "{id}");
        assert_eq!(found["sampling_order"], expected["sampling_order"], "{id}");
        assert_eq!(found["default_variations"], expected["default_variations"], "{id}");
        let names = |value: &Value| -> Vec<String> {
            value["variation"].as_object().expect("a JSON object").keys().cloned().collect()
        };
        assert_eq!(names(found), names(expected), "{id}");
        for (key, factor) in expected["variation"].as_object().expect("a JSON object") {
            for (field, value) in factor.as_object().expect("a JSON object") {
                let ours = &found["variation"][key][field];
                assert!(same(ours, value), "{id} {key}.{field}: {ours}, the reference has {value}");
            }
        }
    }
}

/// Whether two values are equal; 1 equals 1.0, and `found` may have additional fields.
fn same(found: &Value, expected: &Value) -> bool {
    match (found, expected) {
        (Value::Array(a), Value::Array(b)) => a.len() == b.len() && a.iter().zip(b).all(|(a, b)| same(a, b)),
        (Value::Object(a), Value::Object(b)) => b.iter().all(|(key, b)| a.get(key).is_some_and(|a| same(a, b))),
        (Value::Number(a), Value::Number(b)) => a.as_f64() == b.as_f64(),
        (a, b) => a == b,
    }
}

#[test]
fn listing_commands_print_the_registered_names() {
    let swm = Swm::new();
    for (args, names) in [
        (&["envs"][..], &["swm/PushT-v1", "swm/TwoRoom-v1"][..]),
        (&["fovs", "swm/TwoRoom-v1"], &["door.position", "agent.speed"]),
        (&["datasets"], &["no datasets"]),
        (&["checkpoints"], &["no checkpoints"]),
        (&["models"], &["lewm", "tiny", "paper"]),
        (&["devices"], &["cpu (flex)", "auto: "]),
        (&["formats"], &["lance"]),
        (&["solvers"], &["cem", "samples=300"]),
        (&["wrappers"], &["noise", "chroma-key"]),
    ] {
        let output = swm.run(args);
        assert!(output.status.success(), "{args:?}: {}", text(&output.stderr));
        for name in names {
            assert!(text(&output.stdout).contains(name), "{args:?} does not list {name}");
        }
    }
}

#[test]
fn errors_suggest_the_closest_name() {
    let swm = Swm::new();
    swm.fails(&["fovs", "swm/PushT"], 2, &["unknown environment 'swm/PushT'", "did you mean swm/PushT-v1"]);
    swm.fails(&["collect", "tworoom", "-o", "x"], 2, &["did you mean swm/TwoRoom-v1"]);
    swm.fails(&["inspect", "nothing"], 2, &["unknown dataset 'nothing'", "swm datasets"]);
    swm.fails(&["eval", "nothing", "--env", "swm/TwoRoom-v1"], 2, &["nothing", "swm checkpoints"]);
    swm.fails(&["frobnicate"], 2, &["unrecognized subcommand"]);
}
