//! Tests of `swm train`, `eval`, `reproduce`, `report` and `demo`.

use crate::{Swm, text};
use serde_json::Value;

/// A demo that is small enough for a test. Its model is not trained long enough to be useful, but all files are
/// written.
const DEMO: &[&str] =
    &["demo", "-o", "demo", "--episodes", "6", "--eval-episodes", "5", "schedule.steps=8", "schedule.warmup=2"];

/// Runs the small demo; returns the hash of its dataset, and its results without timing.
fn demo(swm: &Swm, more: &[&str]) -> (Value, Value) {
    let args: Vec<&str> = DEMO.iter().chain(more).copied().collect();
    let mut found = swm.json(&args);
    for run in found["results"]["runs"].as_array_mut().expect("an array of runs") {
        run["timing"] = Value::Null;
    }
    let dataset = swm.json(&["inspect", "demo/rooms.lance"]);
    (dataset["content_hash"].clone(), found["results"].clone())
}

#[test]
fn demo_does_not_depend_on_thread_and_environment_counts() {
    let swm = Swm::new();
    let first = demo(&swm, &["--threads", "1", "--envs", "1"]);
    let page = std::fs::read_to_string(swm.path("demo/index.html")).expect("reading the report");
    assert!(page.contains("Two rooms") && page.contains("data:video/mp4"));
    let second = demo(&swm, &["--threads", "2", "--envs", "5"]);
    assert_eq!(first.0, second.0, "the datasets differ");
    assert_eq!(first.1, second.1, "the results differ");
    let other = demo(&swm, &["--seed", "1"]);
    assert_ne!(first.0, other.0, "the seed changes the data");
}

#[test]
fn trains_evaluates_and_reports() {
    let swm = Swm::new();
    swm.json(&["collect", "swm/TwoRoom-v1", "-o", "rooms", "--image", "64", "--episodes", "12", "--max-steps", "60"]);
    let train = ["train", "lewm", "--data", "rooms", "-o", "small", "schedule.steps=6", "data.batch_size=32"];
    let summary = swm.json(&train);
    assert_eq!(summary["steps"], 6);
    swm.fails(&train, 2, &["small", "resume"]);
    swm.fails(&["train", "lewm", "--data", "rooms", "-o", "small", "--resume", "optim.lr=1"], 2, &["optim.lr"]);
    assert_eq!(swm.json(&["checkpoints"])[0]["name"], "small");

    let quick = ["--solver", "cem,samples=16,iterations=2,elites=4", "--episodes", "4", "--budget", "20"];
    let eval = |more: &[&'static str]| {
        let args: Vec<&str> = ["eval", "small"].into_iter().chain(more.iter().copied()).chain(quick).collect();
        swm.json(&args)
    };
    let episodic = eval(&["-o", "episodic", "--videos", "1"]);
    assert_eq!(episodic["runs"][0]["policy"], "random");
    assert_eq!(episodic["runs"][1]["policy"], "small");
    assert_eq!(episodic["runs"][1]["episodes"].as_array().map(Vec::len), Some(4));
    let dataset = eval(&["-o", "dataset", "--dataset", "rooms", "--goal-offset", "10", "--pin", "agent.color=0,0,255"]);
    assert_eq!(dataset["protocol"], "dataset");
    assert_eq!(dataset["runs"][1]["condition"], "agent.color=0,0,255");
    let report = swm.json(&["report", "episodic", "dataset", "-o", "report"]);
    let page =
        std::fs::read_to_string(swm.path(report["report"].as_str().expect("a path"))).expect("reading the report");
    assert!(page.contains("agent.color=0,0,255") && page.contains("data:video/mp4"));
    assert!(
        page.contains("<p>Start 0</p>")
            && page.contains("poster=\"data:image/png")
            && page.contains("alt=\"The goal\"")
    );
    // The training curves of `small` are found by its name and the hash of its weights.
    assert!(page.contains("<h2>Training</h2>") && page.contains("</span>small</h3>"), "no training log");
    let results = std::fs::read_to_string(swm.path("episodic/results.json")).expect("reading the results");
    let weights = episodic["manifest"]["hashes"]["weights"].as_str().expect("a hash");
    std::fs::create_dir(swm.path("other")).expect("creating a folder");
    std::fs::write(swm.path("other/results.json"), results.replace(weights, &"0".repeat(64))).expect("writing results");
    let report = swm.json(&["report", "other", "-o", "report"]);
    let page = std::fs::read_to_string(swm.path(report["report"].as_str().expect("a path"))).expect("reading the page");
    assert!(!page.contains("<h2>Training</h2>"), "curves of other weights");

    swm.fails(&["eval", "small", "--env", "swm/PushT-v1"], 2, &["trained on swm/TwoRoom-v1"]);
    swm.fails(&["report", "nowhere"], 2, &["nowhere"]);

    // An unknown model family, and truncated weights.
    let file = find(&swm.path("checkpoints/small"), "config.json");
    let config = std::fs::read_to_string(&file).expect("the file is readable");
    std::fs::write(&file, config.replace("\"lewm\"", "\"dreamer\"")).expect("the file is writable");
    swm.fails(&["eval", "small"], 1, &["dreamer", "does not support"]);
    std::fs::write(&file, config).expect("the file is writable");
    let weights = find(&swm.path("checkpoints/small"), "weights.safetensors");
    let bytes = std::fs::read(&weights).expect("the file is readable");
    std::fs::write(&weights, &bytes[..bytes.len() / 2]).expect("the file is writable");
    swm.fails(&["eval", "small"], 1, &["small"]);
}

/// Returns the only file of this name below a folder.
fn find(folder: &std::path::Path, name: &str) -> std::path::PathBuf {
    let mut folders = vec![folder.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder).expect("listing the folder").flatten() {
            let path = entry.path();
            if path.is_dir() && !path.is_symlink() {
                folders.push(path);
            } else if path.file_name().is_some_and(|found| found == name) {
                return path;
            }
        }
    }
    panic!("no {name} below {}", folder.display())
}

#[test]
fn compares_policies_from_the_same_starts_and_reproduces_results() {
    let swm = Swm::new();
    let noise = ["--wrapper", "noise,std=4", "--wrapper", "grayscale"];
    let collect =
        ["collect", "swm/TwoRoom-v1", "-o", "rooms", "--image", "64", "--episodes", "12", "--max-steps", "60"];
    swm.json(&[&collect[..], &noise].concat());
    assert_eq!(swm.json(&["inspect", "rooms"])["manifest"]["config"]["wrappers"][1]["id"], "grayscale");
    swm.json(&["train", "lewm", "--data", "rooms", "-o", "small", "schedule.steps=6", "data.batch_size=32"]);
    let inverse = ["train", "inverse", "--data", "rooms", "-o", "direct", "--encoder", "small", "schedule.steps=4"];
    // What does not fill a batch is refused before there is a folder of the run.
    let large = ["train", "lewm", "--data", "rooms", "-o", "./large", "data.batch_size=100000"];
    swm.fails(&large, 2, &["do not fill one batch of 100000"]);
    let large = ["train", "inverse", "--data", "rooms", "-o", "./large", "--encoder", "small", "batch_size=100000"];
    swm.fails(&large, 2, &["do not fill one batch"]);
    assert!(!swm.path("large").exists());
    let trained = swm.json(&[&inverse[..], &["batch_size=16", "hidden=32"]].concat());
    assert_eq!(trained["steps"], 4);
    swm.fails(&inverse, 2, &["holds a training run already"]);
    // Its copy of the encoder has no optimizer, and does not name one.
    swm.json(&["checkpoints", "verify", "direct"]);
    swm.fails(&["train", "inverse", "--data", "rooms"], 2, &["--encoder"]);
    assert_eq!(swm.json(&["checkpoints"])[0]["family"], "inverse");

    let eval = ["eval", "small", "direct", "simulator", "expert", "--episodes", "4", "--budget", "60", "--trace"];
    let solver = ["--solver", "icem,samples=32,iterations=2,elites=8,keep=2", "--receding-horizon", "2"];
    let found = swm.json(&[&eval[..], &solver, &noise, &["--wrap-goal", "-o", "found"]].concat());
    let runs = found["runs"].as_array().expect("an array of runs");
    let names: Vec<_> = runs.iter().map(|run| run["policy"].as_str().expect("the name is a string")).collect();
    assert_eq!(names, ["random", "small", "direct", "simulator", "expert"]);
    assert_eq!(runs[0]["condition"], "noise,std=4, grayscale");
    assert_eq!(found["comparisons"].as_array().map(Vec::len), Some(10));
    assert!(runs.iter().all(|run| run["episodes"][3]["seed"] == runs[0]["episodes"][3]["seed"]));
    assert!(
        runs[3]["success"]["rate"].as_f64() > runs[0]["success"]["rate"].as_f64(),
        "planning with the true dynamics beats the floor"
    );
    let traces: Value =
        serde_json::from_slice(&std::fs::read(swm.path("found/traces.json")).expect("reading the file of traces"))
            .expect("parsing the JSON");
    assert!(traces[0]["policy"] == "small" && traces[0]["best"].as_array().map(Vec::len) == Some(2), "{}", traces[0]);

    // These solvers require gradients, latents, terms or constraints of the checkpoint.
    for planner in [
        &["--solver", "gd,samples=4,iterations=2,optimizer.step=0.2", "--term", "control,weight=0.01"][..],
        &["--solver", "grasp,iterations=4,sync_every=2,sync_iterations=1"],
        &["--solver", "lagrangian,samples=4,iterations=2,outer_iterations=2", "--limit", "action_norm,limit=1,block=5"],
    ] {
        let planned =
            swm.json(&[&["eval", "small", "--episodes", "2", "--budget", "10", "-o", "other"], planner].concat());
        assert_eq!(planned["runs"][1]["timing"]["plan_seconds"]["n"].as_u64(), Some(2), "{planner:?}");
    }
    swm.fails(&["eval", "small", "--episodes", "2", "--solver", "lagrangian"], 2, &["needs constraints", "gd"]);
    let unfit = ["eval", "small", "--episodes", "2", "--solver", "pgd"];
    swm.fails(&unfit, 2, &["discrete", "cem"]);
    assert!(!text(&swm.run(&unfit).stderr).contains("random"), "the solver is checked before the floor is evaluated");

    let again = swm.json(&["reproduce", "found", "--threads", "1", "--envs", "3"]);
    assert_eq!((&again["holds"], &again["differences"]), (&Value::Bool(true), &Value::Array(vec![])));
    // Other weights under the same name are an error before any episode is played.
    std::fs::remove_dir_all(swm.path("checkpoints/small")).expect("removing the checkpoint");
    let other = ["train", "lewm", "--data", "rooms", "-o", "small", "schedule.steps=7", "data.batch_size=32"];
    swm.json(&other);
    swm.fails(&["reproduce", "found"], 2, &["weights of small", "hash"]);
}

#[test]
fn eval_records_protocol_split_and_hold_and_rejects_unknown_settings() {
    let swm = Swm::new();
    swm.json(&["collect", "swm/TwoRoom-v1", "-o", "rooms", "--no-pixels", "--episodes", "40", "--max-steps", "40"]);
    let expert = ["eval", "expert", "--env", "swm/TwoRoom-v1", "--episodes", "6", "-o", "found"];
    let run = |more: &[&str]| swm.json(&[&expert[..], more].concat());
    let test = run(&["--dataset", "rooms", "--goal-offset", "5", "--split", "test"]);
    assert_eq!(test["manifest"]["config"]["starts"]["dataset"]["held_out"]["part"], "test");
    assert!(test["runs"][0]["episodes"][0]["start"].is_array());
    let compat = run(&["--protocol", "compat"]);
    assert!(compat["manifest"]["config"]["counting"]["compat"]["envs"].is_u64());
    swm.fails(&[&expert[..], &["--protocol", "compat", "--hold", "3"]].concat(), 2, &["--hold 3", "--protocol strict"]);
    for (option, value) in [("--score", "reach"), ("--action-block", "3")] {
        swm.fails(&[&expert[..], &[option, value]].concat(), 2, &[option, "plans in the simulator"]);
    }
    let searches = ["eval", "simulator", "--env", "swm/TwoRoom-v1", "--episodes", "3", "--budget", "10", "-o", "found"];
    let small = ["--solver", "cem,samples=8,elites=2,iterations=2", "--solver", "cem,samples=9,elites=2,iterations=2"];
    let found = swm.json(&[&searches[..], &small].concat());
    assert_eq!(found["runs"][2]["policy"], "simulator (cem,samples=9,elites=2,iterations=2)");
    let held = run(&["--hold", "3"]);
    assert_eq!(held["counting"]["strict"]["hold"], 3);
    swm.fails(&[&expert[..], &["--split", "rest"]].concat(), 2, &["rest"]);
    swm.fails(&[&expert[..], &["--wrapper", "nose"]].concat(), 2, &["did you mean noise"]);
    swm.fails(&["eval", "simulator", "--env", "swm/TwoRoom-v1", "--solver", "cme"], 2, &["did you mean cem"]);
    swm.fails(&["eval", "simulator", "--env", "swm/TwoRoom-v1", "--solver", "gd"], 2, &["gradient", "icem"]);
    swm.fails(&["eval", "simulator", "--env", "swm/TwoRoom-v1", "--score", "best"], 2, &["terminal"]);
    swm.fails(&["eval", "simulator", "--env", "swm/TwoRoom-v1", "--term", "contrl"], 2, &["control"]);
}

#[test]
fn prints_configs_and_rejects_unknown_settings() {
    let swm = Swm::new();
    let output = swm.run(&["train", "lewm", "--preset", "paper", "--print-config", "seed=7"]);
    assert!(output.status.success(), "{}", text(&output.stderr));
    assert!(text(&output.stdout).contains("seed = 7"));
    swm.fails(&["train", "lwem", "--data", "x"], 2, &["did you mean lewm"]);
    swm.fails(&["train", "lewm"], 2, &["--data"]);
    swm.fails(&["train", "lewm", "--data", "x", "optim.rl=1"], 2, &["did you mean optim.lr"]);
}

#[test]
fn shifts_are_conditions_of_one_evaluation() {
    let swm = Swm::new();
    let args = ["eval", "expert", "--env", "swm/TwoRoom-v1", "--episodes", "3", "--budget", "5", "--no-pixels"];
    let shifts = ["--shift", "agent.color=255,0,0", "--shift", "agent.speed", "--pin", "background.color=9,9,9"];
    let results = swm.json(&[&args[..], &shifts, &["-o", "out"]].concat());
    let conditions: Vec<&str> =
        results["runs"].as_array().into_iter().flatten().filter_map(|run| run["condition"].as_str()).collect();
    let pinned = "background.color=9,9,9";
    let of = |shift: &str| if shift.is_empty() { pinned.to_owned() } else { shift.to_owned() };
    let expected =
        [of(""), of("background.color=9,9,9, agent.color=255,0,0"), of("agent.speed sampled, background.color=9,9,9")];
    assert_eq!(conditions, expected.iter().flat_map(|name| [name.as_str(); 2]).collect::<Vec<_>>());
    let printed = text(&swm.run(&[&args[..], &shifts, &["-o", "out"]].concat()).stdout);
    assert!(printed.contains("gap to 'background.color=9,9,9'"), "{printed}");
    let each = swm.json(&[&args[..], &["--each-factor", "-o", "each"]].concat());
    let factors =
        swm.json(&["fovs", "swm/TwoRoom-v1"])["variation"].as_object().map(serde_json::Map::len).expect("factors");
    // Two of them are sampled anyway.
    assert_eq!(each["runs"].as_array().map(Vec::len), Some(2 * (factors - 1)));

    swm.fails(
        &[&args[..], &["--shift", "agent.colour=1,2,3", "-o", "none"]].concat(),
        2,
        &["agent.colour", "agent.color"],
    );
}

#[test]
fn an_evaluation_stops_by_its_rule_and_is_continued_and_reproduced() {
    let swm = Swm::new();
    let expert = ["eval", "expert", "--env", "swm/TwoRoom-v1", "--no-pixels", "--budget", "30"];
    let run = |more: &[&'static str]| swm.json(&[&expert[..], more].concat());
    let few = run(&["--until", "ci=12", "--episodes", "20", "-o", "parts"]);
    assert_eq!((&few["stopping"]["until"], &few["stopping"]["met"]), (&"ci=12".into(), &false.into()));
    let times = |mut found: Value| {
        found["runs"].as_array_mut().expect("runs").iter_mut().for_each(|run| run["timing"] = Value::Null);
        found
    };
    let parts = times(run(&["--until", "ci=12", "--resume", "-o", "parts"]));
    let whole = times(run(&["--until", "ci=12", "-o", "whole"]));
    assert_eq!(parts, whole);
    assert!(whole["stopping"]["met"] == true && whole["comparisons"][0]["e"].as_f64().is_some_and(|e| e > 20.0));
    let text = text(&swm.run(&[&expert[..], &["--until", "ci=12", "--resume", "-o", "whole"]].concat()).stdout);
    assert!(text.contains("Stopped by ci=12 after") && text.contains("confidence sequences"), "{text}");
    assert!(swm.json(&["reproduce", "whole"])["holds"] == true);
    swm.json(&["report", "whole", "-o", "page"]);
    let page = std::fs::read_to_string(swm.path("page/index.html")).expect("a page");
    assert!(page.contains("Stopped by ci=12") && page.contains("e-value") && !page.contains("Tango"), "the page");
    swm.fails(&[&expert[..], &["-o", "whole"]].concat(), 2, &["--until ci=12", "fixed number"]);
    swm.fails(&[&expert[..], &["--resume", "-o", "whole"]].concat(), 2, &["--until"]);
    let other = [&expert[..], &["--until", "ci=12", "--resume", "--seed", "4", "-o", "whole"]].concat();
    swm.fails(&other, 2, &["another request"]);
}
