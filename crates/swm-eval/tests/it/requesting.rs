//! Evaluation requests: running, serialising, reproducing and comparing them.

use crate::evaluating::recorded;
use crate::line::{Line, Walker};
use crate::memory::MemoryReader;
use crate::predicting::Drifting;
use serde_json::json;
use std::sync::Arc;
use swm_core::results::{Counting, Run};
use swm_core::run::{Control, Event};
use swm_core::{Env, Error, Policy, Result, Results, VariationRequest};
use swm_data::{Part, Reader, Split};
use swm_eval::reproduce::{Kind, differences};
use swm_eval::{
    Condition, EvalRequest, HeldOut, PolicyKind, PolicyRequest, Predictor, Recorded, ResolvedPolicy, Resolver,
    RunOptions, StartsRequest, World, reproduce, reproduce_episodes,
};

/// A resolver of the line environment, one dataset, and a walker with weights.
pub struct TestResolver {
    data: Arc<MemoryReader>,
    weights: String,
    /// The hash of the dataset of the walker's probe, if it has one.
    probe: Option<String>,
}

impl TestResolver {
    pub fn new() -> Self {
        Self::of(recorded(60))
    }

    /// A resolver with this dataset.
    pub fn of(data: MemoryReader) -> Self {
        Self { data: Arc::new(data), weights: "w0".to_owned(), probe: None }
    }
}

impl Resolver for TestResolver {
    fn env(&self, request: &EvalRequest) -> Result<Box<dyn Env>> {
        match request.env.as_str() {
            "test/Line-v0" => Ok(Box::new(Line::new())),
            other => Err(Error::unknown("environment", other, ["test/Line-v0"], "there is one")),
        }
    }

    fn dataset(&self, _: &str) -> Result<Arc<dyn Reader>> {
        Ok(Arc::clone(&self.data) as Arc<dyn Reader>)
    }

    fn policy(&self, _: &PolicyRequest, _: &World) -> Result<ResolvedPolicy> {
        let walker: Box<dyn Policy> = Box::new(Walker);
        let libraries = [("burn", "9"), ("engine", "1"), ("renderer", "of another machine")];
        let libraries = libraries.map(|(name, version)| (name.to_owned(), version.to_owned())).into();
        let (weights, probe_dataset) = (Some(self.weights.clone()), self.probe.clone());
        Ok(ResolvedPolicy { weights, probe_dataset, libraries, ..ResolvedPolicy::from(walker) })
    }

    fn predictor(&self, request: &PolicyRequest) -> Result<Option<Box<dyn Predictor>>> {
        let has_model = request.kind != PolicyKind::Random;
        Ok(has_model.then(|| Box::new(Drifting { drift: 0.1 }) as Box<dyn Predictor>))
    }
}

pub fn request() -> EvalRequest {
    EvalRequest {
        version: EvalRequest::VERSION,
        env: "test/Line-v0".to_owned(),
        wrappers: vec![],
        wrap_goal: false,
        image: None,
        policies: vec![PolicyRequest {
            name: "walker".to_owned(),
            kind: PolicyKind::Expert { id: "walker".to_owned() },
        }],
        starts: StartsRequest::Episodic,
        episodes: 24,
        seed: 5,
        budget: Some(8),
        counting: Counting::default(),
        conditions: vec![
            Condition { name: "in distribution".to_owned(), variation: VariationRequest::default() },
            Condition {
                name: "goal near".to_owned(),
                variation: VariationRequest {
                    variation: Some(vec!["agent.x".to_owned()]),
                    variation_values: [("goal.x".to_owned(), vec![0.0])].into(),
                },
            },
        ],
        prediction: None,
        planning_seed: None,
    }
}

fn held_out(part: Part) -> StartsRequest {
    let held_out = Some(HeldOut { part, split: Split { validation: 0.3, test: 0.3, seed: 1 } });
    StartsRequest::Dataset { dataset: "line".to_owned(), goal_offset: 4, held_out, one_per_episode: false }
}

fn run(request: &EvalRequest, envs: usize, threads: usize) -> Results {
    let options = RunOptions { envs, threads, ..RunOptions::default() };
    request.run(&TestResolver::new(), &options, &mut Control::new()).expect("the evaluation succeeds")
}

fn repeat(old: &Results, resolver: &TestResolver) -> Result<swm_eval::Reproduction> {
    reproduce(old, resolver, &RunOptions { envs: 3, threads: 2, ..RunOptions::default() }, &mut Control::new())
}

/// Serialises results to JSON and back.
fn round_trip(results: &Results) -> Results {
    serde_json::from_str(&serde_json::to_string_pretty(results).expect("serialising to JSON"))
        .expect("the JSON contains results")
}

fn without_timing(mut results: Results) -> String {
    results.runs.iter_mut().for_each(|run: &mut Run| run.timing = Default::default());
    serde_json::to_string(&results).expect("serialising to JSON")
}

#[test]
fn libraries_of_an_evaluation_are_those_that_play_it_and_those_of_the_model() {
    let results = run(&request(), 2, 1);
    let expected = [("burn".to_owned(), "9".to_owned()), ("engine".to_owned(), "2".to_owned())];
    assert_eq!(results.manifest.libraries, expected.into());
}

#[test]
fn policies_are_compared_with_the_random_floor() {
    let found = run(&request(), 4, 1);
    let names: Vec<(&str, &str)> = found.runs.iter().map(|run| (&*run.condition, &*run.policy)).collect();
    let expected = [
        ("in distribution", "random"),
        ("in distribution", "walker"),
        ("goal near", "random"),
        ("goal near", "walker"),
    ];
    assert_eq!(names, expected);
    assert_eq!(found.comparisons.len(), 2, "one comparison for each condition");
    for (comparison, runs) in found.comparisons.iter().zip(found.runs.chunks(2)) {
        assert_eq!((&*comparison.a, &*comparison.b), ("walker", "random"));
        assert_eq!(comparison.table.n(), runs[0].success.n);
        let rates = runs[1].success.rate - runs[0].success.rate;
        assert!((comparison.table.difference - rates).abs() < 1e-12 && comparison.table.low > 0.0);
    }
    assert_eq!(found.manifest.hashes["weights"], "w0");
    let mut named = request();
    named.policies[0].name = "random".to_owned();
    let error =
        named.run(&TestResolver::new(), &RunOptions::default(), &mut Control::new()).expect_err("a reserved name");
    assert!(error.to_string().contains("it is not the random policy"), "{error}");
    named.policies = vec![request().policies[0].clone(); 2];
    let error =
        named.run(&TestResolver::new(), &RunOptions::default(), &mut Control::new()).expect_err("a name used twice");
    assert!(error.to_string().contains("'walker'") && error.is_usage(), "{error}");
}

#[test]
fn baselines_do_nothing_or_repeat_what_was_recorded() {
    let kinds = [("no-op", PolicyKind::NoOp), ("replay", PolicyKind::Replay)];
    let mut request = request();
    request.conditions.truncate(1);
    request.policies = kinds.map(|(name, kind)| PolicyRequest { name: name.to_owned(), kind }).to_vec();
    let resolver = TestResolver::new();
    let error = request.run(&resolver, &RunOptions::default(), &mut Control::new()).expect_err("episodic starts");
    assert!(error.is_usage() && error.to_string().contains("take starts from a dataset"), "{error}");

    request.starts =
        StartsRequest::Dataset { dataset: "line".to_owned(), goal_offset: 4, held_out: None, one_per_episode: false };
    let found = run(&request, 4, 1);
    let [_, no_op, replay] = &found.runs[..] else { panic!("{} runs", found.runs.len()) };
    assert_eq!((no_op.policy.as_str(), replay.policy.as_str()), ("no-op", "replay"));
    // The goals are four recorded steps away, and the environment repeats them.
    assert!(no_op.success.successes == 0 && no_op.success.n > 10);
    assert_eq!(replay.success.successes, replay.success.n);
    assert!(replay.episodes.iter().all(|episode| episode.steps <= 4));
    assert_eq!(without_timing(found), without_timing(run(&request, 1, 2)), "slots do not matter");
}

#[test]
fn every_policy_and_condition_starts_and_finishes_a_stage() {
    let mut stages = vec![];
    let mut control = Control::new().with_events(|event| match event {
        Event::Started(stage) => stages.push(format!("{} {}", stage.subject.join(", "), stage.total)),
        Event::Finished { metrics, .. } => stages.push(format!("{} {}", metrics[0].0, metrics[0].1 > 0.0)),
        _ => {}
    });
    let options = RunOptions { envs: 4, threads: 1, ..RunOptions::default() };
    request().run(&TestResolver::new(), &options, &mut control).expect("the evaluation succeeds");
    drop(control);
    assert_eq!(
        stages[..4],
        ["random, in distribution 24", "success_rate true", "walker, in distribution 24", "success_rate true"]
    );
    assert_eq!(stages.len(), 8);
}

#[test]
fn results_do_not_depend_on_run_options() {
    let mut requests = vec![request(); 3];
    requests[1].starts = held_out(Part::Test);
    requests[1].counting = Counting::Strict { hold: 2 };
    requests[2].starts = held_out(Part::Validation);
    requests[2].counting = Counting::Compat { envs: 9 };
    for request in requests {
        let single = without_timing(run(&request, 1, 1));
        for (envs, threads) in [(7, 1), (24, 2), (50, 2)] {
            assert_eq!(without_timing(run(&request, envs, threads)), single, "{envs} environments, {threads} threads");
        }
    }
}

#[test]
fn held_out_starts_come_from_held_out_episodes() {
    let resolver = TestResolver::new();
    let mut hashes = vec![];
    for part in [Part::Train, Part::Validation, Part::Test] {
        let request = EvalRequest { starts: held_out(part), ..request() };
        let found = run(&request, 4, 1);
        assert_eq!(found.protocol, "dataset");
        assert_eq!(found.manifest.hashes["dataset"], "memory");
        let split = Split { validation: 0.3, test: 0.3, seed: 1 };
        for episode in &found.runs[1].episodes {
            let [position, _] = episode.start.expect("the episode has a start");
            assert_eq!(split.part(resolver.data.episodes()[position].index), part);
        }
        hashes.push(found.manifest.hashes["starts"].clone());
    }
    hashes.sort();
    hashes.dedup();
    assert_eq!(hashes.len(), 3);
    let empty = HeldOut { part: Part::Test, split: Split { test: 0.0, ..Split::default() } };
    let starts = StartsRequest::Dataset {
        dataset: "line".to_owned(),
        goal_offset: 3,
        held_out: Some(empty),
        one_per_episode: false,
    };
    let error = EvalRequest { starts, ..request() }
        .run(&resolver, &RunOptions::default(), &mut Control::new())
        .expect_err("the split has no episodes");
    assert!(error.to_string().contains("the test split") && error.to_string().contains("60 episodes"), "{error}");
}

#[test]
fn results_can_be_reproduced() {
    let resolver = TestResolver::new();
    let mut requests = vec![request(); 2];
    requests[1].starts = held_out(Part::Test);
    requests[1].counting = Counting::Compat { envs: 2 };
    for request in requests {
        let first = round_trip(&run(&request, 4, 1));
        let mut expected = request.clone();
        expected.policies.insert(0, PolicyRequest { name: "random".to_owned(), kind: PolicyKind::Random });
        assert_eq!(
            EvalRequest::of(&first.manifest).expect("reading the request"),
            expected,
            "the manifest has the request with the random floor"
        );
        let second = repeat(&first, &resolver).expect("the reproduction succeeds");
        assert_eq!(second.differences, []);
        assert!(second.holds());
    }
}

/// Checks the played trajectories of a run with the model [`Drifting`]: its error after k model steps is 0.1 k, in one of two
/// latent dimensions, so its optimism is that of a point that far beyond the one that was reached.
fn check_played(run: &Run) {
    let played = run.played.as_ref().expect("played trajectories");
    let counted: Vec<_> = run.episodes.iter().filter(|episode| episode.steps >= 2).collect();
    assert!(
        !counted.is_empty() && played.trajectories.len() == counted.len(),
        "a trajectory for each episode with a model step"
    );
    for (trajectory, episode) in played.trajectories.iter().zip(counted) {
        assert_eq!((Some(trajectory.start), trajectory.success), (episode.start, episode.success));
        assert_eq!(trajectory.errors.len(), episode.steps / 2);
        let off = |k: usize| 0.1 * k as f64;
        for (k, error) in trajectory.errors.iter().enumerate() {
            let known = off(k + 1).powi(2) / 2.0;
            assert!((error - known).abs() < 1e-4 * known, "step {k}: {error}, expected {known}");
        }
        // Between the optimism of points on the one and on the other side of the goal, 10 away from it.
        let (k, optimism) = (trajectory.errors.len(), trajectory.optimism.expect("the line has a goal"));
        let most = (off(k).powi(2) + 20.0 * off(k)) / 2.0;
        assert!(optimism != 0.0 && optimism.abs() <= most, "{optimism} of at most {most}");
    }
}

#[test]
fn prediction_errors_are_grouped_by_the_outcome_of_the_episode() {
    let request_with_prediction =
        EvalRequest { starts: held_out(Part::Train), prediction: Some(2), budget: Some(4), ..request() };
    let found = run(&request_with_prediction, 4, 1);
    assert_eq!((&found.runs[0].prediction, &found.runs[2].prediction), (&None, &None), "the floor has no model");
    for run in [&found.runs[1], &found.runs[3]] {
        let prediction = run.prediction.as_ref().expect("a prediction");
        for (trajectory, episode) in prediction.trajectories.iter().zip(&run.episodes) {
            assert_eq!(Some(trajectory.start), episode.start);
            assert_eq!(trajectory.success, (!episode.solved_at_start).then_some(episode.success));
        }
        let grouped: usize = prediction.groups[1..].iter().map(|group| group.trajectory.n).sum();
        assert_eq!((prediction.groups[0].trajectory.n, grouped), (24, run.success.n));
        check_played(run);
    }
    let other = run(&request_with_prediction, 3, 2);
    assert!(
        found
            .runs
            .iter()
            .zip(&other.runs)
            .all(|(a, b)| a.played == b.played && (a.policy != "random" || a.played.is_none()))
    );
    assert_eq!(repeat(&round_trip(&found), &TestResolver::new()).expect("the reproduction succeeds").differences, []);
    let error = EvalRequest { prediction: Some(2), ..request() }.run(
        &TestResolver::new(),
        &RunOptions::default(),
        &mut Control::new(),
    );
    assert!(error.expect_err("no recorded trajectories").to_string().contains("take starts from a dataset"));
}

#[test]
fn reproduction_lists_differences() {
    let resolver = TestResolver::new();
    let mut first = round_trip(&run(&request(), 4, 1));
    first.runs[3].episodes[7].steps += 1;
    first.manifest.swm_version = "0.0.9".to_owned();
    first.manifest.hashes.insert("goals".to_owned(), "other".to_owned());
    let second = repeat(&first, &resolver).expect("the reproduction succeeds");
    let listed: Vec<(Kind, &str)> = second.differences.iter().map(|d| (d.kind, d.what.as_str())).collect();
    let expected = [
        (Kind::Version, "stable-worldmodel"),
        (Kind::Input, "hash of goals"),
        (Kind::Finding, "episode 7 of walker, goal near"),
    ];
    assert_eq!(listed, expected);
    assert!(!second.holds());
    let sentence = second.differences[0].to_string();
    assert!(sentence.starts_with("stable-worldmodel: was 0.0.9, is "), "{sentence}");

    let mut fewer = second.results.clone();
    fewer.runs.remove(0);
    fewer.manifest.config["seed"] = json!(6);
    let listed = differences(&second.results, &fewer);
    assert_eq!((listed[0].what.as_str(), listed[0].was.as_str(), listed[0].is.as_str()), ("request, seed", "5", "6"));
    assert_eq!(listed.iter().filter(|d| d.is == "nothing").count(), 24 + 1, "24 episodes and the success rate");
}

#[test]
fn some_episodes_can_be_reproduced() {
    let resolver = TestResolver::new();
    let numbers = [3, 20, 8];
    let options = RunOptions { envs: 2, threads: 2, ..RunOptions::default() };
    let again = |old: &Results| reproduce_episodes(old, &numbers, &resolver, &options, &mut Control::new());
    let of_dataset = EvalRequest { starts: held_out(Part::Test), prediction: Some(2), ..request() };
    for request in [request(), of_dataset] {
        let first = round_trip(&run(&request, 4, 1));
        let second = again(&first).expect("the reproduction succeeds");
        assert_eq!(second.differences, []);
        for (old, new) in first.runs.iter().zip(&second.results.runs) {
            assert_eq!(new.episodes, numbers.map(|number| old.episodes[number].clone()));
        }
        let listed = |change: &dyn Fn(&mut Results)| -> Vec<String> {
            let mut changed = first.clone();
            change(&mut changed);
            again(&changed)
                .expect("the reproduction succeeds")
                .differences
                .into_iter()
                .map(|found| found.what)
                .collect()
        };
        let found = listed(&|results| results.runs[3].episodes[8].success ^= true);
        assert_eq!(found, ["episode 8 of walker, goal near", "walker, goal near"]);
        assert_eq!(listed(&|results| results.runs[3].episodes[9].success ^= true), [""; 0], "it is not played");
        let found = listed(&|results| results.runs[1].episodes[9].seed += 1);
        assert_eq!(found, ["seed and row of the start of episode 9 of walker, in distribution"]);
        let found = listed(&|results| results.runs[1].episodes[9].start = Some([0, 0]));
        assert_eq!(found, ["seed and row of the start of episode 9 of walker, in distribution"]);
        let found = listed(&|results| drop(results.manifest.hashes.insert("starts".to_owned(), "0".to_owned())));
        assert_eq!(found, ["hash of starts"]);
        // Every start has another seed then.
        let found = listed(&|results| results.manifest.config["seed"] = json!(6));
        assert!(found.len() > 4 * 24 && found.contains(&"hash of goals".to_owned()), "{found:?}");
    }
    let error = reproduce_episodes(&run(&request(), 4, 1), &[24], &resolver, &options, &mut Control::new());
    assert!(error.expect_err("there are 24 episodes").to_string().contains("number 24"));
    let compat = run(&EvalRequest { counting: Counting::Compat { envs: 2 }, ..request() }, 2, 1);
    assert!(again(&compat).expect_err("compat counting").to_string().contains("the whole evaluation"));
}

#[test]
fn reproduction_with_another_dataset_of_the_probe_is_rejected() {
    let resolver = |hash: &str| TestResolver { probe: Some(hash.to_owned()), ..TestResolver::new() };
    let old = request().run(&resolver("p0"), &RunOptions::default(), &mut Control::new()).expect("an evaluation");
    assert_eq!(old.manifest.hashes["probe dataset"], "p0");
    assert!(repeat(&old, &resolver("p0")).is_ok());
    let Err(error) = repeat(&old, &resolver("p1")) else { panic!("another dataset is accepted") };
    let error = error.to_string();
    assert!(error.contains("probe dataset") && error.contains("p1"), "{error}");
}

#[test]
fn reproduction_with_other_weights_is_rejected_before_the_first_episode() {
    let first = run(&request(), 4, 1);
    let other = TestResolver { weights: "w1".to_owned(), ..TestResolver::new() };
    let mut stages = 0;
    let options = RunOptions { envs: 2, ..RunOptions::default() };
    let mut control = Control::new().with_events(|event| stages += usize::from(matches!(event, Event::Started(_))));
    let error = reproduce(&first, &other, &options, &mut control);
    drop(control);
    let error = error.expect_err("reproducing with other weights").to_string();
    assert!(error.contains("w1") && error.contains("made with w0"), "{error}");
    assert_eq!(stages, 0);
}

#[test]
fn results_without_a_valid_request_are_not_reproduced() {
    let resolver = TestResolver::new();
    let first = run(&request(), 4, 1);
    let rejected = |change: &dyn Fn(&mut Results)| {
        let mut old = first.clone();
        change(&mut old);
        repeat(&old, &resolver).map(|_| ()).expect_err("the request is rejected").to_string()
    };
    let message = rejected(&|old| old.manifest.config["version"] = json!(99));
    assert!(message.contains("layout 99; this version reads 1"), "{message}");
    let message = rejected(&|old| old.manifest.config["hold"] = json!(2));
    assert!(message.contains("unknown field `hold`"), "{message}");
    let message = rejected(&|old| old.manifest.config = json!({"command": "swm eval lewm"}));
    assert!(message.contains("it contains no request"), "{message}");
    let message = rejected(&|old| old.manifest.kind = "train".to_owned());
    assert!(message.contains("'train'"), "{message}");
    let message = rejected(&|old| old.runs.push(old.runs[1].clone()));
    assert!(message.contains("two runs of"), "{message}");
}

/// Names of policies and conditions are free: those of two runs can be joined to the same text.
#[test]
fn runs_whose_names_join_to_one_text_are_compared_each() {
    let mut request = EvalRequest { prediction: None, ..request() };
    let walker = request.policies[0].clone();
    let other = PolicyRequest { name: format!("{}, in distribution", walker.name), ..walker.clone() };
    request.policies = vec![walker.clone(), other];
    request.conditions[0].name = "in distribution, default".to_owned();
    request.conditions[1].name = "default".to_owned();
    let results = run(&request, 4, 1);
    for forged in 0..results.runs.len() {
        let mut old = results.clone();
        old.runs[forged].episodes[2].total_reward += 1.0;
        let differences = differences(&old, &results);
        assert_eq!(differences.len(), 1, "{} under {}", results.runs[forged].policy, results.runs[forged].condition);
    }
}

/// An episode that is played again, alone and without its dataset, has the outcome that it has in the evaluation.
#[test]
fn replayed_episodes_have_the_same_outcomes() {
    let (resolver, options) = (TestResolver::new(), RunOptions { envs: 2, ..RunOptions::default() });
    let dataset =
        StartsRequest::Dataset { dataset: "line".to_owned(), goal_offset: 4, held_out: None, one_per_episode: false };
    for starts in [StartsRequest::Episodic, dataset] {
        let whole = EvalRequest { starts, prediction: None, counting: Counting::default(), ..request() };
        let walker = whole.policies.iter().find(|policy| policy.kind != PolicyKind::Random).expect("a policy").clone();
        let condition = whole.conditions[0].clone();
        let whole = EvalRequest { policies: vec![walker.clone()], conditions: vec![condition], ..whole };
        let results = whole.run(&resolver, &options, &mut Control::new()).expect("an evaluation");
        let run = results.runs.iter().find(|run| run.policy == walker.name).expect("a run");
        let numbers = [run.episodes.len() - 1, 0, 2];
        let play = |rows: Option<(&swm_core::Batch, &[[usize; 2]])>| {
            whole.replay(Recorded { numbers: &numbers, rows }, &resolver, &options, &mut Control::new())
        };
        let first = play(None).expect("played episodes");
        let expected: Vec<_> = numbers.iter().map(|&number| run.episodes[number].clone()).collect();
        assert_eq!(first.run.episodes, expected);
        assert_eq!(first.starts.rows(), 3);
        let picks: Vec<[usize; 2]> = expected.iter().filter_map(|episode| episode.start).collect();
        assert_eq!(first.rows.is_some(), picks.len() == 3);
        if let Some(rows) = &first.rows {
            let again = play(Some((rows, &picks))).expect("played episodes");
            assert_eq!(again.run.episodes, expected);
            assert!(play(Some((rows, &picks[1..]))).is_err(), "a start without its rows");
        }
    }
}
