//! `swm export`: recordings of the package `rerun-sdk`, which `$SWM_PYTHON` may have.

use crate::{Swm, text};

/// Collects two episodes of 64 pixels.
fn rooms() -> Swm {
    let swm = Swm::new();
    let collect =
        ["collect", "swm/TwoRoom-v1", "--output", "rooms", "--episodes", "2", "--max-steps", "5", "--image", "64"];
    swm.json(&collect);
    swm
}

#[test]
fn export_names_what_is_missing_and_replaces_no_file_of_the_user() {
    let swm = rooms();
    swm.fails(&["export", "rooms", "--output", "rooms.mcap"], 2, &["rooms.mcap", ".rrd"]);
    swm.fails(&["export", "rooms", "--column", "depht"], 2, &["depht"]);
    swm.fails(&["export", "rooms", "--episodes", "0"], 2, &["at least one"]);
    std::fs::write(swm.path("mine.rrd"), "a file of the user").expect("a file");
    swm.fails(&["export", "rooms", "--output", "mine.rrd"], 2, &["was not written by this program"]);
    assert_eq!(std::fs::read_to_string(swm.path("mine.rrd")).expect("the file"), "a file of the user");
    // What a kill left of this recording is deleted; what another program wrote, or an export that runs, stays.
    let unfinished = |process: &str| swm.path(&format!(".episodes.rrd.{process}.tmp"));
    std::fs::write(unfinished("11"), "RRF2 stable-worldmodel").expect("a file");
    std::fs::write(unfinished("12"), "RRF2 stable-worldmodel").expect("a file");
    std::fs::write(unfinished("13"), "thesis").expect("a file");
    let _running = swm::core::files::Lock::file(&unfinished("12")).expect("a lock");
    let output = swm.command(&["export", "rooms"]).env("SWM_PYTHON", "/no/such/python").output().expect("swm starts");
    let error = text(&output.stderr);
    assert!(output.status.code() == Some(2) && error.contains("pip install rerun-sdk"), "{error}");
    assert!(error.contains("/no/such/python (named by $SWM_PYTHON)"), "{error}");
    let left = std::fs::read_dir(swm.home()).expect("the folder").flatten().map(|file| file.path());
    let left: std::collections::BTreeSet<_> =
        left.filter(|path| path.extension().is_some_and(|end| end == "tmp")).collect();
    assert_eq!(left, [unfinished("12"), unfinished("13")].into());
}

/// A Python without the package, and files of the current folder, which are no modules.
#[test]
fn export_says_how_to_install_the_package() {
    let python = std::env::var("SWM_PYTHON").unwrap_or_else(|_| "python3".to_owned());
    if !std::process::Command::new(&python).arg("--version").output().is_ok_and(|output| output.status.success()) {
        println!("SKIPPED: there is no Python");
        return;
    }
    let swm = rooms();
    std::fs::write(swm.path("rerun.py"), "raise SystemExit(3)").expect("a module");
    std::fs::create_dir(swm.path("packages")).expect("a folder");
    std::fs::write(swm.path("packages/rerun.py"), "raise ImportError('no rerun here')").expect("a package");
    let mut command = swm.command(&["export", "rooms"]);
    let output = command.env("PYTHONPATH", swm.path("packages")).output().expect("swm starts");
    let error = text(&output.stderr);
    assert!(output.status.code() == Some(2) && error.contains("pip install rerun-sdk"), "{error}");
    let left = std::fs::read_dir(swm.home()).expect("the folder").flatten();
    assert!(!left.into_iter().any(|file| file.file_name().to_string_lossy().contains(".rrd")));
}

/// A package that fails when the recording starts.
#[test]
fn error_of_the_package_is_one_line() {
    let python = std::env::var("SWM_PYTHON").unwrap_or_else(|_| "python3".to_owned());
    if !std::process::Command::new(&python).arg("--version").output().is_ok_and(|output| output.status.success()) {
        println!("SKIPPED: there is no Python");
        return;
    }
    let swm = rooms();
    let package = swm.path("packages/rerun");
    std::fs::create_dir_all(&package).expect("a folder");
    let fails = "class EncodedImage: columns = None\nclass Scalars: columns = None\nescape_entity_path_part = str\n\
                 def RecordingStream(*args, **kwargs): raise OSError('no space left')\n";
    std::fs::write(package.join("__init__.py"), fails).expect("a package");
    std::fs::write(package.join("blueprint.py"), "").expect("a package");
    std::fs::write(swm.path("packages/numpy.py"), "").expect("a package");
    let mut command = swm.command(&["export", "rooms"]);
    let output = command.env("PYTHONPATH", swm.path("packages")).output().expect("swm starts");
    let error = text(&output.stderr);
    assert!(error.contains("OSError: no space left\n") && !error.contains("Traceback"), "{error}");
    assert_eq!(output.status.code(), Some(1), "{error}");
}

#[test]
fn recordings_are_those_that_the_viewer_verifies() {
    if !crate::gym::python("rerun") {
        return;
    }
    let swm = rooms();
    let written = swm.json(&["export", "rooms", "--output", "rooms.rrd"]);
    assert_eq!((written["episodes"].as_u64(), written["left_out"].as_array().map(Vec::len)), (Some(2), Some(0)));
    // The recording of this program is replaced.
    swm.json(&["export", "rooms", "--output", "rooms.rrd", "--column", "pixels", "--column", "action"]);
    swm.json(&["export", "rooms", "--output", "rooms.rrd"]);
    let python = std::env::var_os("SWM_PYTHON").expect("the Python that has the package");
    let rerun = |args: &[&str]| {
        let command = std::process::Command::new(&python)
            .args(["-m", "rerun_cli", "rrd"])
            .args(args)
            .current_dir(swm.home())
            .output();
        let output = command.expect("Python starts");
        assert!(output.status.success(), "{args:?}: {}", text(&output.stderr));
        text(&output.stdout)
    };
    rerun(&["verify", "rooms.rrd"]);
    let printed = rerun(&["print", "rooms.rrd"]);
    for part in ["/episode_0/pixels", "/episode_1/action", "/episode_1/about", "EncodedImage:blob", "Scalars:scalars"] {
        assert!(printed.contains(part), "no {part} in {printed}");
    }
    // Six observations, and five actions between them.
    let rows = |entity: &str| {
        printed.lines().filter(|line| line.contains(entity)).filter(|line| line.contains("with 5 rows")).count()
    };
    assert_eq!((rows("/episode_0/action "), rows("/episode_0/pixels ")), (1, 0), "{printed}");
}
