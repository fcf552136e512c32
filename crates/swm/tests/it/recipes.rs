//! Tests of recipes.

use crate::{Swm, text};
use serde_json::Value;
use std::fs;

const RECIPE: &str = r#"
summary = "A model that is trained for two steps"

[[collect]]
name = "rooms"
env = "swm/TwoRoom-v1"
policy = ["explore:0.7", "random:0.3"]
episodes = 12
image = 32
max-steps = 30

[[train]]
name = "small"
model = "lewm"
data = "rooms"
settings = { schedule = { steps = 2, warmup = 0 }, data.batch_size = 16, model.image = 32 }

[[eval]]
name = "found"
policies = ["small"]
episodes = 3
budget = 10
solver = "cem,samples=8,iterations=1,elites=2"
"#;

fn write(swm: &Swm, name: &str, text: &str) {
    fs::write(swm.path(name), text).expect("a recipe");
}

fn run(swm: &Swm, recipe: &str, out: &str, more: &[&str]) -> Value {
    swm.json(&[&["train", "--recipe", recipe, "-o", out], more].concat())
}

#[test]
fn recipe_runs_what_is_missing_and_compares_hashes() {
    let swm = Swm::new();
    write(&swm, "small.toml", RECIPE);
    let first = run(&swm, "small.toml", "first", &[]);
    assert!(swm.path("first/index.html").is_file() && swm.path("first/found/results.json").is_file());
    let hashes: Vec<&str> =
        first["hashes"].as_array().expect("hashes").iter().filter_map(|row| row["hash"].as_str()).collect();
    assert_eq!(hashes.len(), 2);

    // Finished steps are not repeated; a missing one is.
    let changed = |name: &str| fs::metadata(swm.path("first").join(name)).and_then(|file| file.modified()).expect(name);
    let names = ["small/checkpoint/weights.safetensors", "found/results.json"];
    let before = names.map(changed);
    fs::remove_dir_all(swm.path("first/found")).expect("removing the results");
    let unfinished = swm.path("first/.recipe.json.4242.tmp");
    fs::write(&unfinished, "{").expect("writing what a kill leaves");
    assert_eq!(run(&swm, "small.toml", "first", &[])["hashes"], first["hashes"]);
    assert!(!unfinished.exists());
    assert_eq!(changed(names[0]), before[0]);
    assert!(changed(names[1]) > before[1]);

    // An output that is a link to a folder of the user is not written to.
    fs::rename(swm.path("first/found"), swm.path("mine")).expect("moving the results");
    std::os::unix::fs::symlink(swm.path("mine"), swm.path("first/found")).expect("making a link");
    swm.fails(&["train", "--recipe", "small.toml", "-o", "first"], 2, &["first/found", "symbolic link"]);
    fs::remove_file(swm.path("first/found")).expect("removing the link");
    fs::rename(swm.path("mine"), swm.path("first/found")).expect("moving the results");

    // With the hashes in the recipe, another run says that they are equal.
    let expected = |hash: &str| {
        let insert = |text: &str, name: &str, hash: &str| text.replace(name, &format!("{name}\nhash = \"{hash}\""));
        insert(&insert(RECIPE, "name = \"rooms\"", hashes[0]), "name = \"small\"", hash)
    };
    write(&swm, "small.toml", &expected(hashes[1]));
    let printed = |out: &str, more: &[&str]| {
        let output = swm.run(&[&["train", "--recipe", "small.toml", "-o", out], more].concat());
        assert!(output.status.success(), "{}", text(&output.stderr));
        text(&output.stdout)
    };
    assert_eq!(printed("second", &[]).matches("equal to the recorded hash").count(), 2);
    write(&swm, "small.toml", &expected(&"0".repeat(64)));
    assert!(printed("first", &[]).contains("(recorded as 0000"));
    write(&swm, "small.toml", &expected("0000"));
    swm.fails(&["train", "--recipe", "small.toml", "-o", "other"], 2, &["0000", "64 hexadecimal digits"]);
    write(&swm, "small.toml", &expected(hashes[1]));
    let settings = ["rooms.episodes=13", "small.schedule.steps=3"];
    assert_eq!(printed("third", &settings).matches("settings were changed").count(), 2);
    assert_eq!(swm.json(&["inspect", "third/rooms.lance"])["episodes"], 13);
    assert_eq!(swm.json(&["checkpoints", "show", "third/small"])["config"]["schedule"]["steps"], 3);
    swm.fails(&["train", "--recipe", "small.toml", "-o", "third"], 2, &["other settings or steps", "--output"]);
}

#[test]
fn recipes_are_listed_and_checked_before_they_run() {
    let swm = Swm::new();
    let listed = swm.json(&["recipes"]);
    assert!(listed.as_array().is_some_and(|rows| rows.iter().any(|row| row["name"] == "two-room/pldm")), "{listed}");
    assert_eq!(swm.json(&["recipes", "two-room/pldm"])["train"][0]["model"], "pldm");
    swm.fails(&["recipes", "two-room/pldn"], 2, &["did you mean two-room/pldm"]);
    swm.fails(&["train", "--recipe", "two-room/pldm"], 2, &["--output"]);
    let refused = |from: &str, to: &str, code: i32, parts: &[&str]| {
        write(&swm, "bad.toml", &RECIPE.replacen(from, to, 1));
        swm.fails(&["train", "--recipe", "bad.toml", "-o", "bad"], code, parts);
        assert!(!swm.path("bad").exists(), "{to}");
    };
    refused("episodes = 12", "episode = 12", 2, &["[[collect]] 'rooms' of the recipe (line ", "--episodes"]);
    refused("budget = 10", "budget = \"ten\"", 2, &["[[eval]] 'found'", "ten"]);
    refused("steps = 2", "setps = 2", 2, &["did you mean", "[[train]] 'small' of the recipe (line "]);
    refused("model = \"lewm\"", "model = \"lwem\"", 2, &["did you mean lewm"]);
    refused("name = \"small\"", "name = \"../small\"", 2, &["'../small'"]);
    refused("name = \"small\"", "name = \"rooms\"", 2, &["two steps have the name 'rooms' (line "]);
    refused("image = 32", "output = \"/tmp/x\"", 2, &["'output', which a recipe may not"]);
    refused("image = 32", "\"output=/tmp/x\" = 1", 2, &["which is no option"]);
    refused("policies = [\"small\"]", "policies = [\"--trust\"]\ntrust = true", 2, &["'trust'"]);
    refused("summary", "sum", 2, &["sum"]);
    refused(
        "env = \"swm/TwoRoom-v1\"",
        "env = \"evil_mod:X-v0\"",
        2,
        &["bad.toml", "imports a Python module", "--trust"],
    );
    let contradictions = [
        ("image = 32", "image = 32\nno-pixels = true", "[[collect]] 'rooms'"),
        ("explore:0.7", "expolre:0.7", "did you mean"),
        ("image = 32", "image = 32\nview = [\"nowhere\"]", "[[collect]] 'rooms'"),
        ("image = 32", "image = 32\npin = [\"agent.colour=1\"]", "did you mean agent.color"),
        (
            "budget = 10",
            "budget = 10\nenv = \"swm/TwoRoom-v1\"\nshift = [\"agent.colour\"]",
            "did you mean agent.color",
        ),
        ("policies = [\"small\"]", "policies = [\"small\", \"other\"]", "other"),
        ("cem,samples=8", "cme,samples=8", "did you mean"),
    ];
    for (from, to, part) in contradictions {
        refused(from, to, 2, &[part]);
    }
    refused("data = \"rooms\"", "data = \"s3://bucket/rooms.lance\"", 2, &["s3://bucket", "network connection"]);
    refused(
        "model = \"lewm\"",
        "model = \"lewm\"\npreset = \"other.toml\"",
        2,
        &["the preset 'other.toml'", "--trust"],
    );
    refused("image = 32", "wrapper = \"chroma-key,media=/dev/zero\"", 2, &["reads files"]);
    let tracked = ["the tracker 'jsonl,wandb'", "which is started", "--trust"];
    refused("model = \"lewm\"", "model = \"lewm\"\nlog = \"jsonl,wandb\"", 2, &tracked);
    let written = ["the folder '/elsewhere'", "which is written to", "--trust"];
    refused("model = \"lewm\"", "model = \"lewm\"\nfeature-cache = \"/elsewhere\"", 2, &written);
    swm.fails(&["train", "--recipe", "bad.toml", "-o", "bad", "room.episodes=1"], 2, &["did you mean rooms"]);
    swm.fails(&["train", "--recipe", "/dev/zero", "-o", "bad"], 2, &["ends with .toml"]);
}

#[test]
fn outputs_that_steps_use_are_made_before_them() {
    let swm = Swm::new();
    let (small, trained) = ("model = \"lewm\"", "model = \"gcbc\"\ndata = \"rooms\"\n\n");
    let acts = "[[train]]\nname = \"acts\"\nmodel = \"inverse\"\nencoder = \"late\"\ndata = \"rooms\"\n\n";
    let late = format!("[[train]]\nname = \"late\"\n{trained}");
    let [before, after] = [format!("{acts}{late}[[eval]]"), format!("{late}{acts}[[eval]]")];
    for (from, to, part) in [
        ("data = \"rooms\"", "data = \"small\"", "'data' names the step 'small', which is the step itself"),
        (
            small,
            "model = \"inverse\"\nencoder = \"small\"",
            "'encoder' names the step 'small', which is the step itself",
        ),
        (small, "model = \"inverse\"\nencoder = \"rooms\"", "which is a step of [[collect]], and no training"),
        ("[\"small\"]", "[\"rooms\"]", "'policies' names the step 'rooms', which is a step of [[collect]]"),
        ("[\"explore:0.7\", \"random:0.3\"]", "\"small\"", "datasets are collected before any model is trained"),
        ("image = 32 }", "image = 32, model.weights = \"small\" }", "'model.weights' names the step 'small'"),
        ("[[eval]]", &before, "'encoder' names the step 'late', which runs after it"),
        ("[[eval]]", &after, "'encoder' names the step 'late', which trains 'gcbc'"),
        (small, "model = \"lewm\"\nencoder = \"/runs/other\"", "lewm trains its own encoder"),
        ("[\"small\"]", "[\"rooms\"]", "write ./rooms, if a path is meant"),
    ] {
        write(&swm, "bad.toml", &RECIPE.replacen(from, to, 1));
        swm.fails(&["train", "--recipe", "bad.toml", "-o", "bad"], 2, &["of the recipe (line ", part]);
        assert!(!swm.path("bad").exists(), "{to}");
    }
    let device = "device = \"abacus:0\"";
    for (from, step) in [(small, "'small' of the recipe (line "), ("budget = 10", "'found' of the recipe (line ")] {
        write(&swm, "bad.toml", &RECIPE.replacen(from, &format!("{from}\n{device}"), 1));
        let parts = ["unknown device 'abacus'", step];
        swm.fails(&["train", "--recipe", "bad.toml", "-o", "bad"], 2, &parts);
        assert!(!swm.path("bad").exists(), "{step}");
    }
}

/// A recipe of one small collection.
const FEW: &str = r#"
summary = "Few episodes"

[[collect]]
name = "rooms"
env = "swm/TwoRoom-v1"
policy = "random"
episodes = 2
max-steps = 10
no-pixels = true
"#;

#[test]
fn longer_datasets_are_used_only_where_a_recipe_allows_them() {
    let swm = Swm::new();
    write(&swm, "few.toml", FEW);
    fs::create_dir(swm.path("run")).expect("a folder");
    let longer = ["swm/TwoRoom-v1", "--policy", "random", "--episodes", "3", "--max-steps", "10", "--no-pixels"];
    swm.json(&[&["collect", "-o", "run/rooms.lance"], &longer[..]].concat());
    let args = ["train", "--recipe", "few.toml", "-o", "run"];
    swm.fails(&args, 2, &["run/rooms.lance", "3 episodes", "'rooms' asks for 2", "more-episodes = true"]);
    // What the recipe allows now is no other run.
    write(&swm, "few.toml", &FEW.replace("episodes = 2", "episodes = 2\nmore-episodes = true"));
    swm.json(&args);
    assert_eq!(swm.json(&["inspect", "run/rooms.lance"])["episodes"], 3);
    // A finished step is compared with the recipe as it is now.
    write(&swm, "few.toml", FEW);
    swm.fails(&args, 2, &["3 episodes", "'rooms' asks for 2"]);
    // A dataset with the recorded hash is the one; changed settings ask for another.
    fs::remove_file(swm.path("run/recipe.json")).expect("removing the record");
    let hash = swm.json(&["inspect", "run/rooms.lance", "--checksum"])["content_hash"].clone();
    let recorded = format!("episodes = 2\nhash = {hash}");
    write(&swm, "few.toml", &FEW.replace("episodes = 2", &recorded));
    assert_eq!(swm.json(&args)["hashes"][0]["hash"], hash);
    fs::remove_file(swm.path("run/recipe.json")).expect("removing the record");
    swm.fails(&[&args[..], &["rooms.seed=9"]].concat(), 2, &["3 episodes", "'rooms' asks for 2"]);
    write(&swm, "few.toml", &FEW.replace("episodes = 2", "episodes = 2\nmore-episodes = \"yes\""));
    swm.fails(&["train", "--recipe", "few.toml", "-o", "other"], 2, &["[[collect]] 'rooms'", "--more-episodes"]);
}

#[test]
fn folders_that_datasets_cannot_be_written_to_are_not_made() {
    let swm = Swm::new();
    write(&swm, "few.toml", FEW);
    swm.fails(&["train", "--recipe", "few.toml", "-o", "a\nb"], 2, &["a\\nb", "control character"]);
    assert!(!swm.path("a\nb").exists());
}

#[test]
fn columns_of_a_model_are_compared_with_the_collection_before_a_recipe_runs() {
    let swm = Swm::new();
    for (from, to, parts) in [
        (
            "model.image = 32",
            "model.image = 16",
            &["[[train]] 'small' of the recipe", "[32, 32, 3]", "[16, 16, 3]"][..],
        ),
        ("\nimage = 32", "\nno-pixels = true", &["[[train]] 'small' of the recipe", "unknown column 'pixels'"]),
    ] {
        write(&swm, "bad.toml", &RECIPE.replacen(from, to, 1));
        swm.fails(&["train", "--recipe", "bad.toml", "-o", "bad"], 2, parts);
        assert!(!swm.path("bad").exists(), "{to}");
    }
}

/// A recipe of one collection and one training with `train` in its table.
fn training(train: &str) -> String {
    let (collect, _) = RECIPE.split_once("[[train]]").expect("a training");
    format!("{collect}[[train]]\nname = \"small\"\ndata = \"rooms\"\n{train}\n")
}

#[test]
fn training_of_a_recipe_begins_with_the_weights_of_an_earlier_one() {
    let swm = Swm::new();
    let (collect, _) = RECIPE.split_once("[[train]]").expect("a training");
    let step = |name: &str, weights: &str| {
        format!(
            "[[train]]\nname = \"{name}\"\nmodel = \"gcbc\"\npreset = \"small\"\ndata = \"rooms\"\n[train.settings]\n\
             model.image = 32\nmodel.weights = \"{weights}\"\nmodel.frozen = {}\nschedule = {{ steps = 1, warmup = 0 }}\n\
             data.batch_size = 16\n",
            !weights.is_empty()
        )
    };
    write(&swm, "chain.toml", &format!("{collect}{}{}", step("first", ""), step("second", "first")));
    run(&swm, "chain.toml", "chain", &[]);
    let config = fs::read_to_string(swm.path("chain/second/checkpoint/config.json")).expect("a configuration");
    assert!(config.contains("chain/first/checkpoint/weights.safetensors"), "{config}");
    // A later training is no source of weights.
    write(&swm, "late.toml", &format!("{collect}{}{}", step("first", "second"), step("second", "")));
    swm.fails(
        &["train", "--recipe", "late.toml", "-o", "late"],
        2,
        &["[[train]] 'first'", "names the step 'second', which runs after it"],
    );
}

#[test]
fn recipe_of_a_stranger_chooses_no_weights_of_a_hub() {
    let swm = Swm::new();
    let weights = "evil-owner/evil-repo";
    for (train, parts) in [
        (format!("model = [\"dino_wm\", \"model.weights={weights}\"]"), vec!["'model' that is not one text"]),
        (
            format!("model = \"dino_wm\"\n[train.settings]\n\"model.weights=\\\"{weights}\\\" #\" = 1"),
            vec!["the setting"],
        ),
        ("model = \"dino_wm\"\n[train.settings]\n\"a b\" = 1".to_owned(), vec!["the setting 'a b'"]),
        ("model = \"dino_wm\"\npreset = \"paper\"".to_owned(), vec!["facebook/dinov2-small", "downloaded", "--trust"]),
        ("model = \"gcbc\"\npreset = \"paper\"".to_owned(), vec!["facebook/dinov2-small", "downloaded", "--trust"]),
        (format!("model = \"dino_wm\"\nsettings = {{ model.weights = \"{weights}\" }}"), vec![weights, "downloaded"]),
        (format!("model = \"dino_wm\"\n[train.settings]\n\"model.weights\" = \"{weights}\""), vec![weights, "--trust"]),
        ("model = \"lewm\"\npreset = \"other.toml/\"".to_owned(), vec!["the preset 'other.toml/'", "--trust"]),
        ("model = \"lewm\"\npreset = \"other.toml/.\"".to_owned(), vec!["the preset 'other.toml/.'", "--trust"]),
        ("model = \"lewm\"\npreset = \"tyni\"".to_owned(), vec!["unknown preset 'tyni'", "tiny"]),
    ] {
        write(&swm, "bad.toml", &training(&train));
        // No server answers at this address; a recipe that is refused asks none.
        let args = ["train", "--recipe", "bad.toml", "-o", "bad"];
        let output = swm.command(&args).env("HF_ENDPOINT", "http://127.0.0.1:9").output().expect("swm starts");
        let error = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{train}: {error}");
        assert!(parts.iter().all(|part| error.contains(part)), "{train}: {error}");
        assert!(!swm.path("bad").exists(), "{train}");
    }
}

#[test]
fn recipe_refuses_servers_as_folders_and_countless_steps() {
    let swm = Swm::new();
    write(&swm, "small.toml", RECIPE);
    for folder in ["s3://bucket/x", "http://127.0.0.1:9/x"] {
        swm.fails(&["train", "--recipe", "small.toml", "-o", folder], 2, &[folder, "address of a server"]);
    }
    assert!(!swm.path("s3:").exists() && !swm.path("http:").exists());
    let step = |index: usize| format!("[[collect]]\nname = \"r{index}\"\nenv = \"swm/TwoRoom-v1\"\n");
    let steps: String = (0..1001).map(step).collect();
    write(&swm, "many.toml", &format!("summary = \"x\"\n{steps}"));
    swm.fails(&["train", "--recipe", "many.toml", "-o", "many"], 2, &["1001 steps", "1000"]);
}

#[test]
fn recipe_notices_outputs_that_were_replaced() {
    let swm = Swm::new();
    let settings = "{ schedule = { steps = 2, warmup = 0 }, data.batch_size = 16, model.image = 32 }";
    write(&swm, "small.toml", &training(&format!("model = \"lewm\"\nsettings = {settings}")));
    let args = ["train", "--recipe", "small.toml", "-o", "run"];
    let first = swm.json(&args)["hashes"].clone();
    assert_eq!(swm.json(&args)["hashes"], first);
    let weights = swm.path("run/small/checkpoint/weights.safetensors");
    let whole = fs::read(&weights).expect("the weights");
    let mut other = whole.clone();
    *other.last_mut().expect("bytes") ^= 1;
    fs::write(&weights, &other).expect("changing the weights");
    swm.fails(&args, 1, &["small", "its hash differs", "choose another folder"]);
    fs::write(&weights, &whole).expect("restoring the weights");
    assert_eq!(swm.json(&args)["hashes"], first);

    fs::rename(swm.path("run/rooms.lance"), swm.path("mine.lance")).expect("moving the dataset");
    let other = ["swm/TwoRoom-v1", "-o", "run/rooms.lance", "--episodes", "3", "--image", "32", "--max-steps", "20"];
    swm.json(&[&["collect"], &other[..]].concat());
    let recorded = first[0]["hash"].as_str().expect("a hash");
    swm.fails(&args, 1, &["rooms.lance", recorded, "remove it"]);
}

#[test]
fn steps_of_a_recipe_know_what_they_read_from_outside() {
    let swm = Swm::new();
    let collect = |episodes: &str, more: &[&str]| {
        let args = ["swm/TwoRoom-v1", "-o", "mine.lance", "--policy", "explore", "--episodes", episodes];
        swm.json(&[&["collect"], &args[..], &["--image", "32", "--max-steps", "20"], more].concat());
    };
    collect("10", &[]);
    let settings = ["schedule.steps=2", "schedule.warmup=0", "data.batch_size=8", "model.image=32"];
    let preset = swm.run(&[&["train", "lewm", "--data", "mine.lance", "--print-config"], &settings[..]].concat());
    write(&swm, "own.toml", &text(&preset.stdout));
    let step = "[[train]]\nname = \"small\"\nmodel = \"lewm\"\npreset = \"own.toml\"\ndata = \"mine.lance\"\n";
    let played = "[[eval]]\nname = \"played\"\npolicies = [\"expert\"]\nenv = \"swm/TwoRoom-v1\"\ndataset = \"mine.lance\"\nepisodes = 2\n\
                  budget = 5\ngoal-offset = 5\nno-pixels = true\n";
    write(&swm, "outside.toml", &format!("summary = \"s\"\n{step}{played}"));
    let args = ["train", "--recipe", "outside.toml", "-o", "run", "--trust"];
    let first = swm.json(&args)["hashes"].clone();
    assert_eq!(swm.json(&args)["hashes"], first);
    write(&swm, "own.toml", &text(&preset.stdout).replace("batch_size = 8", "batch_size = 4"));
    swm.fails(&args, 1, &["run/small", "the preset 'own.toml', which has changed"]);
    write(&swm, "own.toml", &text(&preset.stdout));
    swm.json(&args);
    collect("12", &["--resume"]);
    swm.fails(&args, 1, &["run/small", "the dataset 'mine.lance', which has changed"]);
    // What was made needs it no more.
    fs::rename(swm.path("mine.lance"), swm.path("moved.lance")).expect("moving the dataset");
    assert_eq!(swm.json(&args)["hashes"], first);
}

#[test]
fn results_of_an_evaluation_are_those_that_the_recipe_made() {
    let swm = Swm::new();
    let step = |name: &str, seed: u64| {
        format!(
            "[[eval]]\nname = \"{name}\"\npolicies = [\"expert\"]\nenv = \"swm/TwoRoom-v1\"\nepisodes = 2\nbudget = 5\n\
             no-pixels = true\nseed = {seed}\n"
        )
    };
    write(&swm, "played.toml", &format!("summary = \"s\"\n{}{}", step("one", 0), step("two", 9)));
    let args = ["train", "--recipe", "played.toml", "-o", "run"];
    swm.json(&args);
    let [one, two, state] =
        ["one/results.json", "two/results.json", "recipe.json"].map(|name| swm.path("run").join(name));
    let own = fs::read(&one).expect("the results");
    fs::copy(&two, &one).expect("replacing the results");
    swm.fails(&args, 1, &["run/one", "its hash is", "choose another folder"]);
    fs::write(&one, own).expect("restoring the results");
    swm.json(&args);

    // An output that was made from other datasets and weights than those there.
    let stored = fs::read(&state).expect("the record");
    let mut other: Value = serde_json::from_slice(&stored).expect("JSON");
    other["inputs"]["two"] = other["finished"]["two"].clone();
    fs::write(&state, other.to_string()).expect("the record of other inputs");
    swm.fails(&args, 1, &["run/two", "made from other outputs of earlier steps", "move it away"]);
    fs::write(&state, stored).expect("restoring the record");

    // A run of an older version has no hash.
    let mut older: Value = serde_json::from_slice(&fs::read(&state).expect("the record")).expect("JSON");
    let recorded = older["finished"]["one"].take();
    assert_eq!(recorded.as_str().map(str::len), Some(64));
    older["finished"]["one"] = "".into();
    fs::write(&state, older.to_string()).expect("the record of an older version");
    swm.json(&args);

    // Without its results, an evaluation is repeated, unless its folder has files of the user.
    fs::remove_file(&one).expect("removing the results");
    fs::write(swm.path("run/one/notes.txt"), "mine").expect("a note");
    swm.fails(&args, 1, &["run/one", "notes.txt", "move the folder away"]);
    fs::remove_file(swm.path("run/one/notes.txt")).expect("removing the note");
    fs::create_dir(swm.path("run/one/videos")).expect("a folder");
    let video = swm.path("run/one/videos/expert-in-distribution-0.mp4");
    fs::write(&video, "mine").expect("a file that is no video of an evaluation");
    swm.fails(&args, 1, &["run/one", "expert-in-distribution-0.mp4", "move the folder away"]);
    fs::remove_dir_all(swm.path("run/one/videos")).expect("removing the folder");
    swm.json(&args);
    assert!(one.is_file() && swm.path("run/one/run.json").is_file());
    fs::copy(&two, &one).expect("replacing the results");
    swm.fails(&args, 1, &["run/one", "its hash is"]);
}
