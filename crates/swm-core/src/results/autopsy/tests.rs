//! Tests of autopsies on outcomes with planted faults.

use super::Ingredient::{Distance, Dynamics, Probe, Replanning, Search};
use super::*;
use crate::results::Timing;

/// The ingredients without a probe.
const FOUR: [Ingredient; 4] = [Search, Replanning, Dynamics, Distance];

/// A run of starts that were drawn, or that come from recorded episodes with `per_episode` starts each.
fn run(solved: &[bool], per_episode: usize) -> Run {
    let episodes = solved.iter().enumerate().map(|(i, &success)| EpisodeResult {
        success,
        start: (per_episode > 0).then(|| [i / per_episode, i % per_episode]),
        ..EpisodeResult::new(i as u64)
    });
    Run::new("in distribution", "model", Counting::default(), episodes.collect(), Timing::default())
}

/// An arm whose outcomes are the same with three planning seeds.
fn arm(ingredients: &[Ingredient], solved: &[bool]) -> ArmRuns {
    ArmRuns { ingredients: ingredients.to_vec(), runs: vec![run(solved, 0); 3] }
}

/// An autopsy of drawn outcomes. A start is solved if its difficulty, with some noise for every play, is below the success
/// rate of the arm.
fn drawn(ingredients: &[Ingredient], rate: impl Fn(&[Ingredient]) -> f64, key: Key) -> Autopsy {
    let play = |rate: f64, play: Key| {
        let solved = |start: u64| {
            let difficulty: f64 = key.with("start").at(start).rng().random();
            difficulty + play.at(start).rng().random_range(-0.15..0.15) < rate
        };
        run(&Vec::from_iter((0..30).map(solved)), 0)
    };
    let arms = game(ingredients).coalitions().into_iter().map(|coalition| {
        let set = members(ingredients, coalition);
        let runs = (0..3).map(|seed| play(rate(&set), key.with(&letters(&set)).at(seed))).collect();
        ArmRuns { ingredients: set, runs }
    });
    let selection = play(rate(&[]), key.with("selection"));
    Autopsy::of(&selection, &Vec::from_iter(arms), Counting::default(), key).expect("an autopsy")
}

/// The number of 100 drawn autopsies with a finding.
fn count(rate: impl Fn(&[Ingredient]) -> f64, is_counted: impl Fn(&Finding) -> bool) -> usize {
    let finding = |trial| drawn(&FOUR, &rate, Key::new(trial)).finding;
    (0..100).filter(|&trial| is_counted(&finding(trial))).count()
}

fn is_accusation(finding: &Finding) -> bool {
    matches!(finding, Finding::Culprit(_) | Finding::Joint(_))
}

#[test]
fn contributions_and_repairs_of_known_outcomes() {
    let [no, yes] = [false, true];
    let selection = run(&[no, no, no, no, no, yes, yes, yes], 0);
    let arms = [
        // The fifth failure was bad luck.
        arm(&[], &[no, no, no, no, yes, yes, yes, yes]),
        arm(&[Search], &[yes, no, no, no, yes, yes, yes, no]),
        arm(&[Search, Dynamics], &[yes, yes, yes, no, yes, yes, no, no]),
        arm(&[Dynamics], &[no, yes, no, no, yes, yes, yes, yes]),
    ];
    let found = Autopsy::of(&selection, &arms, Counting::default(), Key::new(0)).expect("an autopsy");
    assert_eq!((found.starts, found.planning_seeds, found.repairs.len()), (8, 3, 5));
    // On the failures, S adds 1/5 to nothing and 2/5 to D; D adds 1/5 to nothing and 2/5 to S.
    let recovered = |i: usize| found.contributions[i].recovered.value;
    assert!((recovered(0) - 0.3).abs() < 1e-12 && (recovered(1) - 0.3).abs() < 1e-12, "{:?}", found.contributions);
    let values: Vec<[f64; 3]> =
        found.arms.iter().map(|arm| [arm.success.value, arm.recovered.value, arm.harmed.value]).collect();
    let expected = [[0.5, 0.0, 0.0], [0.5, 0.2, 1.0 / 3.0], [0.625, 0.2, 0.0], [0.625, 0.6, 2.0 / 3.0]];
    let near = |(a, b): (&[f64; 3], &[f64; 3])| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-12);
    assert!(values.iter().zip(&expected).all(near), "{values:?}");
    assert_eq!(found.arms[2].ingredients, [Dynamics]);
    let sets: Vec<&[Vec<Ingredient>]> = found.repairs.iter().map(|repair| &repair.sets[..]).collect();
    let expected: [&[Vec<Ingredient>]; 5] =
        [&[vec![Search]], &[vec![Dynamics]], &[vec![Search, Dynamics]], &[], &[vec![]]];
    assert_eq!(sets, expected);
    let again = Autopsy::of(&selection, &arms, Counting::default(), Key::new(0)).expect("an autopsy");
    assert_eq!(found, again);
    for arms in [&arms[..3], &[]] {
        let error = Autopsy::of(&selection, arms, Counting::default(), Key::new(0)).expect_err("an arm is missing");
        assert!(error.to_string().contains("planning seeds for each set"), "{error}");
    }
    let shorter = run(&[no; 7], 0);
    assert!(Autopsy::of(&shorter, &arms, Counting::default(), Key::new(0)).is_err());
}

#[test]
fn starts_of_one_recorded_episode_are_resampled_together() {
    let solved: Vec<bool> = (0..24).map(|i| i % 12 >= 6).collect();
    let all = [true; 24];
    let autopsy = |per_episode: usize| {
        let arms = [(vec![], &solved[..]), (vec![Search], &all[..])]
            .map(|(ingredients, solved)| ArmRuns { ingredients, runs: vec![run(solved, per_episode); 3] });
        Autopsy::of(&run(&solved, per_episode), &arms, Counting::default(), Key::new(1)).expect("an autopsy")
    };
    let (single, clustered) = (autopsy(0), autopsy(6));
    let width = |found: &Autopsy| found.arms[0].success.high - found.arms[0].success.low;
    // The variance of the mean of 4 clusters that are solved or failed as a whole is six times that of 24 starts.
    let ratio = width(&clustered) / width(&single);
    assert!((2.0..3.0).contains(&ratio), "{ratio}");
    assert_eq!(single.finding, Finding::Culprit(Search));
    // Two recorded episodes with failures are too few, or the interval of success is too wide to show a problem.
    assert!(!is_accusation(&clustered.finding), "{:?}", clustered.finding);
}

#[test]
fn planted_faults_are_found() {
    for fault in [Search, Replanning, Dynamics] {
        for cost in [0.35, 0.5] {
            let rate = |set: &[Ingredient]| if set.contains(&fault) { 0.85 } else { 0.85 - cost };
            let right = count(rate, |finding| *finding == Finding::Culprit(fault));
            assert!(right >= 95, "{fault:?} that costs {cost}: {right} of 100");
        }
    }
    let rate = |set: &[Ingredient]| if set.contains(&Distance) { 0.95 } else { 0.3 };
    let right = count(rate, |finding| *finding == Finding::Culprit(Distance));
    assert!(right >= 95, "the distance of latents: {right} of 100");
}

#[test]
fn nothing_is_accused_without_a_fault() {
    for rate in [0.85, 0.8, 0.5, 0.2] {
        let accused = count(|_| rate, is_accusation);
        assert!(accused <= 5, "{accused} accusations of 100 where every arm solves {rate}");
    }
    // Every ingredient helps a healthy policy a little.
    let accused = count(|set| 0.82 + 0.03 * set.len() as f64, is_accusation);
    assert!(accused <= 5, "{accused} accusations of 100 where all ingredients help a healthy policy");
}

#[test]
fn faults_that_need_two_ingredients_are_joint() {
    let rate = |set: &[Ingredient]| if set.contains(&Search) && set.contains(&Dynamics) { 0.9 } else { 0.3 };
    let joint = count(rate, |finding| *finding == Finding::Joint(vec![Search, Dynamics]));
    let culprits = count(rate, |finding| matches!(finding, Finding::Culprit(_)));
    assert!(joint >= 85 && culprits <= 15, "{joint} joint, {culprits} culprits");
}

#[test]
fn the_true_distance_comes_after_dynamics_and_probe() {
    let sets: Vec<String> = game(&[Dynamics, Probe, Distance])
        .coalitions()
        .into_iter()
        .map(|coalition| letters(&members(&[Dynamics, Probe, Distance], coalition)))
        .collect();
    assert_eq!(sets, ["–", "D", "C", "DC", "DCE"]);
    // The culprit of a model whose latents contain the state, but bent.
    let rate = |set: &[Ingredient]| if set.contains(&Probe) { 0.95 } else { 0.3 };
    let found = drawn(&[Dynamics, Probe, Distance], rate, Key::new(1));
    assert_eq!(found.finding, Finding::Culprit(Probe), "{found:#?}");
}
