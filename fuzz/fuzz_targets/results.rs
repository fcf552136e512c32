//! `results.json` and `train.jsonl`, and the page of both.

#![no_main]

use swm_core::results::{Comparison, Counting, EpisodeResult, Run, Summary, Timing};
use swm_core::{Manifest, Results};
use swm_report::{ReportOptions, Training, read_metrics, read_results, render};

/// Results of two policies, as an evaluation writes them.
fn results() -> Results {
    let run = |policy: &str, solved: usize| {
        let episode = |i| EpisodeResult { success: i < solved, steps: 9 + i, ..EpisodeResult::new(i as u64) };
        let timing = Timing { plan_seconds: Summary::of(&[0.1, 0.2]), wall_seconds: 2.0 };
        Run::new("in distribution", policy, Counting::default(), (0..3).map(episode).collect(), timing)
    };
    let mut runs = vec![run("random", 1), run("expert", 3)];
    runs[1].videos.push("videos/0.mp4".to_owned());
    Results {
        manifest: Manifest::new("evaluate", 7, ["horizon"].into()),
        env: "swm/TwoRoom-v1".to_owned(),
        protocol: "episodic".to_owned(),
        comparisons: Comparison::all(&runs, Counting::default()),
        runs,
        ..Results::default()
    }
}

libfuzzer_sys::fuzz_target!(
    init: {
        swm_fuzz::seed("results", &swm_fuzz::json(&results()));
        swm_fuzz::seed("metrics", b"{\"step\": 1, \"loss\": {\"total\": 0.5}}\n{\"step\": 2, \"loss\": {\"total\": 1e-3}}\n");
    },
    |bytes: &[u8]| {
        let path = swm_fuzz::file("results.json", bytes);
        let metrics = read_metrics(&path).map_err(|error| error.to_string());
        let training = vec![Training { policy: "expert".to_owned(), metrics }];
        // Some inputs are logs, others are results; the page of each has the other as a seed has it.
        let results = read_results(&path).unwrap_or_else(|_| results());
        let page = render(&[(path, results)], &ReportOptions { training, ..ReportOptions::default() });
        assert!(page.is_ok_and(|page| page.len() < 5_000_000));
    }
);
