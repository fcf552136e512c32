//! One start from each recorded episode, which statistics need that hold at any number of starts.

use crate::evaluating::recorded;
use crate::memory::MemoryReader;
use crate::requesting::{TestResolver, request};
use rand::Rng as _;
use std::collections::BTreeSet;
use swm_core::Key;
use swm_core::results::{Counting, EpisodeResult, Paired, Proportion, Run, Timing, Verdict};
use swm_core::run::Control;
use swm_data::Reader as _;
use swm_eval::{EvalRequest, RunOptions, Starts, StartsRequest};

/// Steps from a start to its goal.
const OFFSET: usize = 4;
/// The recorded episodes of simulations.
const EPISODES: usize = 60;
/// The level of intervals and tests.
const LEVEL: f64 = 0.05;

#[test]
fn starts_come_from_different_episodes_and_fewer_are_the_first_of_them() {
    let reader = recorded(40);
    let all: Vec<usize> = (0..40).collect();
    let choose = |n, seed| Starts::choose_one_per_episode(&reader, &all, n, OFFSET, seed);
    let long: Vec<usize> = all.iter().copied().filter(|e| reader.episodes()[*e].length > OFFSET).collect();
    let most = choose(long.len(), 3).expect("as many starts as episodes");
    assert_eq!(most.iter().map(|[episode, _]| *episode).collect::<BTreeSet<_>>(), long.iter().copied().collect());
    assert!(most.iter().all(|[episode, step]| step + OFFSET < reader.episodes()[*episode].length));
    for n in [1, 10, 15] {
        assert_eq!(choose(n, 3).expect("starts"), most[..n]);
    }
    assert_ne!(choose(10, 4).expect("starts"), most[..10]);
    let error = choose(long.len() + 1, 3).expect_err("more starts than episodes").to_string();
    assert!(error.contains(&format!("choose at most {}", long.len())) && error.contains("40 episodes"), "{error}");
    assert!(Starts::choose_one_per_episode(&reader, &[40], 1, OFFSET, 0).is_err(), "no such episode");
}

#[test]
fn a_rule_refuses_several_starts_of_one_episode() {
    let starts = StartsRequest::Dataset {
        dataset: "line".to_owned(),
        goal_offset: OFFSET,
        held_out: None,
        one_per_episode: false,
    };
    let several = EvalRequest { starts, episodes: 20, ..request() };
    let run = |request: &EvalRequest| {
        let (rule, options) =
            ("ci=20".parse().expect("a rule"), RunOptions { envs: 4, threads: 1, ..RunOptions::default() });
        request.run_until(rule, None, &TestResolver::new(), &options, &mut |_| Ok(()), &mut Control::new())
    };
    let error = run(&several).expect_err("several starts of an episode").to_string();
    assert!(error.contains("several starts may come from one recorded episode"), "{error}");
    let one = several.with_one_start_per_episode();
    let results = run(&one).expect("an evaluation");
    results.check().expect("independent starts");
    let episodes: BTreeSet<Option<[usize; 2]>> = results.runs[0].episodes.iter().map(|episode| episode.start).collect();
    assert_eq!(episodes.len(), results.episodes());
    // The request is written as it is, and one without the choice as before.
    let text = |request: &EvalRequest| serde_json::to_string(request).expect("a document");
    assert!(text(&one).contains("one_per_episode") && !text(&request()).contains("one_per_episode"));
    assert_eq!(serde_json::from_str::<EvalRequest>(&text(&one)).expect("a request"), one);
}

/// Draws the outcomes of a policy under two conditions. Each recorded episode is easy or hard, under both conditions and at all
/// of its steps alike, and easier under one of them by chance: its starts are not independent, and the conditions equally hard.
fn outcomes(picks: &[[usize; 2]], repetition: u64) -> [Run; 2] {
    let key = Key::new(22).with("clusters").at(repetition);
    [0, 1].map(|condition| {
        let result = |&[episode, step]: &[usize; 2]| {
            let rate = if key.at(episode as u64).at(condition).rng().random_bool(0.5) { 0.95 } else { 0.05 };
            let mut rng = key.at(episode as u64).at(2 + condition).at(step as u64).rng();
            EpisodeResult {
                success: rng.random_bool(rate),
                start: Some([episode, step]),
                ..EpisodeResult::new(episode as u64)
            }
        };
        let name = ["plain", "red"][condition as usize];
        let episodes = picks.iter().map(result).collect();
        Run::new(name, "model", Counting::default(), episodes, Timing::default())
    })
}

/// The shares of repetitions in which the interval of a rate excludes the true one, and in which equal rates are told apart, at
/// any of these numbers of starts.
fn wrong(repetitions: u64, numbers: &[usize], choose: impl Fn(usize, u64) -> Vec<[usize; 2]>) -> [f64; 2] {
    let mut wrong = [0u32; 2];
    for repetition in 0..repetitions {
        let picks = choose(numbers[numbers.len() - 1], repetition);
        let [plain, red] = outcomes(&picks, repetition);
        let first = |run: &Run, n: usize| {
            Run::new(&run.condition, &run.policy, Counting::default(), run.episodes[..n].to_vec(), Timing::default())
        };
        let excluded = numbers.iter().any(|n| {
            let successes = plain.episodes[..*n].iter().filter(|episode| episode.success).count();
            let rate = Proportion::sequential(successes, *n);
            !(rate.low..=rate.high).contains(&0.5)
        });
        let told_apart = numbers.iter().any(|n| {
            let gap = Paired::sequential(&first(&red, *n), &first(&plain, *n), Counting::default());
            gap.is_some_and(|gap| matches!(gap.verdict, Verdict::Lower | Verdict::Higher))
        });
        wrong[0] += u32::from(excluded);
        wrong[1] += u32::from(told_apart);
    }
    wrong.map(|count| f64::from(count) / repetitions as f64)
}

/// Starts from different episodes hold the level under stopping at the first wrong look; starts from any step do not.
fn check_level(repetitions: u64) {
    let reader: MemoryReader = recorded(EPISODES);
    let all: Vec<usize> = (0..EPISODES).collect();
    let long = all.iter().filter(|episode| reader.episodes()[**episode].length > OFFSET).count();
    let numbers: Vec<usize> = [10, 20, 30, 50].into_iter().take_while(|n| *n < long).chain([long]).collect();
    let one = wrong(repetitions, &numbers, |n, seed| {
        Starts::choose_one_per_episode(&reader, &all, n, OFFSET, seed).expect("starts")
    });
    let most = LEVEL + 3.0 * (LEVEL * (1.0 - LEVEL) / repetitions as f64).sqrt();
    assert!(one.iter().all(|share| *share <= most), "one start per episode: {one:?}, at most {most}");
    let starts: usize = reader.episodes().iter().map(|episode| episode.length.saturating_sub(OFFSET)).sum();
    let numbers: Vec<usize> = [10, 20, 30, 50, 80, 120, 180, 270].into_iter().take_while(|n| *n < starts).collect();
    let several =
        wrong(repetitions.min(300), &numbers, |n, seed| Starts::choose(&reader, n, OFFSET, seed).expect("starts"));
    assert!(several.iter().all(|share| *share > 2.0 * LEVEL), "several starts per episode: {several:?}");
}

#[test]
fn statistics_at_any_number_of_starts_hold_their_level_for_clusters() {
    check_level(300);
}

#[test]
#[ignore = "10,000 repetitions take minutes"]
fn statistics_at_any_number_of_starts_hold_their_level_for_clusters_in_10_000_repetitions() {
    check_level(10_000);
}
