//! A table of hostile arguments: each command refuses them with a message, without a panic, an abort or a hang.

use crate::{Swm, text};
use std::collections::BTreeMap;
use std::ffi::{OsStr, OsString};
use std::fs;
use std::os::unix::ffi::OsStrExt as _;
use std::os::unix::fs::MetadataExt as _;
use std::path::Path;
use std::process::Stdio;

/// Commands that read one name or path.
const COMMANDS: &[&[&str]] =
    &[&["inspect"], &["report"], &["reproduce"], &["fovs"], &["checkpoints", "show"], &["datasets", "commit"]];

#[test]
fn hostile_names_are_refused() {
    let swm = Swm::new();
    fs::create_dir(swm.path("folder")).expect("a folder");
    for name in ["empty.json", "empty.h5", "empty.parquet"] {
        fs::write(swm.path(name), "").expect("a file");
    }
    std::os::unix::fs::symlink("loop", swm.path("loop")).expect("a link");
    let long = "x".repeat(10_000);
    let names: [&[u8]; 12] = [
        b"",
        b"-",
        b"/",
        b"folder",
        b"empty.json",
        b"empty.h5",
        b"empty.parquet",
        b"loop",
        b"/dev/zero",
        b"a\nb",
        b"\xff\xfe",
        long.as_bytes(),
    ];
    for command in COMMANDS {
        for name in names {
            let output = swm.command(command).arg(OsStr::from_bytes(name)).stdin(Stdio::null()).output().expect("swm");
            let (code, error) = (output.status.code(), text(&output.stderr));
            assert!(matches!(code, Some(1 | 2)), "{command:?} {name:?}: {code:?} {error}");
            assert!(error.starts_with("error: ") && !error.contains("panicked"), "{command:?} {name:?}: {error}");
        }
    }
}

#[test]
fn datasets_are_not_written_over_themselves() {
    let swm = Swm::new();
    let collect =
        ["collect", "swm/TwoRoom-v1", "--no-pixels", "--episodes", "2", "--max-steps", "4", "-o", "rooms.lance"];
    swm.json(&collect);
    std::os::unix::fs::symlink("rooms.lance", swm.path("other.lance")).expect("a link");
    for target in ["rooms.lance", "./rooms.lance", "other.lance"] {
        let message = ["is the dataset that is read"];
        swm.fails(&["convert", "rooms.lance", target, "--mode", "overwrite"], 2, &message);
        swm.fails(&["doctor", "rooms.lance", "--repair", target], 2, &message);
    }
    assert_eq!(swm.json(&["inspect", "rooms.lance"])["episodes"], 2);
}

#[test]
fn hostile_numbers_are_refused() {
    let swm = Swm::new();
    let room = ["--env", "swm/TwoRoom-v1"];
    let commands: [(&[&str], &[&str]); 4] = [
        (&["eval", "expert"], &["--episodes", "--image", "--budget", "--hold"]),
        (&["bench", "plan"], &["--envs", "--pairs", "--seconds", "--iterations"]),
        (&["bench", "render"], &["--sizes", "--turns", "--seconds"]),
        (&["demo"], &["--episodes", "--eval-episodes", "--seed"]),
    ];
    for (command, options) in commands {
        let more: &[&str] = if command[0] == "eval" { &room } else { &[] };
        for option in options {
            for value in ["-1", "nan", "1e400", "99999999999999999999999", ""] {
                let given = format!("{option}={value}");
                swm.fails(&[command, more, &[given.as_str()]].concat(), 2, &["error: "]);
            }
        }
    }
    for absurd in ["--episodes=1152921504606846976", "--image=1152921504606846976"] {
        swm.fails(&[&["eval", "expert"], &room[..], &[absurd]].concat(), 2, &["error: "]);
    }
    swm.fails(&[&["eval", "expert"], &room[..], &["--envs=0"]].concat(), 2, &["from 1 to 16384"]);
    swm.fails(&[&["eval", "expert"], &room[..], &["--dataset=d", "--goal-offset=0"]].concat(), 2, &["from 1 to"]);
    for (weight, message) in [("-1", "control term"), ("1e308", "control term")] {
        let term = format!("--term=control,weight={weight}");
        swm.fails(&[&["eval", "simulator"], &room[..], &[term.as_str()]].concat(), 2, &[message]);
    }
    for ratio in ["nan", "-1", "1e9"] {
        let given = format!("--least-psnr={ratio}");
        swm.fails(&["convert", "a.lance", "b.h5", &given], 2, &["from 0 to 200 dB"]);
    }
    let ray = ["study", "break", "expert", "env=swm/TwoRoom-v1", "--factor=agent.speed", "--below=101", "-o=o"];
    swm.fails(&ray, 2, &["a whole number from 1 to 100"]);
    swm.fails(&["bench", "train", "--clips=1152921504606846976"], 2, &["from 1 to 4096"]);
    swm.fails(&["bench", "plan", "--envs=1152921504606846976"], 2, &["from 1 to 16384"]);
}

#[test]
fn options_without_effect_are_refused() {
    let swm = Swm::new();
    let collect = ["collect", "swm/TwoRoom-v1", "--image", "32", "--episodes", "2", "--max-steps", "4"];
    let with = |more: &[&'static str]| [&collect[..], more].concat();
    swm.fails(&with(&["-o", "rooms.lance", "--quality", "5"]), 2, &["only JPEG frames have one"]);
    swm.fails(&with(&["-o", "rooms.h5", "--codec", "jpeg"]), 2, &["hdf5 stores frames without loss"]);
    swm.fails(&with(&["-o", "rooms.h5", "--codec", "png"]), 2, &["--codec png", "hdf5 stores frames without loss"]);
    swm.fails(&with(&["-o", "./rooms.video", "--codec", "png"]), 2, &["--codec png", "stores videos"]);
    swm.json(&with(&["-o", "rooms.lance"]));
    swm.fails(&["train", "lewm", "--data", "rooms.lance", "--max-steps", "3"], 2, &["--max-steps", "plays none"]);
    swm.fails(&["convert", "rooms.lance", "./a.h5", "--least-psnr", "30"], 2, &["without loss"]);
    let eval = ["eval", "expert", "--env", "swm/TwoRoom-v1", "--episodes", "2", "--no-pixels"];
    for option in [&["--solver", "cem"][..], &["--horizon", "3"], &["--trace"]] {
        swm.fails(&[&eval[..], option].concat(), 2, &["none of the policies plans"]);
    }
    let plan = ["eval", "simulator", "--env", "swm/TwoRoom-v1", "--episodes", "1", "--horizon", "2"];
    let beyond = [&plan[..], &["--receding-horizon", "3"]].concat();
    swm.fails(&beyond, 2, &["receding horizon", "3 model steps to execute, 2 planned"]);
}

#[test]
fn refused_trainings_leave_no_folder() {
    let swm = Swm::new();
    let train = |model, env| ["train", model, "--env", env, "-o", "./run"];
    swm.fails(&train("lewm", "swm/PendulumControl-v1"), 2, &["trains on datasets only"]);
    swm.fails(&train("sac", "swm/CartPoleControl-v1"), 2, &["continuous actions"]);
    let column = [&train("sac", "swm/PendulumControl-v1")[..], &["model.columns=[\"stat\"]"]].concat();
    swm.fails(&column, 2, &["stat"]);
    assert!(!swm.path("run").exists());
    fs::create_dir(swm.path("run")).expect("a folder of the user");
    fs::write(swm.path("run/notes.txt"), "notes").expect("a file of the user");
    swm.fails(&column, 2, &["stat"]);
    assert!(swm.path("run/notes.txt").is_file());
}

#[test]
fn file_beyond_the_limit_of_the_process_is_an_error() {
    let swm = Swm::new();
    for arguments in [
        "collect swm/TwoRoom-v1 --policy random --image 64 --episodes 20 --max-steps 20 -o a.h5",
        "frame swm/TwoRoom-v1 -o frame.png",
        "envs --json >envs.json",
    ] {
        let command = format!("ulimit -f 1; exec {} {arguments}", env!("CARGO_BIN_EXE_swm"));
        let mut shell = std::process::Command::new("sh");
        let output = shell.args(["-c", &command]).current_dir(swm.path("")).output().expect("a shell");
        assert_eq!(output.status.code(), Some(1), "{arguments}: {}", text(&output.stderr));
        assert!(text(&output.stderr).contains("File too large"), "{}", text(&output.stderr));
    }
}

#[test]
fn datasets_are_not_called_damaged_for_lack_of_file_handles() {
    let swm = Swm::new();
    for name in ["rooms.lerobot", "rooms.lance-video"] {
        swm.json(&["collect", "swm/TwoRoom-v1", "--image", "32", "--episodes", "2", "--max-steps", "4", "-o", name]);
        let mut refused = 0;
        for handles in (4..16).chain([64]) {
            let inspect = ["inspect", name, "--checksum"].join(" ");
            let command = format!("ulimit -n {handles}; exec {} {inspect}", env!("CARGO_BIN_EXE_swm"));
            let mut shell = std::process::Command::new("sh");
            let output = shell.args(["-c", &command]).current_dir(swm.path("")).output().expect("a shell");
            let error = text(&output.stderr);
            let is_named =
                error.contains("Too many open files") && !error.contains("damaged") && !error.contains("install");
            assert!(output.status.success() || is_named, "{name}, {handles} handles: {error}");
            refused += usize::from(!output.status.success());
            assert!(output.status.success() || handles < 64, "{name}: {error}");
        }
        assert!(refused > 0, "{name}: all limits were enough");
    }
}

#[test]
fn small_stacks_of_the_main_thread_are_enough() {
    let swm = Swm::new();
    for arguments in
        ["envs", "collect swm/TwoRoom-v1 --image 32 --episodes 1 --max-steps 4 -o ./a --format video", "doctor ./a"]
    {
        let command = format!("ulimit -s 64; exec {} {arguments}", env!("CARGO_BIN_EXE_swm"));
        let mut shell = std::process::Command::new("sh");
        let output = shell.args(["-c", &command]).current_dir(swm.path("")).output().expect("a shell");
        assert!(output.status.success(), "{arguments}: {:?}: {}", output.status, text(&output.stderr));
    }
}

#[test]
fn finished_run_of_another_program_is_left_as_it_is() {
    let swm = Swm::new();
    swm.json(&["collect", "swm/TwoRoom-v1", "-o", "rooms.lance", "--image", "64", "--episodes", "4"]);
    let train = ["train", "gcbc", "--data", "rooms.lance", "-o", "./run", "schedule.steps=2", "data.batch_size=4"];
    swm.json(&train);
    let manifest = swm.path("run/checkpoint/manifest.json");
    let own = fs::read_to_string(&manifest).expect("the manifest");
    fs::write(&manifest, own.replace("\"burn\"", "\"torch\"")).expect("writing the manifest");
    let before = inodes(&swm.path("run/checkpoint"));
    swm.fails(
        &["train", "-o", "./run", "--resume"],
        2,
        &["finished run of PyTorch", "2 of 2 steps", "nothing was changed"],
    );
    assert_eq!(inodes(&swm.path("run/checkpoint")), before);
    // A run that is not finished continues in the other program.
    let state = swm.path("run/checkpoint/state.json");
    let one = fs::read_to_string(&state).expect("the state").replace("\"step\": 2", "\"step\": 1");
    fs::write(&state, one).expect("writing the state");
    swm.json(&["train", "-o", "./run", "--resume"]);
    assert!(fs::read_to_string(&manifest).expect("the manifest").contains("\"burn\""));
    swm.json(&["train", "-o", "./run", "--resume"]);
}

#[test]
fn continuing_a_finished_online_run_leaves_its_replay_data_in_place() {
    let swm = Swm::new();
    let train = "train sac --preset tiny --env swm/PendulumControl-v1 --max-steps 20 -o ./run schedule.steps=4 \
                 online.warmup=40 data.batch_size=8 online.evaluate_episodes=1";
    let train: Vec<&str> = train.split_whitespace().collect();
    swm.json(&train);
    // A kill between the deletion and the new copy would leave a checkpoint without its data.
    let data = swm.path("run/played-4");
    let before = (inodes(&data), inodes(&data.join("replay.lance/data")));
    swm.json(&[&train[..], &["--resume"]].concat());
    assert_eq!((inodes(&data), inodes(&data.join("replay.lance/data"))), before);
    for option in ["--data", "--feature-cache"] {
        let given = ["train", "-o", "./run", "--resume", option, "rooms"];
        swm.fails(&given, 2, &[option, "run trains online in an environment"]);
    }
}

/// The entries of a folder, with the numbers of their files.
fn inodes(folder: &Path) -> BTreeMap<OsString, u64> {
    let entries = fs::read_dir(folder).expect("a folder").flatten();
    entries.map(|entry| (entry.file_name(), entry.metadata().expect("its metadata").ino())).collect()
}

#[test]
fn checkpoint_is_not_removed_while_it_is_written() {
    let swm = Swm::new();
    let run = swm.path("run");
    fs::create_dir_all(run.join("checkpoint")).expect("a folder");
    fs::write(run.join("checkpoint/config.json"), r#"{"family":"lewm"}"#).expect("a file");
    let lock = fs::File::open(&run).expect("the folder");
    lock.lock().expect("a lock");
    swm.fails(&["checkpoints", "remove", "./run", "--yes"], 2, &["another process writes to it"]);
    assert!(run.join("checkpoint/config.json").is_file());
    drop(lock);
    swm.json(&["checkpoints", "remove", "./run", "--yes"]);
}
