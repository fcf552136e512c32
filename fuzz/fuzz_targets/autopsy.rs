//! `autopsy.json`: the line of the lab, and the page.

#![no_main]

use serde::Deserialize;
use std::path::PathBuf;
use swm::cli::Pages;
use swm::lab::reports::{Kind, Reports as _};
use swm_core::results::{
    ArmRuns, Autopsy, Counting, EpisodeResult, Ingredient, ProbeScore, ProbeScores, Run, Timing, game, members,
};
use swm_core::{Key, files};
use swm_report::{AutopsyPage, FrameStrip, write_autopsy};

#[derive(Deserialize)]
struct Document {
    model: String,
    env: String,
    autopsy: Autopsy,
    probes: Option<ProbeScores>,
}

/// An autopsy of 12 starts, which the search and the true dynamics solve.
fn seed() {
    let run = |solved: usize| {
        let episode = |i| EpisodeResult { success: i < solved, start: Some([i, 3]), ..EpisodeResult::new(i as u64) };
        Run::new("in distribution", "lewm", Counting::default(), (0..12).map(episode).collect(), Timing::default())
    };
    let ingredients = [Ingredient::Search, Ingredient::Dynamics];
    let arm = |coalition| {
        let ingredients = members(&ingredients, coalition);
        ArmRuns { runs: vec![run(3 + 4 * ingredients.len()); 3], ingredients }
    };
    let arms: Vec<ArmRuns> = game(&ingredients).coalitions().into_iter().map(arm).collect();
    let found = Autopsy::of(&run(3), &arms, Counting::default(), Key::new(1)).expect("an autopsy");
    let element = ProbeScore { element: "state[0]".into(), linear: Some(0.5), network: Some(0.9), trivial: None };
    let probes = ProbeScores { dataset: "rooms".into(), trivial: None, elements: vec![element] };
    let document = serde_json::json!({"version": 1, "model": "zoo:two-room/lewm", "env": "swm/TwoRoom-v1", "study": "00",
        "autopsy": found, "probes": probes});
    swm_fuzz::seed("autopsy", &swm_fuzz::json(&document));
}

libfuzzer_sys::fuzz_target!(
    init: seed(),
    |bytes: &[u8]| {
        let path = swm_fuzz::file(Kind::Autopsy.file(), bytes);
        let folder = swm_fuzz::scratch();
        let summary = Pages.summary(Kind::Autopsy, &folder);
        let Ok(Document { model, env, autopsy: found, probes }) = serde_json::from_slice(bytes) else { return };
        assert!(summary.is_ok());
        let strips = vec![FrameStrip { start: 3, set: "S".to_owned(), png: vec![0; 100] }];
        let page = AutopsyPage { title: model, env, found, probes, strips, command: path.display().to_string() };
        let page: PathBuf = write_autopsy(&page, &folder).expect("a page");
        assert!(files::read(&page, 5_000_000).is_ok());
    }
);
