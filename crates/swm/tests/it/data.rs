//! Tests of `swm convert`, `inspect`, `datasets`, `doctor` and `bench data`.

use crate::{Swm, text};
use std::path::Path;

fn collect(swm: &Swm, name: &str) {
    swm.json(&["collect", "swm/TwoRoom-v1", "-o", name, "--image", "32", "--episodes", "5", "--max-steps", "30"]);
}

#[test]
fn converted_dataset_has_the_same_content() {
    let swm = Swm::new();
    collect(&swm, "rooms");
    let report = swm.json(&["convert", "rooms", "copy", "--codec", "png"]);
    assert_eq!((&report["episodes"], &report["kept"]), (&5.into(), &0.into()));
    let columns = report["columns"].as_array().expect("an array of columns");
    assert!(columns.iter().all(|column| column["exact"] == true), "{columns:?}");
    let checksum = |name: &str| swm.json(&["inspect", name, "--checksum"])["checksum"].clone();
    assert_eq!(checksum("rooms"), checksum("copy"));
    assert_eq!(checksum("copy"), report["checksum"]);
    assert_eq!(swm.json(&["convert", "rooms", "copy"])["kept"], 5, "the episodes exist already");
    let output = text(&swm.run(&["convert", "rooms", "jpeg", "--codec", "jpeg", "--quality", "90"]).stdout);
    assert!(output.contains("'pixels' is lossy") && output.contains("verified") && output.contains(" dB"), "{output}");

    swm.fails(&["convert", "rooms", "copy", "--mode", "error"], 2, &["exists already"]);
    swm.fails(&["convert", "rooms", "other", "--format", "lanse"], 2, &["did you mean lance"]);
    swm.fails(&["convert", "romos", "other"], 2, &["did you mean rooms"]);
    swm.fails(&["convert", "rooms", "ftp://host/there.lance"], 2, &["ftp://"]);
    collect(&swm, "others");
    swm.json(&[
        "collect",
        "swm/TwoRoom-v1",
        "-o",
        "others",
        "--overwrite",
        "--image",
        "32",
        "--episodes",
        "2",
        "--seed",
        "9",
    ]);
    swm.fails(&["convert", "rooms", "others"], 2, &["not the beginning of the source", "overwrite"]);
    assert_eq!(swm.json(&["convert", "rooms", "others", "--mode", "append"])["episodes"], 7);

    let inspected = text(&swm.run(&["inspect", "rooms"]).stdout);
    for word in ["5 episodes", "rows per episode", "█", "pixels", "made by collect", "swm/TwoRoom-v1", "content hash"]
    {
        assert!(inspected.contains(word), "{word}: {inspected}");
    }
    let listed = swm.json(&["datasets"]);
    let names: Vec<&str> =
        listed.as_array().expect("an array of datasets").iter().filter_map(|d| d["name"].as_str()).collect();
    assert_eq!(names, ["copy", "jpeg", "others", "rooms"]);
}

#[test]
fn colours_of_frames_are_a_setting_of_a_training() {
    let swm = Swm::new();
    collect(&swm, "rooms");
    let found = swm.json(&["inspect", "rooms", "--colours", "3"]);
    assert_eq!(found, swm.json(&["inspect", "rooms", "--colours", "3"]));
    assert_eq!(found["colours"].as_array().map(Vec::len), Some(3), "{found}");
    let printed = text(&swm.run(&["inspect", "rooms", "--colours", "3"]).stdout);
    let setting = printed.trim().trim_matches('\'');
    let config = text(&swm.run(&["train", "pldm", "--preset", "colours", "--print-config", setting]).stdout);
    let given = found["colours"][0][0].as_f64().expect("a colour");
    assert!(config.contains(&format!("{given:?}")) && config.contains("find_colours = 6"), "{setting}: {config}");
    swm.fails(&["inspect", "rooms", "--colours", "1"], 2, &["--colours"]);
    swm.json(&["collect", "swm/TwoRoom-v1", "--output", "blind", "--episodes", "1", "--max-steps", "3", "--no-pixels"]);
    swm.fails(&["inspect", "blind", "--colours", "3"], 2, &["pixels"]);
}

#[test]
fn doctor_finds_truncated_files() {
    let swm = Swm::new();
    collect(&swm, "rooms");
    let clean = swm.json(&["doctor", "rooms"]);
    assert_eq!((&clean["problems"], clean["sound"].as_array().map(Vec::len)), (&0.into(), Some(5)));
    let lewm = clean["models"]
        .as_array()
        .expect("an array of models")
        .iter()
        .find(|fit| fit["model"] == "LeWM")
        .expect("the doctor lists LeWM");
    assert_eq!(lewm["missing"].as_array().map(Vec::len), Some(0), "{lewm}");
    let output = text(&swm.run(&["doctor", "rooms"]).stdout);
    assert!(output.contains("no problems") && output.contains("TD-MPC2"), "{output}");

    // Reading the truncated file fails; opening the dataset may fail, too.
    let file = largest(&swm.path("datasets/rooms.lance/data"));
    let bytes = std::fs::read(&file).expect("the file is readable");
    std::fs::write(&file, &bytes[..bytes.len() / 2]).expect("the file is writable");
    let output = swm.run(&["doctor", "rooms"]);
    assert!(text(&output.stdout).contains("problem") || text(&output.stderr).contains("rooms"));
    assert_eq!(output.status.code(), Some(1), "{}", text(&output.stderr));
    assert!(!text(&output.stderr).contains("panicked"));
    swm.fails(&["doctor", "romos"], 2, &["did you mean rooms"]);
}

fn largest(folder: &Path) -> std::path::PathBuf {
    let entries = std::fs::read_dir(folder).expect("listing the folder").flatten();
    entries
        .map(|entry| entry.path())
        .max_by_key(|path| path.metadata().map_or(0, |m| m.len()))
        .expect("the folder has a file")
}

#[test]
fn bench_data_measures_loading() {
    let swm = Swm::new();
    let small =
        ["--episodes", "14", "--steps", "24", "--size", "32", "--pairs", "1", "--seconds", "0.05", "--epochs", "2"];
    let found = swm.json(&[&["bench", "data", "swm/TwoRoom-v1"][..], &small].concat());
    let rates = found["rates"].as_array().expect("an array of rates");
    let named = |name: &str| rates.iter().find(|row| row["what"] == name).unwrap_or_else(|| panic!("{name}: {found}"));
    assert!(named("lance, lossless")["rate"].as_f64().expect("the rate is a number") > 0.0);
    assert!(named("lance, jpeg, all cached on disk")["ours"][0].as_f64().expect("the rate is a number") > 0.0);
    assert_eq!(found["resident"].as_array().map(Vec::len), Some(2));
    swm.fails(&["bench", "data", "--pairs", "0"], 2, &["at least 1 pair"]);
}

#[test]
fn datasets_and_capsules_have_croissant_metadata_and_datasheets() {
    let swm = Swm::new();
    swm.json(&["collect", "swm/TwoRoom-v1", "-o", "rooms.h5", "--image", "32", "--episodes", "2", "--max-steps", "5"]);
    let described =
        ["inspect", "rooms.h5", "--licence", "MIT", "--author", "Ada", "--url", "https://example.org/rooms"];
    let found = swm.json(&[&described[..], &["--croissant"]].concat());
    assert_eq!((&found["license"], &found["creator"]["name"]), (&"MIT".into(), &"Ada".into()));
    assert_eq!((&found["name"], &found["conformsTo"]), (&"rooms".into(), &"http://mlcommons.org/croissant/1.0".into()));
    let file = &found["distribution"][0];
    let bytes = std::fs::metadata(swm.path("rooms.h5")).expect("the file").len();
    assert_eq!((&file["contentUrl"], &file["contentSize"]), (&"rooms.h5".into(), &format!("{bytes} B").into()));
    assert!(file["sha256"].as_str().is_some_and(|hash| hash.len() == 64), "{file}");
    let columns = found["variableMeasured"].as_array().expect("columns");
    let column = |name: &str| columns.iter().find(|column| column["name"] == name).unwrap_or_else(|| panic!("{name}"));
    let types = [&column("action")["value"], &column("pixels")["value"]];
    assert_eq!(types, [&serde_json::Value::from("float32 [2]"), &"uint8 [32, 32, 3]".into()]);
    let sheet = text(&swm.run(&[&described[..], &["--datasheet"]].concat()).stdout);
    for part in [
        "# Datasheet: rooms",
        "2 episodes",
        "| action | float32 | [2] |",
        "Licence: MIT",
        "Not stated",
        "swm/TwoRoom-v1",
    ] {
        assert!(sheet.contains(part), "{part}: {sheet}");
    }
    let capsule = swm.json(&["inspect", "zoo:two-room/pldm", "--croissant"]);
    assert!(capsule["license"].is_string() && capsule["distribution"][0]["sha256"].is_string(), "{capsule}");
    assert!(capsule["variableMeasured"].to_string().contains("success rate"), "{capsule}");
    swm.fails(&["inspect", "zoo:two-room/pldm", "--datasheet", "--licence", "MIT"], 2, &["states it itself"]);
    swm.fails(&["inspect", "rooms.h5", "--licence", "MIT"], 2, &["--croissant"]);
}
