//! Recording demonstrations, and what the page of datasets reads of them; runs that grow.

use super::TestLab;
use serde_json::json;
use std::fs;
use swm_core::{Action, Batch, ColumnSpec, DType, ResetOptions, Schema, columns};
use swm_data::{Location, StepRange, image};

#[test]
fn columns_are_summarised_in_every_episode_and_an_episode_is_a_video() {
    let lab = TestLab::start();
    let mut live = lab.live("swm/TwoRoom-v1");
    live.send(&json!({"type": "drive", "by": "hand"}));
    live.send(&json!({"type": "record", "dataset": "two"}));
    for (seed, steps) in [(1, 4), (2, 2)] {
        demonstrate(&mut live, seed, steps);
        live.send(&json!({"type": "keep"}));
    }
    while live.reply("recording")["episodes"] != 2 {}
    live.send(&json!({"type": "finish"}));
    while live.reply("recording")["dataset"] != serde_json::Value::Null {}
    let values = |query: &str| lab.json(&format!("api/values?name=two.lance&{query}"));
    // The action of the last row is missing.
    let actions = values("column=action&x=0");
    assert_eq!((&actions["min"], &actions["max"]), (&json!([-0.5, -0.5]), &json!([1.0, 1.0])));
    assert_eq!(actions["mean"], json!([0.25, 0.25]));
    assert_eq!(values("column=variation.agent.position&x=1")["max"], json!([40.0, 40.0]));
    for query in ["column=pixels", "column=action&x=2", "column=nothing", "column=", "column=../x"] {
        assert_eq!(lab.get(&format!("api/values?name=two.lance&{query}")).0, 400, "{query}");
    }
    let (status, video) = lab.get("api/video?name=two.lance&episode=1");
    assert_eq!((status, &video[4..8]), (200, &b"ftyp"[..]), "{}", String::from_utf8_lossy(&video));
    assert_eq!(lab.get("api/video?name=two.lance&episode=1&column=pixels").0, 200);
    for query in ["episode=2", "episode=0&column=action", "episode=0&column=../x", "episode=-1"] {
        assert_eq!(lab.get(&format!("api/video?name=two.lance&{query}")).0, 400, "{query}");
    }
}

#[test]
fn an_episode_of_more_values_than_are_plotted_is_refused() {
    let lab = TestLab::start();
    let folder = lab.home.path().join("datasets");
    fs::create_dir_all(&folder).expect("creating the folder");
    let schema = Schema::new(["a", "b"].map(|name| ColumnSpec::new(name, DType::Float32, [64]))).expect("a schema");
    let location = Location::from(folder.join("wide.lance"));
    let mut writer = swm_data::create(&location, &schema, swm_data::WriteOptions::default()).expect("a writer");
    writer.write_episode(&Batch::zeros(&schema, 66_000)).expect("writing the episode");
    writer.finish().expect("finishing");
    let (status, message) = lab.get("api/rows?name=wide.lance&episode=0");
    let message = String::from_utf8_lossy(&message);
    assert!(status == 400 && message.contains("8448000 values, more than"), "{status} {message}");
    assert_eq!(lab.get("api/values?name=wide.lance&column=a&x=1").0, 200);
}

/// Records an episode of some steps of the hand.
fn demonstrate(live: &mut super::Live, seed: u64, steps: usize) {
    live.send(&json!({"type": "reset", "seed": seed, "variation": "none", "pin": "agent.position=40,40;target.position=180,180"}));
    live.reply("started");
    for step in 0..steps {
        let action = if step % 2 == 0 { [1.0, 0.25] } else { [-0.5, 0.5] };
        live.send(&json!({"type": "act", "action": action}));
        live.send(&json!({"type": "step"}));
        live.frame(|header| header["step"] == (step + 1) as f64);
    }
}

#[test]
fn demonstrations_are_recorded_with_the_columns_of_a_collection() {
    let lab = TestLab::start();
    let mut live = lab.live("swm/TwoRoom-v1");
    live.send(&json!({"type": "drive", "by": "hand"}));
    live.send(&json!({"type": "record", "dataset": "demos"}));
    assert_eq!(live.reply("recording")["episodes"], 0);
    demonstrate(&mut live, 5, 6);
    live.send(&json!({"type": "discard"}));
    live.reply("recording");
    demonstrate(&mut live, 6, 8);
    live.send(&json!({"type": "keep"}));
    assert_eq!(live.reply("recording")["episodes"], 1);
    live.send(&json!({"type": "finish"}));
    live.reply("recording");
    drop(live);
    // Another session continues it.
    let mut live = lab.live("swm/TwoRoom-v1");
    live.send(&json!({"type": "record", "dataset": "demos"}));
    loop {
        if live.reply("recording")["episodes"] == 1 {
            break;
        }
    }
    demonstrate(&mut live, 7, 3);
    live.send(&json!({"type": "keep"}));
    while live.reply("recording")["episodes"] != 2 {}
    live.send(&json!({"type": "finish"}));
    live.reply("recording");
    drop(live);
    lab.wait_for_environments(0);
    check_demonstrations(&lab);
    check_page(&lab);
    // A session of another environment does not write into it.
    let mut other = lab.live("swm/PushT-v1");
    other.send(&json!({"type": "record", "dataset": "demos"}));
    let message = other.reply("failed")["message"].to_string();
    assert!(message.contains("was not recorded in this environment"), "{message}");
}

#[test]
fn kept_episodes_are_stored_when_the_lab_ends() {
    let mut lab = TestLab::start();
    let mut live = lab.live("swm/TwoRoom-v1");
    live.send(&json!({"type": "record", "dataset": "demos"}));
    live.reply("recording");
    demonstrate(&mut live, 1, 3);
    live.send(&json!({"type": "keep"}));
    while live.reply("recording")["episodes"] != 1 {}
    demonstrate(&mut live, 2, 2);
    // The lab ends while a page records an episode.
    let home = std::mem::replace(&mut lab.home, tempfile::tempdir().expect("a folder"));
    drop(lab);
    let reader = swm_data::open(Location::from(home.path().join("datasets/demos.lance"))).expect("a dataset");
    assert_eq!(reader.episodes().len(), 1);
    while !matches!(live.receive(), super::Received::Closed) {}
}

#[test]
fn a_refused_recording_leaves_the_one_that_runs() {
    let lab = TestLab::start();
    let mut live = lab.live("swm/TwoRoom-v1");
    live.send(&json!({"type": "drive", "by": "hand"}));
    live.send(&json!({"type": "record", "dataset": "good"}));
    live.reply("recording");
    demonstrate(&mut live, 1, 3);
    live.send(&json!({"type": "record", "dataset": "../x"}));
    let message = live.reply("failed")["message"].to_string();
    assert!(message.contains("'../x' is not one"), "{message}");
    live.send(&json!({"type": "keep"}));
    while live.reply("recording")["episodes"] != 1 {}
    // The same dataset again, and another one.
    live.send(&json!({"type": "record", "dataset": "good"}));
    while live.reply("recording")["rows"] != 1 {}
    live.send(&json!({"type": "record", "dataset": "other"}));
    while live.reply("recording")["dataset"] != "other" {}
    // The page learns that a recording has ended whose dataset another program replaced.
    let path = lab.home.path().join("datasets/other.lance");
    fs::remove_dir_all(&path).expect("deleting the dataset");
    fs::write(&path, "x").expect("a file in its place");
    live.send(&json!({"type": "record", "dataset": "other"}));
    while !live.reply("recording")["dataset"].is_null() {}
    live.reply("failed");
}

#[test]
fn the_name_of_a_recording_without_episodes_is_free() {
    let lab = TestLab::start();
    for (environment, dataset) in [("swm/TwoRoom-v1", "none"), ("swm/PushT-v1", "none")] {
        let mut live = lab.live(environment);
        live.send(&json!({"type": "record", "dataset": dataset}));
        assert_eq!(live.reply("recording")["dataset"], dataset, "{environment}");
        drop(live);
        lab.wait_for_environments(0);
    }
}

/// The stored actions, played again from the stored seed, give the stored states.
fn check_demonstrations(lab: &TestLab) {
    let path = lab.home.path().join("datasets/demos.lance");
    let reader = swm_data::open(Location::from(path)).expect("a dataset");
    let lengths: Vec<usize> = reader.episodes().iter().map(|episode| episode.length).collect();
    assert_eq!(lengths, [9, 4]);
    let batch =
        reader.read(&["action", "state", "episode_seed", "terminated"], &[StepRange::new(0, 0, 9)]).expect("rows");
    let (actions, states) = (batch.to_f32("action").expect("actions"), batch.to_f32("state").expect("states"));
    assert!(actions[16..].iter().all(|value| value.is_nan()), "the last action is NaN");
    let seed = batch.row(0).to_f64(columns::EPISODE_SEED).expect("a seed");
    assert_eq!(columns::join_seed([seed[0], seed[1], seed[2]]), 6);
    let mut env = swm_envs::ENVS.choose("swm/TwoRoom-v1").and_then(|choice| choice.env()).expect("an environment");
    let pins = swm_lab::still::request("agent.position=40,40;target.position=180,180", Some("none")).expect("pins");
    env.reset(6, &ResetOptions { variation: pins, ..ResetOptions::default() }).expect("a reset");
    let schema = Schema::new(env.spec().columns.clone()).expect("a schema");
    let mut seen = Batch::zeros(&schema, 1);
    for (t, action) in actions.chunks_exact(2).enumerate() {
        env.observe(&mut seen.row_mut(0));
        assert_eq!(seen.to_f32("state").expect("a state"), &states[2 * t..2 * t + 2], "row {t}");
        if t < 8 {
            env.step(Action::Continuous(action)).expect("a step");
        }
    }
    assert!(reader.manifest().is_some_and(|manifest| manifest.kind == "record"));
}

fn check_page(lab: &TestLab) {
    let found = lab.json("api/datasets");
    assert_eq!((&found["datasets"][0]["name"], &found["datasets"][0]["episodes"]), (&json!("demos.lance"), &json!(2)));
    let table = lab.json("api/episodes?name=demos.lance");
    let expected = json!({
        "index": [0, 1], "length": [8, 3], "returns": [0.0, 0.0], "success": [false, false], "key": table["key"],
    });
    assert_eq!(table, expected);
    let rows = lab.json("api/rows?name=demos.lance&episode=1");
    let action =
        rows["columns"].as_array().and_then(|columns| columns.iter().find(|column| column["name"] == "action"));
    let action = action.expect("actions");
    assert_eq!((&rows["rows"], &action["elements"], &action["values"][7]), (&json!(4), &json!(2), &json!(null)));
    let (status, jpeg) = lab.get("api/frame?name=demos.lance&episode=1&row=3&column=pixels");
    assert_eq!((status, image::image_size(&jpeg).expect("a JPEG")), (200, (32, 32)));
    let found = lab.json("api/distribution?name=demos.lance&column=action&x=0&y=1");
    assert_eq!((&found["rows"], &found["of"], &found["axes"]), (&json!(13), &json!(13), &json!([0, 1])));
    let first = &found["elements"][0];
    assert_eq!((&first["low"], &first["high"], &first["missing"]), (&json!(-0.5), &json!(1.0), &json!(2)));
    // The steps of the hand have two actions: two cells of the map.
    let map = found["map"].as_array().expect("a map");
    assert_eq!((&map[0][39], &map[39][0]), (&json!(6), &json!(5)));
    for query in ["column=pixels", "column=nothing", "column=action&x=2", "column=action&x=-1"] {
        assert_eq!(lab.get(&format!("api/distribution?name=demos.lance&{query}")).0, 400, "{query}");
    }
    for query in ["episode=2", "episode=1&row=4&column=pixels", "column=action", "column=nothing"] {
        let route = if query.contains("column") { "frame" } else { "rows" };
        assert_eq!(lab.get(&format!("api/{route}?name=demos.lance&{query}")).0, 400, "{query}");
    }
}

#[test]
fn runs_are_listed_and_followed() {
    let lab = TestLab::start();
    let run = lab.home.path().join("checkpoints/lewm");
    fs::create_dir_all(&run).expect("a folder");
    fs::write(run.join("train.jsonl"), "{\"step\": 1, \"loss\": 2.0}\n").expect("a log");
    let listed = lab.json("api/runs");
    assert_eq!((&listed["runs"][0]["name"], &listed["runs"][0]["last"]["loss"]), (&json!("lewm"), &json!(2.0)));
    let first = lab.json("api/lines?name=lewm");
    assert_eq!(first["lines"], json!([{"step": 1, "loss": 2.0}]));
    let offset = first["offset"].as_u64().expect("an offset");
    fs::write(run.join("train.jsonl"), "{\"step\": 1, \"loss\": 2.0}\n{\"step\": 2, \"loss\": 1.0}\n").expect("a log");
    assert_eq!(lab.json(&format!("api/lines?name=lewm&offset={offset}"))["lines"], json!([{"step": 2, "loss": 1.0}]));
}

/// A dataset of some episodes of Two-Room without frames.
pub fn collect(lab: &TestLab, episodes: usize) {
    use swm_eval::{CollectConfig, World, WorldConfig};
    let folder = lab.home.path().join("datasets");
    fs::create_dir_all(&folder).expect("a folder");
    let entry = swm_envs::ENVS.get("swm/TwoRoom-v1").expect("an environment");
    let config = WorldConfig { envs: 1, image: None, threads: 1, max_episode_steps: Some(5), ..WorldConfig::default() };
    let mut world = World::new(entry, config).expect("an environment");
    let mut policy = super::expert(entry, "expert", &world).expect("a policy");
    let config = CollectConfig { episodes, ..CollectConfig::default() };
    let schema = world.collect_schema(&config).expect("a schema");
    let location = Location::from(folder.join("rooms.lance"));
    let writer = swm_data::create(location, &schema, swm_data::WriteOptions::default()).expect("a writer");
    world.collect(&mut *policy, writer, &config, &mut swm_core::run::Control::new()).expect("episodes");
}

#[test]
fn episodes_are_examined_cut_and_saved_as_a_new_dataset() {
    let lab = TestLab::start();
    collect(&lab, 4);
    let found = lab.json("api/doctor?name=rooms.lance");
    let problems = found["findings"].as_array().expect("findings").iter().filter(|one| one["severity"] == "problem");
    assert_eq!((&found["episodes"], problems.count()), (&json!(4), 0));
    let key = lab.json("api/episodes?folder=0&name=rooms.lance")["key"].as_str().expect("a key").to_owned();
    let save = |body: &str| lab.post("api/save", &body.replacen('{', &format!("{{\"key\": \"{key}\", "), 1));
    let (status, body) = save(r#"{"folder": 0, "name": "rooms.lance", "target": "cut", "episodes": [0, 3]}"#);
    assert_eq!((status, body.as_str()), (200, r#"{"episodes":2}"#));
    let of = |name: &str| lab.json(&format!("api/episodes?name={name}"))["length"].clone();
    let (all, cut) = (of("rooms.lance"), of("cut.lance"));
    assert_eq!(cut, json!([all[0], all[3]]));
    for body in [
        r#"{"folder": 0, "name": "rooms.lance", "target": "cut", "episodes": [1]}"#,
        r#"{"folder": 0, "name": "rooms.lance", "target": "../x", "episodes": [1]}"#,
        r#"{"folder": 0, "name": "../rooms.lance", "target": "x", "episodes": [1]}"#,
        r#"{"folder": 1, "name": "rooms.lance", "target": "x", "episodes": [1]}"#,
        r#"{"folder": 0, "name": "rooms.lance", "target": "x", "episodes": [4]}"#,
        r#"{"folder": 0, "name": "rooms.lance", "target": "x", "episodes": []}"#,
        r#"{"folder": 0, "name": "rooms.lance", "target": "x", "episodes": [1], "overwrite": true}"#,
        "no JSON",
    ] {
        assert_eq!(save(body).0, 400, "{}", &body[..body.len().min(100)]);
    }
    // Positions in the table of another content are no choice.
    fs::remove_dir_all(lab.home.path().join("datasets/rooms.lance")).expect("removing the dataset");
    collect(&lab, 6);
    let (status, message) = save(r#"{"folder": 0, "name": "rooms.lance", "target": "x", "episodes": [1]}"#);
    assert!(status == 400 && message.contains("other episodes"), "{message}");
    let keyless = r#"{"folder": 0, "name": "rooms.lance", "target": "x", "episodes": [1]}"#;
    assert_eq!(lab.post("api/save", keyless).0, 400, "the table is not named");
    // The answer to a body that is too long may be lost, because the connection closes before all of it is sent.
    assert!([400, 0].contains(&save(&"x".repeat(2 << 20)).0));
    assert_eq!(of("cut.lance"), cut, "an existing dataset stays as it is");
    assert!(!lab.home.path().join("datasets/x.lance").exists());
}
