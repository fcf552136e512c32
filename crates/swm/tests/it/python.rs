//! Test of collected datasets with Python's `lance` package.

use crate::{Swm, text};

/// Prints the contents of a dataset as JSON.
const SCRIPT: &str = r#"
import json, sys
import lance, numpy as np, pyarrow as pa
dataset = lance.dataset(sys.argv[1])
dataset.validate()
table = dataset.to_table()
action = np.array(table["action"].to_pylist(), dtype=np.float32)
print(json.dumps({
    "rows": dataset.count_rows(),
    "episodes": len(set(table["episode_idx"].to_pylist())),
    "state": str(table.schema.field("state").type),
    "first_bytes": list(table["pixels"][0].as_py()[:4]),
    "nan_actions": int(np.isnan(action).any(axis=1).sum()),
    "largest_action": float(np.nanmax(np.abs(action))),
}))
"#;

#[test]
fn python_lance_opens_a_collected_dataset() {
    let Some(python) = std::env::var_os("SWM_LANCE_PYTHON") else {
        println!("SKIPPED: set SWM_LANCE_PYTHON to a Python with pylance, as `make test` does");
        return;
    };
    let swm = Swm::new();
    swm.json(&["collect", "swm/PushT-v1", "-o", "push", "--image", "64", "--episodes", "3", "--max-steps", "20"]);
    let ours = swm.json(&["inspect", "push"]);
    let output = std::process::Command::new(python)
        .args(["-c", SCRIPT])
        .arg(swm.path("datasets/push.lance"))
        .output()
        .expect("Python starts");
    assert!(output.status.success(), "{}", text(&output.stderr));
    let found: serde_json::Value = serde_json::from_slice(&output.stdout).expect("parsing the JSON");
    assert_eq!(found["rows"], ours["steps"]);
    assert_eq!(found["episodes"], 3);
    // An episode has no action after its last observation.
    assert_eq!(found["nan_actions"], 3);
    assert!(found["largest_action"].as_f64().is_some_and(|a| a <= 1.0), "{found}");
    assert_eq!(found["state"], "fixed_size_list<item: double>[7]");
    assert_eq!(found["first_bytes"], serde_json::json!([b'q', b'o', b'i', b'f']));
}
