//! Evaluations as requests: run, written down, read again, run again, compared.

use crate::evaluating::recorded;
use crate::line::{Line, Walker};
use crate::memory::MemoryReader;
use crate::predicting::Drifting;
use serde_json::json;
use std::sync::Arc;
use swm_core::results::{Counting, Run};
use swm_core::{Env, Error, Policy, Result, Results, VariationRequest};
use swm_data::{Part, Reader, Split};
use swm_eval::reproduce::{Kind, differences};
use swm_eval::{
    Actor, Acts, Condition, EvalRequest, HeldOut, Means, Moment, PolicyRequest, Predictor, Resolver, StartsRequest,
    World, reproduce,
};

/// Knows the line, one dataset, and a walker with weights.
struct Known {
    data: Arc<MemoryReader>,
    weights: String,
}

impl Known {
    fn new() -> Self {
        Self { data: Arc::new(recorded(60)), weights: "w0".to_owned() }
    }
}

impl Resolver for Known {
    fn env(&self, request: &EvalRequest) -> Result<Box<dyn Env>> {
        match request.env.as_str() {
            "test/Line-v0" => Ok(Box::new(Line::new())),
            other => Err(Error::unknown("environment", other, ["test/Line-v0"], "there is one")),
        }
    }

    fn dataset(&self, _: &str) -> Result<Arc<dyn Reader>> {
        Ok(Arc::clone(&self.data) as Arc<dyn Reader>)
    }

    fn policy(&self, _: &PolicyRequest, _: &World) -> Result<Actor> {
        let walker: Box<dyn Policy> = Box::new(Walker);
        Ok(Actor { weights: Some(self.weights.clone()), ..Actor::from(walker) })
    }

    fn predictor(&self, request: &PolicyRequest) -> Result<Option<Box<dyn Predictor>>> {
        let shows = request.acts != Acts::Random;
        Ok(shows.then(|| Box::new(Drifting { drift: 0.1 }) as Box<dyn Predictor>))
    }
}

fn request() -> EvalRequest {
    EvalRequest {
        version: EvalRequest::VERSION,
        env: "test/Line-v0".to_owned(),
        wrappers: vec![],
        wrap_goal: false,
        image: None,
        policies: vec![PolicyRequest { name: "walker".to_owned(), acts: Acts::Expert { id: "walker".to_owned() } }],
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
    }
}

fn held_out(part: Part) -> StartsRequest {
    let held_out = Some(HeldOut { part, split: Split { validation: 0.3, test: 0.3, seed: 1 } });
    StartsRequest::Dataset { dataset: "line".to_owned(), goal_offset: 4, held_out }
}

fn run(request: &EvalRequest, envs: usize, threads: usize) -> Results {
    let means = Means { envs, threads, ..Means::default() };
    request.run(&Known::new(), &means, &mut |_| {}).expect("results")
}

fn again(old: &Results, known: &Known) -> Result<swm_eval::Reproduction> {
    reproduce(old, known, &Means { envs: 3, threads: 2, ..Means::default() }, &mut |_| {})
}

/// As JSON, and back: what a file holds.
fn filed(results: &Results) -> Results {
    serde_json::from_str(&serde_json::to_string_pretty(results).expect("JSON")).expect("results")
}

fn timeless(mut results: Results) -> String {
    results.runs.iter_mut().for_each(|run: &mut Run| run.timing = Default::default());
    serde_json::to_string(&results).expect("JSON")
}

#[test]
fn the_floor_is_always_played_and_everybody_is_compared_with_it() {
    let found = run(&request(), 4, 1);
    let names: Vec<(&str, &str)> = found.runs.iter().map(|run| (&*run.condition, &*run.policy)).collect();
    let expected = [
        ("in distribution", "random"),
        ("in distribution", "walker"),
        ("goal near", "random"),
        ("goal near", "walker"),
    ];
    assert_eq!(names, expected);
    assert_eq!(found.comparisons.len(), 2, "one a condition");
    for (comparison, runs) in found.comparisons.iter().zip(found.runs.chunks(2)) {
        assert_eq!((&*comparison.a, &*comparison.b), ("walker", "random"));
        assert_eq!(comparison.table.n(), runs[0].success.n);
        let rates = runs[1].success.rate - runs[0].success.rate;
        assert!((comparison.table.difference - rates).abs() < 1e-12 && comparison.table.low > 0.0);
    }
    assert_eq!(found.manifest.hashes["weights"], "w0");
    let mut named = request();
    named.policies[0].name = "random".to_owned();
    let error = named.run(&Known::new(), &Means::default(), &mut |_| {}).expect_err("no floor by another's name");
    assert!(error.to_string().contains("does not act at random"), "{error}");
    named.policies = vec![request().policies[0].clone(); 2];
    let error = named.run(&Known::new(), &Means::default(), &mut |_| {}).expect_err("two of a name");
    assert!(error.to_string().contains("'walker'") && error.is_usage(), "{error}");
}

#[test]
fn results_do_not_depend_on_what_they_are_computed_with() {
    let mut requests = vec![request(); 3];
    requests[1].starts = held_out(Part::Test);
    requests[1].counting = Counting::Strict { hold: 2 };
    requests[2].starts = held_out(Part::Validation);
    requests[2].counting = Counting::Compat { envs: 9 };
    for request in requests {
        let alone = timeless(run(&request, 1, 1));
        for (envs, threads) in [(7, 1), (24, 2), (50, 2)] {
            assert_eq!(timeless(run(&request, envs, threads)), alone, "{envs} environments, {threads} threads");
        }
    }
}

#[test]
fn held_out_starts_come_from_held_out_episodes() {
    let known = Known::new();
    let mut seen = vec![];
    for part in [Part::Train, Part::Validation, Part::Test] {
        let request = EvalRequest { starts: held_out(part), ..request() };
        let found = run(&request, 4, 1);
        assert_eq!(found.protocol, "dataset");
        assert_eq!(found.manifest.hashes["dataset"], "memory");
        let split = Split { validation: 0.3, test: 0.3, seed: 1 };
        for episode in &found.runs[1].episodes {
            let [position, _] = episode.start.expect("a start");
            assert_eq!(split.part(known.data.episodes()[position].index), part);
        }
        seen.push(found.manifest.hashes["starts"].clone());
    }
    seen.sort();
    seen.dedup();
    assert_eq!(seen.len(), 3);
    let nothing = HeldOut { part: Part::Test, split: Split { test: 0.0, ..Split::default() } };
    let starts = StartsRequest::Dataset { dataset: "line".to_owned(), goal_offset: 3, held_out: Some(nothing) };
    let error = EvalRequest { starts, ..request() }.run(&known, &Means::default(), &mut |_| {}).expect_err("none");
    assert!(error.to_string().contains("the test split") && error.to_string().contains("60 episodes"), "{error}");
}

#[test]
fn results_can_be_made_again() {
    let known = Known::new();
    let mut requests = vec![request(); 2];
    requests[1].starts = held_out(Part::Test);
    requests[1].counting = Counting::Compat { envs: 2 };
    for request in requests {
        let first = filed(&run(&request, 4, 1));
        let mut asked = request.clone();
        asked.policies.insert(0, PolicyRequest { name: "random".to_owned(), acts: Acts::Random });
        assert_eq!(EvalRequest::of(&first.manifest).expect("a request"), asked, "as it was asked, and the floor");
        let second = again(&first, &known).expect("again");
        assert_eq!(second.differences, []);
        assert!(second.holds());
    }
}

#[test]
fn predictions_are_told_apart_by_what_came_of_the_start() {
    let asked = EvalRequest { starts: held_out(Part::Train), prediction: Some(2), budget: Some(4), ..request() };
    let found = run(&asked, 4, 1);
    assert_eq!((&found.runs[0].prediction, &found.runs[2].prediction), (&None, &None), "the floor has no model");
    for run in [&found.runs[1], &found.runs[3]] {
        let prediction = run.prediction.as_ref().expect("asked for");
        for (trajectory, episode) in prediction.trajectories.iter().zip(&run.episodes) {
            assert_eq!(Some(trajectory.start), episode.start);
            assert_eq!(trajectory.success, (!episode.solved_at_start).then_some(episode.success));
        }
        let told: usize = prediction.groups[1..].iter().map(|group| group.trajectory.n).sum();
        assert_eq!((prediction.groups[0].trajectory.n, told), (24, run.success.n));
    }
    assert_eq!(again(&filed(&found), &Known::new()).expect("again").differences, []);
    let error = EvalRequest { prediction: Some(2), ..request() }.run(&Known::new(), &Means::default(), &mut |_| {});
    assert!(error.expect_err("nothing recorded").to_string().contains("take starts from a dataset"));
}

#[test]
fn what_differs_is_named() {
    let known = Known::new();
    let mut first = filed(&run(&request(), 4, 1));
    first.runs[3].episodes[7].steps += 1;
    first.manifest.swm_version = "0.0.9".to_owned();
    first.manifest.hashes.insert("goals".to_owned(), "other".to_owned());
    let second = again(&first, &known).expect("again");
    let told: Vec<(Kind, &str)> = second.differences.iter().map(|d| (d.kind, d.what.as_str())).collect();
    let expected = [
        (Kind::Version, "stable-worldmodel"),
        (Kind::Input, "hash of goals"),
        (Kind::Finding, "episode 7 of walker, goal near"),
    ];
    assert_eq!(told, expected);
    assert!(!second.holds());
    let sentence = second.differences[0].to_string();
    assert!(sentence.starts_with("stable-worldmodel: was 0.0.9, is "), "{sentence}");

    let mut fewer = second.results.clone();
    fewer.runs.remove(0);
    fewer.manifest.config["seed"] = json!(6);
    let told = differences(&second.results, &fewer);
    assert_eq!((told[0].what.as_str(), told[0].was.as_str(), told[0].is.as_str()), ("request, seed", "5", "6"));
    assert_eq!(told.iter().filter(|d| d.is == "nothing").count(), 24 + 1, "24 episodes, and their counts");
}

#[test]
fn other_weights_are_refused_before_anything_is_played() {
    let first = run(&request(), 4, 1);
    let other = Known { weights: "w1".to_owned(), ..Known::new() };
    let mut played = 0;
    let means = Means { envs: 2, ..Means::default() };
    let error = reproduce(&first, &other, &means, &mut |moment| {
        played += usize::from(matches!(moment, Moment::Begins { policy: "walker", .. }));
    });
    let error = error.expect_err("other weights").to_string();
    assert!(error.contains("w1") && error.contains("made with w0"), "{error}");
    assert_eq!(played, 0);
}

#[test]
fn requests_are_read_strictly() {
    let known = Known::new();
    let first = run(&request(), 4, 1);
    let refused = |change: &dyn Fn(&mut Results)| {
        let mut old = first.clone();
        change(&mut old);
        again(&old, &known).map(|_| ()).expect_err("refused").to_string()
    };
    let message = refused(&|old| old.manifest.config["version"] = json!(99));
    assert!(message.contains("layout 99, this version reads 1"), "{message}");
    let message = refused(&|old| old.manifest.config["hold"] = json!(2));
    assert!(message.contains("unknown field `hold`"), "{message}");
    let message = refused(&|old| old.manifest.config = json!({"command": "swm eval lewm"}));
    assert!(message.contains("before requests were kept"), "{message}");
    let message = refused(&|old| old.manifest.kind = "train".to_owned());
    assert!(message.contains("'train'"), "{message}");
}
