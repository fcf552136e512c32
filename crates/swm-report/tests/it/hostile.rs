//! Tests of result files and training logs that a stranger may have written (docs/security.md).

use super::{page, results, run, well_formed};
use serde_json::{Value, json};
use std::fs;
use std::path::{Path, PathBuf};
use swm_core::Results;
use swm_core::results::{Band, Comparison, Prediction, Searches, Trajectory};
use swm_report::{ReportOptions, Training, read_metrics, read_results, write_report, write_report_with};

/// Writes a results file whose third run lists these videos, and returns the page of it.
fn page_with_videos(folder: &Path, videos: &[&str]) -> String {
    let mut results = results();
    results.runs[2].videos = videos.iter().map(|&video| video.to_owned()).collect();
    page(&[(folder.join("results.json"), results)], &folder.join("report"))
}

#[test]
fn videos_outside_the_folder_are_not_embedded() {
    let root = tempfile::tempdir().expect("creating a temporary folder");
    let folder = root.path().join("results");
    fs::create_dir_all(folder.join("videos")).expect("creating a folder");
    let secret = root.path().join("secret.mp4");
    fs::write(&secret, "a secret").expect("writing the file");
    std::os::unix::fs::symlink(&secret, folder.join("videos/link.mp4")).expect("making a link");
    std::os::unix::fs::symlink(root.path(), folder.join("up")).expect("making a link");
    fs::write(folder.join("inside.mp4"), "inside").expect("writing the file");
    let absolute = secret.to_str().expect("a path");
    let page = page_with_videos(
        &folder,
        &["../secret.mp4", absolute, "videos/link.mp4", "up/secret.mp4", "videos/../inside.mp4"],
    );
    assert_eq!(page.matches("is outside the folder of its results file").count(), 4);
    assert_eq!(page.matches("data:video/").count(), 1, "the video inside the folder is embedded");
}

#[test]
fn comparisons_that_are_left_out_hide_nothing() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let given = results();
    assert!(!given.comparisons.is_empty());
    let page_of = |results| page(&[(folder.path().join("results.json"), results)], &folder.path().join("report"));
    let without = page_of(Results { comparisons: vec![], ..given.clone() });
    assert!(without == page_of(given), "the page compares the episodes, whatever the file states");
}

#[test]
fn pipes_and_folders_are_not_read_as_videos() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let pipe = folder.path().join("pipe.mp4");
    let made = std::process::Command::new("mkfifo").arg(&pipe).status().expect("running mkfifo");
    assert!(made.success());
    fs::create_dir(folder.path().join("folder.mp4")).expect("creating a folder");
    let page = page_with_videos(folder.path(), &["pipe.mp4", "folder.mp4"]);
    assert_eq!(page.matches("is not a regular file").count(), 2);
    assert!(read_results(&pipe).expect_err("reading a pipe").to_string().contains("not a regular file"));
    assert!(read_metrics(&pipe).expect_err("reading a pipe").to_string().contains("not a regular file"));
}

#[test]
fn each_video_is_embedded_once_within_a_total_budget() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    fs::write(folder.path().join("one.mp4"), "one video").expect("writing the file");
    let again = page_with_videos(folder.path(), &["one.mp4"; 60]);
    assert_eq!(again.matches("data:video/").count(), 1);
    assert_eq!(again.matches("The same file as <a href=\"#video-1\">video 1</a>").count(), 59);

    let names: Vec<String> = (0..8).map(|i| format!("large-{i}.mp4")).collect();
    for name in &names {
        fs::File::create(folder.path().join(name))
            .and_then(|file| file.set_len(300_000))
            .expect("creating a sparse file");
    }
    let mut large = results();
    large.runs[2].videos = names;
    let path = write_report(&[(folder.path().join("results.json"), large)], folder.path()).expect("writing the report");
    let page = fs::read_to_string(path).expect("reading the page");
    assert_eq!(page.matches("data:video/").count(), 6);
    assert!(page.contains("2 more videos are left out, because a page holds at most 200 videos and 1.7 MiB"));

    let many: Vec<String> = (0..5000).map(|i| format!("missing-{i}.mp4")).collect();
    let page = page_with_videos(folder.path(), &many.iter().map(String::as_str).collect::<Vec<_>>());
    assert!(page.contains("4800 more videos are left out"));
}

#[test]
fn many_policies_give_a_bounded_page_and_too_many_runs_are_refused() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let mut many = results();
    many.runs = vec![run("in distribution", "random", 40, 2, None)];
    many.runs.extend((0..1500).map(|i| run("in distribution", &format!("policy-{i}"), 40, i % 40, None)));
    many.comparisons = Comparison::all(&many.runs, many.counting);
    assert_eq!(many.comparisons.len(), 1500 + 1499);
    let path =
        write_report(&[(PathBuf::from("results.json"), many.clone())], folder.path()).expect("writing the report");
    let page = fs::read_to_string(path).expect("reading the page");
    assert!(page.len() < 5_000_000, "{} bytes", page.len());
    for words in [
        "With more than 20 runs, there are no others",
        "The first 60 of 1501 runs are drawn",
        "Further runs are left out",
        "more comparisons are in the results files",
    ] {
        assert!(page.contains(words), "{words}");
    }

    let files = vec![(PathBuf::from("results.json"), many); 4];
    let error = write_report(&files, folder.path()).expect_err("6004 runs").to_string();
    assert!(error.contains("6004 runs, more than 5000"), "{error}");
}

#[test]
fn many_conditions_names_and_settings_give_a_bounded_page() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let long = |i: usize| format!("{i} {}", "<&\"'>".repeat(190));
    let mut many = results();
    many.manifest.config = json!({"note": "<".repeat(5_000_000)});
    many.manifest.libraries = (0..1000).map(|i| (long(i), long(i).repeat(50))).collect();
    many.manifest.hashes = (0..1000).map(|i| (long(i), long(i).repeat(50))).collect();
    let names: Vec<[String; 2]> = (0..1200).map(|i| [long(i), long(7 * i)]).collect();
    many.runs = names.iter().map(|[condition, policy]| run(condition, policy, 20, 7, Some(0.1))).collect();
    let band = Band { low: 0.0, median: 1.0, high: 2.0 };
    for run in &mut many.runs {
        run.searches =
            Some(Searches { plans: 3, best: vec![band; 500], mean: vec![band; 500], spread: vec![band; 500] });
        run.videos = vec![format!("{}.mp4", run.policy)];
    }
    let log = |i: usize| Training { policy: long(i), metrics: Err(long(i)) };
    let training = (0..1000).map(log).collect();
    let options = ReportOptions { title: Some(long(1).repeat(100)), command: Some(long(2).repeat(10_000)), training };
    let files = vec![(PathBuf::from("results.json"), many); 3];
    let path = write_report_with(&files, &options, folder.path()).expect("writing the report");
    let page = fs::read_to_string(path).expect("reading the page");
    well_formed(&page);
    assert!(page.len() < 5_000_000, "{} bytes", page.len());
    for words in ["The page has no room for further panels.", "more runs are in the results files"] {
        assert!(page.contains(words), "{words}");
    }
}

/// Reads results after a change of their JSON document; returns the error.
fn refused(change: impl Fn(&mut Value)) -> String {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let mut results = results();
    let trajectory = |success| Trajectory { start: [0, 0], success: Some(success), errors: vec![0.5, 1.0] };
    results.runs[2].prediction = Some(Prediction::new(5, 1.0, vec![trajectory(true), trajectory(false)]));
    let mut value = serde_json::to_value(results).expect("serialising to JSON");
    change(&mut value);
    let path = folder.path().join("results.json");
    fs::write(&path, value.to_string()).expect("the file is written");
    match read_results(&path) {
        Err(error) => error.to_string(),
        Ok(results) => {
            page(&[(path, results)], folder.path());
            "accepted".to_owned()
        }
    }
}

#[test]
fn statistics_that_contradict_the_episodes_are_refused() {
    assert_eq!(refused(|_| {}), "accepted");
    let rate = refused(|v| v["runs"][0]["success"]["rate"] = 0.99.into());
    assert!(rate.contains("states a success rate of 99.0 %") && rate.contains("its episodes have 5.0 %"), "{rate}");
    let changes: [(&str, Value, &str); 11] = [
        ("/runs/0/success/low", 0.9.into(), "success rate"),
        ("/runs/0/success/successes", (1u64 << 60).into(), "states 1152921504606846976 successes"),
        ("/runs/4/solved_at_start", 7.into(), "solved at start"),
        ("/runs/2/time_to_goal/median", 1.into(), "time to goal"),
        ("/runs/2/strict", json!({"successes": 9, "n": 3, "rate": 1.0, "low": 1.0, "high": 1.0}), "strict"),
        ("/runs/2/prediction/groups/0/trajectory/mean", 0.1.into(), "prediction errors"),
        ("/runs/2/prediction/trajectories/1/errors", json!([]), "prediction errors"),
        ("/comparisons/0/p", 0.9.into(), "the comparison of expert and random"),
        ("/comparisons/0/verdict", "lower".into(), "the comparison of expert and random"),
        ("/comparisons/0/comparisons", 9.into(), "the comparison of expert and random"),
        ("/comparisons/0/both", (1u64 << 60).into(), "the comparison of expert and random"),
    ];
    for (pointer, value, part) in changes {
        let error = refused(|v| {
            let strict = v["runs"][2].as_object_mut().expect("the run is a JSON object");
            strict.insert("strict".to_owned(), Value::Null);
            *v.pointer_mut(pointer).expect(pointer) = value.clone();
        });
        assert!(error.contains("is inconsistent") && error.contains(part), "{pointer}: {error}");
    }
    let twice = refused(|v| v["comparisons"][1] = v["comparisons"][0].clone());
    assert!(twice.contains("is stated twice"), "{twice}");
}

#[test]
fn results_of_something_else_than_their_request_are_refused() {
    let with_request = |change: &dyn Fn(&mut Value)| {
        refused(|v| {
            v["manifest"]["config"] = json!({
                "version": 1, "env": v["env"], "seed": v["manifest"]["seed"], "starts": "episodic", "counting": v["counting"],
            });
            change(v);
        })
    };
    assert_eq!(with_request(&|_| {}), "accepted");
    for (pointer, value) in [
        ("/env", json!("swm/PushT-v1")),
        ("/protocol", json!("dataset")),
        ("/manifest/seed", json!(77)),
        ("/manifest/config/counting", json!({"strict": {"hold": 25}})),
        ("/manifest/config/counting", json!("easy")),
    ] {
        let error = with_request(&|v| *v.pointer_mut(pointer).expect(pointer) = value.clone());
        assert!(
            error.contains("another environment, protocol, counting or seed than its request"),
            "{pointer}: {error}"
        );
    }
    // A forged run before the true one.
    let twice = refused(|v| {
        let runs = v["runs"].as_array_mut().expect("runs");
        runs.insert(0, runs[2].clone());
        v["comparisons"] = json!([]);
    });
    assert!(twice.contains("it has two runs of 'lewm-tiny' under 'in distribution'"), "{twice}");
}

#[test]
fn extreme_values_are_accepted_and_values_outside_the_layout_are_refused() {
    for (pointer, value) in [
        (
            "/runs/2/timing",
            json!({"plan_seconds": {"n": u64::MAX, "mean": -1e308, "median": 1e308, "p95": 1e307}, "wall_seconds": 1e308}),
        ),
        (
            "/runs/2/timing",
            json!({"plan_seconds": {"n": 0, "mean": 0, "median": -5.0, "p95": -1.0}, "wall_seconds": -1}),
        ),
        (
            "/runs/2/searches",
            json!({"plans": u64::MAX, "best": [{"low": -3e38, "median": 0, "high": 3e38}, {"low": 0, "median": 0, "high": 0}], "mean": [], "spread": []}),
        ),
        ("/runs/2/prediction", json!({"frameskip": u64::MAX, "variance": -1, "trajectories": [], "groups": []})),
        ("/counting", json!({"strict": {"hold": u64::MAX}})),
        ("/runs/2/episodes/39/steps", json!(1u64 << 60)),
        ("/runs/2/episodes/0/total_reward", Value::Null),
        ("/manifest/seed", json!(u64::MAX)),
    ] {
        let found = refused(|v| {
            let run = v["runs"][2].as_object_mut().expect("the run is a JSON object");
            run.entry("searches").or_insert(Value::Null);
            *v.pointer_mut(pointer).expect(pointer) = value.clone();
        });
        assert_eq!(found, "accepted", "{pointer}");
    }
    for (pointer, value) in [
        ("/runs/2/episodes/0/steps", json!(-1)),
        ("/runs/2/episodes/0/seed", json!(1e30)),
        ("/counting", json!({"strict": {"hold": -1}})),
    ] {
        let found = refused(|v| *v.pointer_mut(pointer).expect(pointer) = value.clone());
        assert!(found.contains("has a layout that this version does not read"), "{pointer}: {found}");
    }
    let long = refused(|v| v["runs"][0]["policy"] = "x".repeat(100_000).into());
    assert!(long.contains("has a name of 100000 bytes"), "{long}");
}

#[test]
fn hostile_training_logs_are_refused_or_bounded() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let log = folder.path().join("train.jsonl");
    let error = |text: &str| {
        fs::write(&log, text).expect("the log is written");
        read_metrics(&log).expect_err("a hostile log").to_string()
    };
    assert!(error("{\"loss\": NaN}\n").contains("line 1 is not a JSON object"));
    let names: Vec<String> = (0..1001).map(|i| format!("\"m{i}\": 1")).collect();
    assert!(error(&format!("{{{}}}\n", names.join(","))).contains("another metric after 1000"));
    assert!(error(&format!("{{\"{}\": 1}}\n", "x".repeat(300))).contains("a name of more than 200 bytes"));
    assert!(error(&format!("{}1{}\n", "{\"a\":".repeat(200), "}".repeat(200))).contains("line 1 is not"));
    fs::File::create(&log).and_then(|file| file.set_len(10 << 30)).expect("creating a sparse file of 10 GiB");
    assert!(read_metrics(&log).expect_err("a large log").to_string().contains("is larger than 256.0 MiB"));

    let hostile =
        "{\"<script>alert(1)</script>\": 1e308, \"step\": 1}\n{\"<script>alert(1)</script>\": -1e308, \"step\": 2}\n";
    fs::write(&log, format!("{hostile}{{\"step\": null, \"tiny\": 5e-324}}\n{{\"step\": 4, \"other\": []}}\n"))
        .expect("writing the log");
    let training =
        Training { policy: "<b>".to_owned(), metrics: read_metrics(&log).map_err(|error| error.to_string()) };
    let options = ReportOptions { training: vec![training], ..ReportOptions::default() };
    let results: [(PathBuf, Results); 1] = [(PathBuf::from("results.json"), results())];
    let path = write_report_with(&results, &options, folder.path()).expect("the report is written");
    let page = fs::read_to_string(path).expect("the page is readable");
    well_formed(&page);
    assert!(!page.contains("<script") && page.contains("&lt;script&gt;") && !page.contains("NaN"));
}
