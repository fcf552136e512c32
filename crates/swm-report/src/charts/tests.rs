//! Tests of the geometry of charts: no text overlaps another or leaves its chart.

use crate::page::{ReportOptions, render};
use crate::plot::check_texts;
use crate::training_log::{Metrics, Series, Training};
use std::path::PathBuf;
use swm_core::results::{Counting, EpisodeResult, Prediction, Run, Searches, Summary, Timing, Trajectory};
use swm_core::{PlanTrace, Results};

/// Names of many lengths, scripts and reserved characters.
const NAMES: [&str; 7] = [
    "random",
    "a policy whose name is much longer than the room that a chart has for the names of policies, whatever its layout",
    "<b>&\"'",
    "光源の位置と背景の色が同時に変わる条件のとても長い名前",
    "WWWWWWWWWWWWWWWWWWWWWWWWWWWWWWWWWWWWWWWW",
    "\u{202e}reversed\u{1}\n",
    "pldm",
];

/// A run of 70 episodes with searches and prediction errors of a size.
fn run(condition: &str, policy: &str, solved: usize, size: f64) -> Run {
    let episode = |i: usize| EpisodeResult {
        success: i < solved,
        solved_at_start: i == 69,
        steps: if i < solved { 8 + i } else { 60 },
        ..EpisodeResult::new(i as u64)
    };
    let times = [size, size, 1.5 * size];
    let timing = Timing { plan_seconds: Summary::of(&times), wall_seconds: 83.0 };
    let mut run = Run::new(condition, policy, Counting::default(), (0..70).map(episode).collect(), timing);
    let falling = |i: i32| (size * f64::from(9 - i)) as f32;
    let curve: Vec<f32> = (0..9).map(falling).collect();
    let trace = PlanTrace { best: curve.clone(), mean: curve.clone(), spread: curve, ..PlanTrace::default() };
    run.searches = Searches::of(&vec![trace; 3]);
    let trajectory = |i: usize| Trajectory {
        start: [i, 7],
        success: Some(i.is_multiple_of(2)),
        errors: (1..=7).map(|step| size * step as f64).collect(),
    };
    run.prediction = Some(Prediction::new(5, 1.0, (0..9).map(trajectory).collect()));
    run
}

/// Results of these policies under three conditions.
fn results(policies: &[&str], size: f64) -> Results {
    let conditions = ["in distribution", NAMES[1], NAMES[3]];
    let each = conditions.iter().enumerate().flat_map(|(i, condition)| {
        let run = move |(j, policy): (usize, &&str)| run(condition, policy, (i * 31 + j * 17) % 70, size);
        policies.iter().enumerate().map(run)
    });
    Results {
        env: "swm/PushT-v1".to_owned(),
        protocol: "episodic".to_owned(),
        runs: each.collect(),
        ..Results::default()
    }
}

#[test]
fn texts_of_charts_do_not_overlap() {
    let series = |name: &str, size: f64| {
        let points = (0..50).map(|i| (f64::from(i * 1000), size * f64::from(i % 7))).collect();
        Series { name: name.to_owned(), points }
    };
    for (policies, size) in
        [(&["random", "pldm"][..], 0.04), (&NAMES[..3], 1e-9), (&NAMES[3..], 3e7), (&["random"], 0.0)]
    {
        let names = [NAMES[1], NAMES[2], "loss"];
        let series = names.iter().flat_map(|name| [series(name, size), series(name, -1e-5 * size)]).collect();
        let metrics = Ok(Metrics { over: "step".to_owned(), series });
        let training = vec![Training { policy: "pldm".to_owned(), metrics }];
        let results = [(PathBuf::from("results.json"), results(policies, size))];
        let page = render(&results, &ReportOptions { training, ..ReportOptions::default() }).expect("a page");
        check_texts(&page, 0);
        let charts = page.matches("<svg class=\"chart").count();
        assert!(charts > 30, "{charts} charts");
        assert!(!page.contains("no room"), "every chart fits");
    }
}
