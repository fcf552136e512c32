//! Tests of the whole page, from synthetic results.

mod browser;
mod hostile;
mod study;

use std::path::{Path, PathBuf};
use swm_core::results::{Comparison, Counting, EpisodeResult, Prediction, Run, Searches, Summary, Timing, Trajectory};
use swm_core::{Manifest, PlanTrace, Results};
use swm_report::{ReportOptions, Training, read_metrics, read_results, write_report, write_report_with};

/// A run of `n` episodes. The first `solved` episodes reach the goal, each one step later than the preceding episode.
fn run(condition: &str, policy: &str, n: usize, solved: usize, plans: Option<f64>) -> Run {
    let episodes: Vec<EpisodeResult> = (0..n)
        .map(|i| EpisodeResult {
            seed: 1000 + i as u64,
            success: i < solved,
            solved_at_start: false,
            steps: if i < solved { 8 + i } else { 60 },
            total_reward: -1.5,
            ..EpisodeResult::default()
        })
        .collect();
    let timing = Timing {
        plan_seconds: plans.and_then(|s| Summary::of(&[s, s, s * 1.5])),
        wall_seconds: if plans.is_some() { 83.0 } else { 0.0 },
    };
    Run::new(condition, policy, Counting::default(), episodes, timing)
}

fn results() -> Results {
    let mut manifest = Manifest::new("evaluate", 7, serde_json::json!({"horizon": 5, "note": "</pre><script>"}));
    manifest.libraries.insert("burn".to_owned(), "0.22.1".to_owned());
    manifest.hashes.insert("weights".to_owned(), "ab".repeat(32));
    let shifted = run("agent.color shifted", "lewm-tiny", 40, 3, Some(0.0421));
    let mut episodes = shifted.episodes;
    (episodes[39].solved_at_start, episodes[39].steps) = (true, 0);
    let runs = vec![
        run("in distribution", "random", 40, 2, None),
        run("in distribution", "expert", 40, 40, None),
        run("in distribution", "lewm-tiny", 40, 37, Some(0.0384)),
        run("agent.color shifted", "random", 40, 2, None),
        Run::new("agent.color shifted", "lewm-tiny", Counting::default(), episodes, shifted.timing),
    ];
    Results {
        manifest,
        env: "swm/TwoRoom-v1".to_owned(),
        protocol: "episodic".to_owned(),
        counting: Counting::default(),
        comparisons: Comparison::all(&runs, Counting::default()),
        runs,
        sequential: false,
        stopping: None,
    }
}

/// Results from a dataset with all optional parts: two models that solve different starts, a goal that must be held,
/// traced searches, and prediction errors.
fn results_with_all_parts() -> Results {
    let mut found = results();
    found.manifest.config = serde_json::json!({"version": 1, "env": "swm/TwoRoom-v1"});
    (found.protocol, found.counting) = ("dataset".to_owned(), Counting::Strict { hold: 5 });
    let mut other = run("in distribution", "pldm", 40, 25, Some(0.0512));
    // `pldm` solves starts 10 to 34, which `lewm-tiny` solves too.
    other.episodes.rotate_right(10);
    for (i, episode) in other.episodes.iter_mut().enumerate() {
        episode.seed = 1000 + i as u64;
        (episode.reached, episode.steps) = (episode.success.then_some(episode.steps), episode.steps + 4);
    }
    found.runs.push(Run::new("in distribution", "pldm", found.counting, other.episodes, other.timing));
    let traces: Vec<PlanTrace> = (0..40)
        .map(|plan| {
            let falling = |from: f32, to: f32| -> Vec<f32> {
                let wobble = 1.0 + 0.3 * (plan as f32 * 0.7).sin();
                (0..30).map(|i| wobble * (to + (from - to) * (-(i as f32) / 6.0).exp())).collect()
            };
            let (best, mean, spread) = (falling(9.0, 1.0), falling(16.0, 1.2), falling(1.0, 0.05));
            PlanTrace { best, mean, spread, ..PlanTrace::default() }
        })
        .collect();
    let trajectories = (0..40).map(|i| {
        let success = i < 37;
        let slope = (1.0 + 0.5 * (i as f64).sin()) * if success { 0.03 } else { 0.06 };
        let errors = (1..=5).map(|step| slope * f64::from(step)).collect();
        Trajectory { start: [i, 7], success: Some(success), errors }
    });
    found.runs[2].searches = Searches::of(&traces);
    found.runs[2].prediction = Some(Prediction::new(5, 0.8, trajectories.collect()));
    found.comparisons = Comparison::all(&found.runs, found.counting);
    found
}

fn page(results: &[(PathBuf, Results)], folder: &Path) -> String {
    let path = write_report(results, folder).expect("the report is written");
    let page = std::fs::read_to_string(path).expect("the page is readable");
    well_formed(&page);
    assert!(page.len() < 5_000_000, "{} bytes", page.len());
    assert!(!page.contains("NaN") && !page.contains("inf\""));
    page.replace('\u{a0}', " ")
}

/// Checks that elements nest, attributes are quoted, and ampersands start entities, so that the page is valid XML apart
/// from its doctype.
fn well_formed(page: &str) {
    let mut open: Vec<&str> = vec![];
    let mut rest = page.strip_prefix("<!DOCTYPE html>").expect("a doctype");
    while let Some(start) = rest.find('<') {
        let text = &rest[..start];
        assert!(!text.contains('>') || open.last() == Some(&"style"), "a stray > in {text}");
        for (i, _) in text.match_indices('&') {
            let entity = text[i + 1..].split(';').next().expect("`split` returns at least one part");
            assert!(["amp", "lt", "gt", "quot", "#39"].contains(&entity), "&{entity}");
        }
        let end = start + rest[start..].find('>').expect("a tag ends");
        let tag = &rest[start + 1..end];
        assert!(tag.matches('"').count().is_multiple_of(2) && !tag.contains('<'), "quotes of <{tag}>");
        let name = |tag: &'_ str| tag.trim_start_matches('/').split([' ', '\n', '/']).next().map(str::len);
        let length = name(tag).expect("the name is a string");
        if let Some(closed) = tag.strip_prefix('/') {
            assert_eq!(open.pop(), Some(closed));
        } else if !tag.ends_with('/') {
            open.push(&tag[..length]);
        }
        rest = &rest[end + 1..];
    }
    assert!(open.is_empty(), "unclosed elements: {open:?}");
}

#[test]
fn page_contains_the_results() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let results = [(PathBuf::from("runs/demo/results.json"), results())];
    let page = page(&results, folder.path());
    // 37 of 40: Wilson 80.1 to 97.4 % (z = 1.96); 2 of 40: 1.4 to 16.5 %; 3 of 39: 2.7 to 20.3 %.
    for words in [
        "<b>92.5 %</b>",
        "80.1 – 97.4 %",
        "1.4 – 16.5 %",
        "2.7 – 20.3 %",
        "92.5 % (37/40)",
        "above the random-policy floor of 5.0 %",
        "not told apart from the random-policy floor of 5.0 %",
        "26 (43)",
        "38 ms (58 ms)",
        "1 min 23 s",
        "demo/results.json",
        &"ab".repeat(32),
        "burn",
        "0.22.1",
        "swm/TwoRoom-v1",
        "agent.color shifted",
        "&lt;/pre&gt;&lt;script&gt;",
    ] {
        assert!(page.contains(words), "the page lacks: {words}");
    }
    assert!(!page.contains("<script") && !page.contains("src=\"http") && !page.contains("@import"));
    assert!(!page.contains("NaN") && !page.contains("inf\""));
}

#[test]
fn policies_are_compared_on_the_same_starts() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let page = page(&[(PathBuf::from("runs/all/results.json"), results_with_all_parts())], folder.path());
    // 37 of 40 against 2 of 40, none solved by the floor alone. 25 of 40 against 37 of 40: 25 both, 12 only one policy, 0
    // only the other: p = 0.000532, one of six comparisons.
    for words in [
        "dataset protocol · counting: strict, held for 5 steps",
        "once the goal was satisfied for 5 steps in a row",
        "One episode was solved at the start; it was not played and does not count",
        "above the random-policy floor of 5.0 %<",
        "lewm-tiny \u{2212} random",
        "pldm \u{2212} lewm-tiny",
        "\u{2212}30.0 [\u{2212}",
        "data-label=\"Both\">25</td><td class=\"n\" data-label=\"Only A\"><b>0</b></td>\
         <td class=\"n\" data-label=\"Only B\"><b>12</b></td><td class=\"n\" data-label=\"Neither\">3</td>\
         <td class=\"n\" data-label=\"p, corrected\">0.003</td><td data-label=\"Verdict on A\">lower</td>",
        "in distribution: 6 comparisons of 40 pairs tell a difference of ",
        "swm reproduce all/results.json",
        "lewm-tiny, in distribution: cost",
        "40 plans</text>",
        "solved (37)",
        "not solved (3)",
        "model steps of 5 environment steps",
    ] {
        assert!(page.contains(words), "the page lacks: {words}");
    }
    assert!(!page.contains("agent.color shifted: cost") && !page.contains("pldm, in distribution: cost"));
    // The shifted run counts one start fewer than its floor, so the report compares their confidence intervals.
    assert!(page.contains("not told apart from the random-policy floor of 5.0 %<"));
}

#[test]
fn verdict_and_generalisation_gap_come_from_paired_starts() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let page = page(&[(PathBuf::from("results.json"), results())], folder.path());
    // Of 39 starts that count in both, 37 are solved in distribution and 3 under the shift.
    for words in [
        "<p class=\"answer\">lewm-tiny solves 92.5 % of 40 starts [80, 97], above the random-policy floor of 5.0 %, and \
         loses 87.2 points [",
        "] under “agent.color shifted”.</p>",
        "<h3>Generalisation gap</h3>",
        "\u{2212}87.2 [",
        "lewm-tiny: 1 comparison of 39 pairs",
    ] {
        assert!(page.contains(words), "the page lacks: {words}");
    }

    // The runs of a policy may be in two files, if it has the same weights and settings.
    let part = |shifted: bool, weights: &str| {
        let mut part = results();
        part.runs.retain(|run| (run.condition != "in distribution") == shifted);
        part.manifest.hashes.insert("weights".to_owned(), weights.to_owned());
        (PathBuf::from("results.json"), part)
    };
    let page = self::page(&[part(false, "a"), part(true, "a")], folder.path());
    assert!(page.contains("<h3>Generalisation gap</h3>"));
    let page = self::page(&[part(false, "a"), part(true, "b")], folder.path());
    assert!(
        !page.contains("<h3>Generalisation gap</h3>") && page.contains("above the random-policy floor of 5.0 %.</p>")
    );
}

#[test]
fn comparisons_with_neither_the_floor_nor_the_best_run_are_folded() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let page = page(&[(PathBuf::from("results.json"), results_with_all_parts())], folder.path());
    let folded = page.split("<summary>The other comparison</summary>").nth(1).expect("a folded comparison");
    let (folded, _) = folded.split_once("</details>").expect("the end of the fold");
    assert!(folded.contains("pldm \u{2212} lewm-tiny") && !folded.contains("pldm \u{2212} expert"));
    let open = page.split("<summary>").next().expect("the open part");
    assert!(open.contains("pldm \u{2212} expert") && open.contains("pldm \u{2212} random"));
}

#[test]
fn compat_counting_is_described_with_the_strict_rate() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let mut results = results();
    results.counting = Counting::Compat { envs: 8 };
    results.runs.truncate(3);
    for run in &mut results.runs {
        run.episodes[39].solved_at_start = true;
        *run = Run::new(&run.condition, &run.policy, results.counting, run.episodes.clone(), Timing::default());
    }
    results.runs[2].strict = Some(Counting::default().rate(&results.runs[2].episodes));
    results.comparisons = Comparison::all(&results.runs, results.counting);
    let file = folder.path().join("results.json");
    std::fs::write(&file, serde_json::to_string(&results).expect("serialising to JSON")).expect("the file is written");
    let results = read_results(&file).expect("reading the results");
    let page = page(&[(file, results)], &folder.path().join("report"));
    for words in [
        "every episode counts, solved at the start or not (1 were)",
        "The first episodes to finish in 8 parallel environments",
        "92.5 % (37/40)",
        "strict 94.9 %",
        ", solved at the start",
    ] {
        assert!(page.contains(words), "the page lacks: {words}");
    }
}

#[test]
fn equal_results_give_equal_pages() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let results = [(PathBuf::from("a/results.json"), results())];
    let pages = ["x", "y"].map(|name| page(&results, &folder.path().join(name)));
    assert!(pages[0] == pages[1]);
}

#[test]
fn external_text_is_escaped() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let mut results = results();
    let markup = "<img src=x onerror=\"alert('1')\">&";
    (results.env, results.protocol) = (markup.to_owned(), markup.to_owned());
    (results.manifest.device, results.manifest.kind) = (markup.to_owned(), markup.to_owned());
    results.manifest.hashes.insert(markup.to_owned(), markup.to_owned());
    for run in &mut results.runs {
        (run.condition, run.policy) = (markup.to_owned(), markup.to_owned());
        run.videos = vec![markup.to_owned()];
    }
    let options = ReportOptions { title: Some(markup.to_owned()), command: Some(markup.to_owned()), training: vec![] };
    let path =
        write_report_with(&[(PathBuf::from(markup), results)], &options, folder.path()).expect("the report is written");
    let page = std::fs::read_to_string(path).expect("the page is readable");
    well_formed(&page);
    assert!(!page.contains("<img"));
}

#[test]
fn empty_results_are_described() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let mut empty = results();
    empty.runs.clear();
    let mut unsolved = results();
    unsolved.env = "swm/PushT-v1".to_owned();
    unsolved.runs = vec![run("in distribution", "lewm", 0, 0, None)];
    unsolved.manifest = Manifest::default();
    let page = page(&[(PathBuf::from("results.json"), empty), (PathBuf::from("b.json"), unsolved)], folder.path());
    assert!(
        page.contains("These results contain no runs.") && page.contains("the random-policy floor was not measured")
    );
    assert!(!page.contains("NaN"));
    let error = write_report(&[], folder.path()).expect_err("there are no results");
    assert!(error.is_usage() && error.to_string().contains("at least one results.json"));
}

#[test]
fn runs_of_other_tasks_are_not_compared() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let with = |budget: u64, dataset: &str| {
        let mut results = results();
        // Another floor, which is not left out as an equal one.
        results.runs[0].episodes[0].steps += 1;
        let starts = serde_json::json!({"dataset": {"dataset": dataset, "goal_offset": 25}});
        results.manifest.config = serde_json::json!({"version": 1, "budget": budget, "starts": starts});
        results.protocol = "dataset".to_owned();
        results
    };
    let page_of = |first: Results, second: Results| {
        let files = [first, second].map(|results| (PathBuf::from("results.json"), results));
        page(&files, folder.path())
    };
    let page = page_of(with(50, "rooms"), with(50, "rooms"));
    assert!(page.contains("lewm-tiny [2] \u{2212} lewm-tiny [1]") && !page.contains("at most 50 steps"));
    for (second, words) in
        [(with(15, "rooms"), "at most 15 steps"), (with(50, "halls"), "goals 25 steps after starts of halls")]
    {
        let page = page_of(with(50, "rooms"), second);
        assert!(!page.contains("lewm-tiny [2]") && page.contains(words), "{words}");
    }
}

#[test]
fn files_of_one_environment_share_a_section() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let files = ["a.json", "b.json"].map(|name| (PathBuf::from(name), results()));
    let page = page(&files, folder.path());
    assert_eq!(page.matches("<h2>Success</h2>").count(), 1);
    assert!(page.contains("lewm-tiny [1]") && page.contains("lewm-tiny [2]") && page.contains("[2] <code>b.json"));

    assert!(!page.contains("random ["), "equal floors are shown once");

    // Runs that differ by condition or policy need no number.
    let mut shifted = results();
    shifted.runs.retain(|run| run.condition != "in distribution");
    let mut plain = results();
    plain.runs.retain(|run| run.condition == "in distribution");
    let page = self::page(&[(PathBuf::from("a.json"), plain), (PathBuf::from("b.json"), shifted)], folder.path());
    assert!(!page.contains("lewm-tiny [") && page.contains("agent.color shifted"));
}

#[test]
fn environments_and_countings_have_separate_sections() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let (first, other) = (results(), Results { env: "swm/PushT-v1".to_owned(), ..results() });
    let compat = Results { counting: Counting::Compat { envs: 8 }, ..results() };
    let files = [first, other, compat].map(|results| (PathBuf::from("results.json"), results));
    let page = page(&files, folder.path());
    assert!(page.contains("<h1>Evaluation in swm/TwoRoom-v1, swm/PushT-v1</h1>"), "each environment is named once");
    for heading in ["swm/TwoRoom-v1 · episodic, strict", "swm/TwoRoom-v1 · episodic, compat with 8 environments"] {
        assert!(page.contains(&format!("<h2>{heading}</h2>")), "{heading}");
    }
}

#[test]
fn videos_are_embedded_or_listed_with_a_reason() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    std::fs::create_dir_all(folder.path().join("videos")).expect("the folder is created");
    std::fs::write(folder.path().join("videos/lewm-2.mp4"), b"not really a video").expect("the file is written");
    let large = std::fs::File::create(folder.path().join("videos/lewm-39.mp4")).expect("the file is written");
    large.set_len((8 << 20) + 1).expect("the file is enlarged");
    let mut results = results();
    results.runs[2].videos =
        ["videos/lewm-2.mp4", "videos/lewm-39.mp4", "videos/lost.mp4", "videos/a.avi"].map(str::to_owned).to_vec();
    let page = page(&[(folder.path().join("results.json"), results)], &folder.path().join("report"));
    assert!(page.contains("data:video/mp4;base64,bm90IHJlYWxseSBhIHZpZGVv"));
    assert!(page.contains("<p>Start 2</p>") && page.contains("<span class=\"mark solved\">solved in 10 steps</span>"));
    assert!(page.contains("<p class=\"note absent\">lewm-tiny, in distribution, episode 39. Not embedded: <code>"));
    for words in ["has 8.0 MiB", "was not found in the folder of its results file", "is neither MP4 nor WebM"] {
        assert!(page.contains(words), "the page lacks: {words}");
    }
}

#[test]
fn training_metrics_become_charts() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let log = folder.path().join("train.jsonl");
    let lines: String = (0..900)
        .map(|i| {
            format!(
                "{{\"step\": {i}, \"loss\": {}, \"seconds\": 2, \"optimizer\": {{\"lr\": 0.001}}}}\n",
                1.0 / f64::from(i + 1)
            )
        })
        .collect();
    std::fs::write(&log, format!("{lines}{{\"step\": 900, \"lo")).expect("the log is written");
    let metrics = read_metrics(&log).expect("an incomplete last line is ignored");
    assert_eq!(metrics.over, "step");
    assert_eq!(metrics.series.iter().map(|s| s.name.as_str()).collect::<Vec<_>>(), ["loss", "optimizer/lr", "seconds"]);
    assert_eq!(metrics.series[0].points[1], (1.0, 0.5));
    let training = Training { policy: "lewm-tiny".to_owned(), metrics: Ok(metrics) };
    let damaged = Training { policy: "expert".to_owned(), metrics: Err("line 2 <is> damaged".to_owned()) };
    let options = ReportOptions { training: vec![training, damaged], ..ReportOptions::default() };
    let results = [(PathBuf::from("results.json"), results())];
    let path = write_report_with(&results, &options, &folder.path().join("report")).expect("the report is written");
    let page = std::fs::read_to_string(path).expect("the page is readable");
    well_formed(&page);
    assert!(page.contains("loss over step, ending at 0.001111") && page.contains("optimizer/lr"));
    assert!(!page.contains("seconds over step"), "metrics of speed are left out");
    assert!(page.contains("<h3><span class=\"swatch c0\"></span>lewm-tiny</h3>"));
    assert!(page.contains("No training curves: line 2 &lt;is&gt; damaged."));

    std::fs::write(&log, "{\"step\": 1}\nloss = 3\n{\"step\": 2}\n").expect("the log is written");
    assert!(
        read_metrics(&log).expect_err("a line that is not JSON").to_string().contains("line 2 is not a JSON object")
    );
}

#[test]
fn valid_results_are_read_and_invalid_files_are_refused() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("results.json");
    let good = serde_json::to_value(results()).expect("serialising to JSON");
    std::fs::write(&path, good.to_string()).expect("the file is written");
    assert_eq!(read_results(&path).expect("reading the results"), results());

    let wrong = |change: &dyn Fn(&mut serde_json::Value)| {
        let mut value = good.clone();
        change(&mut value);
        std::fs::write(&path, value.to_string()).expect("the file is written");
        read_results(&path).expect_err("an invalid file").to_string()
    };
    let newer = wrong(&|v| v["manifest"]["swm_version"] = "0.9.2".into());
    assert!(newer.contains("written by stable-worldmodel 0.9.2") && newer.contains("swm eval"), "{newer}");
    let lacking = wrong(&|v| v["runs"][0].as_object_mut().map(|run| run.remove("success")).map_or((), drop));
    assert!(lacking.contains("a layout that this version does not read") && lacking.contains("success"), "{lacking}");
    let inconsistent = wrong(&|v| v["runs"][0]["success"]["successes"] = 39.into());
    assert!(inconsistent.contains("states 39 successes in 40, but its episodes have 2 in 40"), "{inconsistent}");
    let inconsistent = wrong(&|v| v["comparisons"][1]["only_a"] = 36.into());
    assert!(
        inconsistent.contains("the comparison of lewm-tiny and random does not match the episodes"),
        "{inconsistent}"
    );
    assert!(wrong(&|v| *v = serde_json::json!({"loss": 1})).contains("not a results file"));

    // Older versions wrote no counting and no comparisons; such files are read with the defaults.
    let mut older = good.clone();
    let fields = older.as_object_mut().expect("a JSON object");
    fields.remove("counting").and(fields.remove("comparisons")).expect("the results have both fields");
    std::fs::write(&path, older.to_string()).expect("the file is written");
    let older = read_results(&path).expect("reading the results");
    assert_eq!((older.counting, older.runs, older.comparisons), (Counting::default(), results().runs, vec![]));

    std::fs::write(&path, "{\"manifest\": ").expect("the file is written");
    assert!(read_results(&path).expect_err("an incomplete document").to_string().contains("not a JSON document"));
    let missing = read_results(&folder.path().join("lost.json")).expect_err("a missing file").to_string();
    assert!(missing.contains("lost.json: opening the file"), "{missing}");
}
