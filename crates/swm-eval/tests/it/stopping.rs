//! Studies whose results decide how many episodes are played.

use crate::requesting::{TestResolver, request};
use std::collections::BTreeMap;
use std::path::Path;
use swm_core::results::{Until, Verdict};
use swm_core::run::Control;
use swm_core::{Error, Results, VariationRequest};
use swm_eval::{Cell, Condition, EvalRequest, RunOptions, StartsRequest, Study, StudyFolder};

/// A walker whose budget reaches goals at most three steps away: the goal is drawn, at the end of the line, or close.
fn study(episodes: usize, until: Option<Until>) -> Study {
    let goals = [("in distribution", None), ("goal at the end", Some(4.0)), ("goal close", Some(0.1))];
    let cells = goals.map(|(name, goal)| {
        let variation_values = goal.into_iter().map(|x: f64| ("goal.x".to_owned(), vec![x])).collect();
        let variation = VariationRequest { variation: None, variation_values };
        let conditions = vec![Condition { name: name.to_owned(), variation }];
        Cell {
            starts: String::new(),
            variables: BTreeMap::new(),
            any_seed: None,
            trained_on_starts: None,
            request: EvalRequest { conditions, episodes, budget: Some(3), ..request() },
            inputs: BTreeMap::new(),
            sequential: false,
        }
    });
    let study = Study {
        title: "Goals".to_owned(),
        question: String::new(),
        families: vec![],
        cells: cells.to_vec(),
        until: None,
        ray: None,
        published: vec![],
        arguments: vec![],
    };
    until.map_or(study.clone(), |until| study.until(until))
}

fn run(study: &Study, folder: &Path, control: &mut Control<'_>) -> swm_core::Result<usize> {
    let folder = StudyFolder::new(folder);
    let _lock = folder.create(study)?;
    let options = RunOptions { envs: 5, threads: 1, ..RunOptions::default() };
    study.run(&folder, &TestResolver::new(), &options, control)
}

/// The files of the cells and their contents.
fn cells(folder: &Path) -> BTreeMap<String, String> {
    let entries = std::fs::read_dir(folder.join("cells")).expect("reading a folder").flatten();
    let read = |path: &Path| std::fs::read_to_string(path).expect("reading a file");
    entries.map(|entry| (entry.file_name().to_string_lossy().into_owned(), read(&entry.path()))).collect()
}

#[cfg(unix)]
#[test]
fn results_are_not_written_through_a_link() {
    let (folder, elsewhere) = (tempfile::tempdir().expect("a folder"), tempfile::tempdir().expect("another"));
    let study = study(20, None);
    run(&study, folder.path(), &mut Control::new()).expect("a study");
    let cells = folder.path().join("cells");
    std::fs::remove_dir_all(&cells).expect("removing the results");
    std::os::unix::fs::symlink(elsewhere.path(), &cells).expect("a link");
    let error = run(&study, folder.path(), &mut Control::new()).expect_err("a link").to_string();
    assert!(error.contains("is a symbolic link"), "{error}");
    assert_eq!(elsewhere.path().read_dir().expect("a folder").count(), 0);
}

#[test]
fn cells_stop_when_their_intervals_are_narrow_and_equal_those_played_at_once() {
    let folder = tempfile::tempdir().expect("a folder");
    let study = study(600, Some(Until::Width(10.0)));
    assert_eq!(run(&study, folder.path(), &mut Control::new()).expect("a study"), 3);
    let results = study.results(&StudyFolder::new(folder.path())).expect("results");
    assert_eq!((results.cells, results.done, results.until), (3, 3, Some(Until::Width(10.0))));
    assert!(results.notes_on_rule().len() == 1 && results.families[0].sequential && results.over_seeds.is_empty());
    let stored = StudyFolder::new(folder.path());
    let mut lengths = vec![];
    for (cell, row) in study.cells.iter().zip(&results.rows) {
        assert!(row.success.high - row.success.low <= 0.2, "{row:?}");
        let found = stored.results(cell).expect("results").expect("a cell that is done");
        let episodes = found.runs[0].episodes.len();
        lengths.push(episodes);
        let once = EvalRequest { episodes, ..cell.request.clone() };
        let resolver = TestResolver::new();
        let once = once.run(&resolver, &RunOptions { envs: 3, ..RunOptions::default() }, &mut Control::new());
        let text = |mut results: Results| {
            results.runs.iter_mut().for_each(|run| run.timing = Default::default());
            results.sequential = true;
            serde_json::to_string(&results).expect("a document")
        };
        assert_eq!(text(found), text(once.expect("an evaluation")));
    }
    // Nearly every close goal is reached, so its rate is known sooner.
    assert!(lengths[2] < lengths[0] && lengths.iter().all(|n| (30..600).contains(n)), "{lengths:?}");
}

#[test]
fn a_study_that_was_interrupted_ends_in_the_same_bytes() {
    let study = study(200, Some(Until::Decided(15.0)));
    let [whole, parts] = [(); 2].map(|()| tempfile::tempdir().expect("a folder"));
    run(&study, whole.path(), &mut Control::new()).expect("a study");
    let results = study.results(&StudyFolder::new(whole.path())).expect("results");
    let verdicts: Vec<Verdict> = results.rows.iter().filter_map(|row| Some(row.gap.as_ref()?.verdict)).collect();
    assert_eq!(verdicts, [Verdict::Lower, Verdict::Higher]);
    assert!(results.rows.iter().filter_map(|row| row.gap).all(|gap| gap.e.is_some_and(|e| e >= 40.0)));
    // The unshifted cell has as many starts as the gap that needs most.
    let n: Vec<usize> = results.rows.iter().map(|row| row.success.n + row.solved_at_start).collect();
    assert!(n[0] == n[1].max(n[2]) && n[1] != n[2] && n[0] < 200, "{n:?}");
    for moment in (0..).step_by(7) {
        let mut left = moment;
        let mut control = Control::new().with_poll(|| {
            left -= 1;
            if left < 0 { Err(Error::Interrupted) } else { Ok(()) }
        });
        match run(&study, parts.path(), &mut control) {
            Err(error) => assert!(matches!(error, Error::Interrupted), "{error}"),
            Ok(_) => break,
        }
    }
    assert_eq!(cells(parts.path()), cells(whole.path()));
}

#[test]
fn a_study_continues_with_a_larger_number_of_episodes_and_refuses_a_fixed_one() {
    let [small, whole] = [(); 2].map(|()| tempfile::tempdir().expect("a folder"));
    let rule = Some(Until::Width(10.0));
    run(&study(40, rule), small.path(), &mut Control::new()).expect("a study");
    let results = study(40, rule).results(&StudyFolder::new(small.path())).expect("results");
    assert_eq!((results.done, results.rows[0].success.n + results.rows[0].solved_at_start), (3, 40));
    assert!(results.notes_on_rule()[1].contains("do not meet ci=10"), "{:?}", results.notes_on_rule());
    let error = run(&study(40, None), small.path(), &mut Control::new()).expect_err("a fixed number");
    assert!(error.to_string().contains("--until ci=10") && error.is_usage(), "{error}");
    for folder in [&small, &whole] {
        run(&study(400, rule), folder.path(), &mut Control::new()).expect("a study");
    }
    assert_eq!(cells(small.path()), cells(whole.path()));
}

#[test]
fn rules_that_a_study_cannot_follow_are_errors() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut one = study(40, Some(Until::Decided(10.0)));
    one.cells.truncate(1);
    let error = run(&one, folder.path(), &mut Control::new()).and_then(|_| one.check()).expect_err("one condition");
    assert!(error.to_string().contains("no gap to decide"), "{error}");
    let mut compat = study(40, Some(Until::Width(10.0)));
    compat.cells.iter_mut().for_each(|cell| cell.request.counting = swm_core::results::Counting::Compat { envs: 4 });
    assert!(compat.check().expect_err("compat counting").to_string().contains("protocol=strict"));
    // The dataset has fewer starts than the study may need.
    let mut few = study(100_000, Some(Until::Width(10.0)));
    for cell in &mut few.cells {
        cell.request.starts = StartsRequest::Dataset {
            dataset: "line".to_owned(),
            goal_offset: 4,
            held_out: None,
            one_per_episode: true,
        };
    }
    let folder = tempfile::tempdir().expect("a folder");
    let error = run(&few, folder.path(), &mut Control::new()).expect_err("too few starts").to_string();
    assert!(error.contains("100000") && cells(folder.path()).is_empty(), "{error}");
}

#[test]
fn starts_of_a_dataset_and_prediction_errors_grow_too() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut study = study(50, Some(Until::Width(10.0)));
    study.cells.truncate(1);
    let starts =
        StartsRequest::Dataset { dataset: "line".to_owned(), goal_offset: 4, held_out: None, one_per_episode: true };
    study.cells[0].request =
        EvalRequest { starts, prediction: Some(2), counting: compat(), ..study.cells[0].request.clone() };
    run(&study, folder.path(), &mut Control::new()).expect("a study");
    let found = StudyFolder::new(folder.path()).results(&study.cells[0]).expect("results").expect("a cell");
    let once = EvalRequest { episodes: found.runs[0].episodes.len(), ..study.cells[0].request.clone() };
    let once = once.run(&TestResolver::new(), &RunOptions { envs: 2, ..RunOptions::default() }, &mut Control::new());
    let once = once.expect("an evaluation");
    assert!(found.runs[0].episodes.len() > 10 && found.runs[1].prediction.is_some() && found.runs[1].strict.is_some());
    for (grown, once) in found.runs.iter().zip(&once.runs) {
        assert_eq!((&grown.episodes, &grown.success, &grown.strict), (&once.episodes, &once.success, &once.strict));
        assert_eq!(grown.prediction, once.prediction);
    }
    assert_eq!(found.manifest.hashes, once.manifest.hashes);
}

fn compat() -> swm_core::results::Counting {
    swm_core::results::Counting::Compat { envs: 2 }
}

/// An evaluation of the walker under two conditions.
fn two_conditions(episodes: usize) -> EvalRequest {
    let cells = study(episodes, None).cells;
    let conditions: Vec<Condition> = cells[..2].iter().flat_map(|cell| cell.request.conditions.clone()).collect();
    EvalRequest { conditions, episodes, budget: Some(3), ..request() }
}

/// Evaluates the walker under two conditions until the rule is met, and keeps the results of the last stage.
fn evaluate(
    until: &str,
    episodes: usize,
    earlier: Option<Results>,
    kept: &mut Option<Results>,
    control: &mut Control<'_>,
) -> swm_core::Result<Results> {
    let (request, options) = (two_conditions(episodes), RunOptions { envs: 4, threads: 1, ..RunOptions::default() });
    let mut keep = |results: &Results| {
        *kept = Some(results.clone());
        Ok(())
    };
    request.run_until(until.parse()?, earlier, &TestResolver::new(), &options, &mut keep, control)
}

/// Results without times.
fn text(mut results: Results) -> String {
    results.runs.iter_mut().for_each(|run| run.timing = Default::default());
    serde_json::to_string(&results).expect("a document")
}

#[test]
fn an_evaluation_that_was_interrupted_ends_in_the_same_bytes() {
    for rule in ["ci=8", "decided"] {
        let whole = evaluate(rule, 900, None, &mut None, &mut Control::new()).expect("an evaluation");
        whole.check().expect("consistent results");
        let stopping = whole.stopping.expect("a rule");
        assert!(stopping.met && stopping.most == 900 && (20..900).contains(&whole.episodes()), "{stopping:?}");
        let (mut kept, mut moment) = (None, 0);
        let parts = loop {
            let mut left = moment;
            let mut control = Control::new().with_poll(|| {
                left -= 1;
                if left < 0 { Err(Error::Interrupted) } else { Ok(()) }
            });
            match evaluate(rule, 900, kept.clone(), &mut kept, &mut control) {
                Err(error) => assert!(matches!(error, Error::Interrupted), "{error}"),
                Ok(results) => break results,
            }
            moment += 5 + moment / 3;
        };
        assert_eq!(text(parts), text(whole));
    }
}

#[test]
fn an_evaluation_that_its_results_ended_is_reproduced_and_continued() {
    let few = evaluate("ci=8", 30, None, &mut None, &mut Control::new()).expect("an evaluation");
    assert!(few.stopping.is_some_and(|stopping| !stopping.met) && few.episodes() == 30);
    let options = RunOptions { envs: 3, ..RunOptions::default() };
    let repeated = swm_eval::reproduce(&few, &TestResolver::new(), &options, &mut Control::new()).expect("results");
    assert!(repeated.holds() && repeated.results.stopping == few.stopping, "{:?}", repeated.differences);
    let whole = evaluate("ci=8", 900, None, &mut None, &mut Control::new()).expect("an evaluation");
    let more = evaluate("ci=8", 900, Some(few.clone()), &mut None, &mut Control::new()).expect("an evaluation");
    assert_eq!(text(more), text(whole.clone()));
    // A looser rule is met by what exists.
    let looser = evaluate("ci=20", 900, Some(whole.clone()), &mut None, &mut Control::new()).expect("results");
    assert!(looser.episodes() == whole.episodes() && looser.stopping.is_some_and(|stopping| stopping.met));
    let refused = |earlier: Results, says: &str| {
        let error = evaluate("ci=8", 900, Some(earlier), &mut None, &mut Control::new()).expect_err(says).to_string();
        assert!(error.contains(says), "{error}");
    };
    refused(Results { stopping: None, ..few.clone() }, "fixed in advance");
    let mut other = few.clone();
    other.manifest.config["seed"] = 77.into();
    refused(other, "another request");
    let error = evaluate("ci=8", 20, Some(few), &mut None, &mut Control::new()).expect_err("fewer episodes");
    assert!(error.to_string().contains("30 episodes"), "{error}");
}

#[test]
fn stages_of_conditions_apart_join_to_the_results_of_one_process() {
    let (resolver, episodes) = (TestResolver::new(), 100);
    let (request, control) = (two_conditions(episodes), &mut Control::new());
    assert_eq!(request.stages(), [10, 20, 30, 50, 80, 100]);
    for rule in ["ci=12", "decided", "ci=0.1"] {
        let until: Until = rule.parse().expect("a rule");
        let whole = evaluate(rule, episodes, None, &mut None, control).expect("results");
        let mut parts: Vec<Option<Results>> = vec![None; 2];
        let mut joined = None;
        for stage in request.stages() {
            let options = RunOptions { envs: 3, threads: 1, ..RunOptions::default() };
            for (index, part) in parts.iter_mut().enumerate() {
                let alone = request.part(index).expect("a condition");
                *part = Some(alone.run_stage(stage, part.as_ref(), &resolver, &options, control).expect("a stage"));
            }
            let found = parts.iter().flatten().cloned().collect();
            let results = EvalRequest { episodes: stage, ..request.clone() }.join(found, &resolver, &options);
            let results = results.expect("a stage").stopped(until, episodes);
            let ends = results.stopping.is_some_and(|stopping| stopping.met);
            joined = Some(results);
            if ends {
                break;
            }
        }
        assert_eq!(text(joined.expect("stages")), text(whole), "{rule}");
    }
    // The results of another condition are no earlier stage.
    let options = RunOptions { envs: 3, threads: 1, ..RunOptions::default() };
    let [first, second] = [0, 1].map(|index| request.part(index).expect("a condition"));
    let earlier = second.run_stage(10, None, &resolver, &options, control).expect("a stage");
    let error = first.run_stage(20, Some(&earlier), &resolver, &options, control).expect_err("another condition");
    assert!(error.to_string().contains("another request"), "{error}");
}
