//! Tests of error messages: what was given, what was expected, and what to do.

use crate::{Swm, text};
use std::fs;

/// The command with an error, and parts of its message.
type Case<'a> = (&'a [&'a str], &'a [&'a str]);

/// Commands with an error.
const CASES: &[Case<'_>] = &[
    (&["assets", "install", "mujoko"], &["unknown asset 'mujoko'", "mujoco", "`swm assets list` lists the assets"]),
    (
        &["checkpoints", "export", "zoo:cartpole-swingup/expert", "exported", "--format", "reference"],
        &["zoo:cartpole-swingup/expert", "the reference implementation has no sac", "--format checkpoint"],
    ),
    (
        &["study", "break", "zoo:two-room/pldm", "--factor", "agent.colour", "-o", "found"],
        &["unknown factor of variation 'agent.colour'", "agent.color", "`swm fovs ENV` lists the factors"],
    ),
    (
        &["study", "break", "zoo:two-room/pldm", "--factor", "agent.color", "-o", "found", "episodes=many"],
        &["error: the options of a cell", "many", "`swm eval --help`"],
    ),
    (
        &["study", "run", "paper/online", "-o", "found", "train={dqn=['model.dim=8']}"],
        &["unknown family 'dqn'", "`train`", "tdmpc2, sac"],
    ),
    (
        &["study", "run", "paper/data", "-o", "found", "layouts=['zip']"],
        &["unknown layout 'zip'", "the layouts are 'lance, jpeg', 'lance, lossless'"],
    ),
    (
        &["study", "run", "paper/data", "-o", "found", "repeat=3"],
        &["unknown setting 'repeat'", "did you mean repeats", "the settings are"],
    ),
    (
        &["study", "run", "paper/data", "-o", "found", "repeats='many'"],
        &["repeats=\"many\"", "expected a whole number from 0", "docs/studies.md describes the settings"],
    ),
    (
        &["eval", "simulator", "--env", "swm/TwoRoom-v1", "--limit", "action-box"],
        &["error: unknown constraint 'action_box'", "--limit accepts action_norm, latent_box"],
    ),
    (
        &["eval", "simulator", "--env", "swm/TwoRoom-v1", "--term", "goal,when=closets"],
        &[
            "unknown value 'closets' (did you mean closest?)",
            "when of --term goal is one of terminal, running, closest",
        ],
    ),
    (
        &["eval", "simulator", "--env", "swm/TwoRoom-v1", "--score", "reachh"],
        &["unknown score 'reachh' (did you mean reach?)", "terminal, running, reach, success"],
    ),
    (
        &["train", "lewm", "--data", "none", "--preset", "wrong.toml"],
        &["preset wrong.toml: ", "(line 2)", "correct the file"],
    ),
    (&["train", "lewm", "--data", "none", "--preset", "none.toml"], &["none.toml", "No such file", "check the path"]),
    (&["train", "--recipe", "wrong.toml", "-o", "run"], &["recipe wrong.toml: ", " (line 2); docs/zoo.md"]),
    (&["train", "--resume", "-o", "./folder"], &["./folder: is no run of `swm train`: it has no run.json", "--data"]),
    (&["frame", "swm/TwoRoom-v1", "-o", "c.jpg"], &["--output c.jpg: frames are written as PNG; name the file c.png"]),
    (&["collect", "swm/TwoRoom-v1", "-o", "none", "--episodes", "0"], &["--episodes", "a whole number from 1"]),
    (&["collect", "swm/TwoRoom-v1", "-o", "none", "--seed", "x"], &["'--seed <SEED>': expected a whole number"]),
    (
        &["plot", "zoo:two-room/pldm"],
        &["error: zoo:two-room/pldm: has no log of a training, train.jsonl", "`swm train --output`"],
    ),
];

#[test]
fn messages_of_commands_say_what_to_do() {
    let swm = Swm::new();
    fs::write(swm.path("wrong.toml"), "[model]\nside = [1,\n").expect("a file");
    fs::create_dir(swm.path("folder")).expect("a folder");
    for (args, parts) in CASES {
        swm.fails(args, 2, parts);
    }
    fs::create_dir(swm.path("empty")).expect("a folder");
    for command in [&["report"][..], &["reproduce"], &["leaderboard", "submit", "-o", "entry.json"]] {
        for (given, problem) in [("nothing", "nothing: does not exist"), ("empty", "empty: has no results.json")] {
            swm.fails(&[command, &[given]].concat(), 2, &[problem, "`swm eval --output`"]);
        }
    }
    assert!(["found", "exported", "c.jpg", "datasets"].iter().all(|name| !swm.path(name).exists()));
    let capsule = text(&swm.run(&["eval", "zoo:nothing"]).stderr);
    assert!(capsule.contains("unknown capsule 'nothing'") && !capsule.contains(".."), "{capsule}");
}

#[test]
fn messages_of_the_file_of_a_study_name_what_it_may_contain() {
    let swm = Swm::new();
    let start = "title = \"T\"\nquestion = \"Q\"\n[[condition]]\nname = \"plain\"\n[[policy]]\nname = \"p\"\npolicy = \"random\"\n";
    for (end, parts) in [
        ("[[conditions]]\nname = \"a\"\n", &["study.toml:8", "unknown table 'conditions'", "the tables are title"][..]),
        ("[[published]]\nrate = 1\n", &["study.toml:9", "unknown name 'rate'", "the names are source, starts, rates"]),
    ] {
        fs::write(swm.path("study.toml"), format!("{start}{end}")).expect("a file");
        swm.fails(&["study", "run", "study.toml", "-o", "found"], 2, parts);
    }
}
