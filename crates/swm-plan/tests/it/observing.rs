//! Observers read every iteration of a search, may end it, and change no plan.

use crate::keyed::{bits, toy_for};
use crate::solvers::trial;
use crate::toys::{Model, Toy};
use std::ops::ControlFlow;
use std::sync::Arc;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use swm_core::run::Interrupt;
use swm_core::{
    Batch, Candidates, ColumnSpec, CostModel, DType, EnvSpec, Error, Iteration, Key, Plan, PlanProblem, Policy, Result,
    Schema, SearchObserver, Space, VariationSpace,
};
use swm_plan::{ActionScale, BetweenIterations, Cem, MpcConfig, MpcPolicy, PlanObserver, SOLVERS, SolverEntry};

const ENVS: [usize; 3] = [0, 1, 2];

/// What an observer read of an iteration.
struct Seen {
    index: usize,
    costs: Vec<f32>,
    elites: Vec<usize>,
    samples: usize,
    has_gradient: bool,
}

/// Records every iteration, and ends the search after `stop_after` of them.
#[derive(Default)]
struct Recorder {
    seen: Mutex<Vec<Seen>>,
    stop_after: Option<usize>,
}

impl SearchObserver for Recorder {
    fn iteration(&self, iteration: &Iteration<'_>) -> Result<ControlFlow<()>> {
        let Iteration { index, candidates, costs, elites, gradient } = iteration;
        assert_eq!(
            candidates.actions.len(),
            candidates.envs * candidates.samples * candidates.horizon * candidates.dim
        );
        assert!(gradient.is_none_or(|gradient| gradient.len() == candidates.actions.len()));
        assert_eq!(costs.len(), candidates.envs * candidates.samples);
        let mut seen = self.seen.lock().expect("no thread has panicked");
        seen.push(Seen {
            index: *index,
            costs: costs.to_vec(),
            elites: elites.clone(),
            samples: candidates.samples,
            has_gradient: gradient.is_some(),
        });
        let stop = self.stop_after.is_some_and(|count| seen.len() >= count);
        Ok(if stop { ControlFlow::Break(()) } else { ControlFlow::Continue(()) })
    }
}

/// Solves the first toy of a solver with changed settings.
fn solve(row: &SolverEntry, changes: &str, observer: Option<&dyn SearchObserver>) -> Result<Plan> {
    let mut settings: serde_json::Value = serde_json::from_str(trial(row.id).short).expect("the settings");
    let changes: serde_json::Value = serde_json::from_str(changes).expect("the changes");
    for (name, value) in changes.as_object().expect("settings by name") {
        settings[name] = value.clone();
    }
    let toy: &Toy = toy_for(row);
    let keys = ENVS.map(|env| Key::new(5).with("plan").at(env as u64));
    let problem =
        PlanProblem { horizon: toy.horizon, space: toy.space, keys: &keys, init: None, deadline: None, observer };
    (row.make)(&settings).expect("the solver").solve(&mut Model::new(toy, &ENVS), problem)
}

#[test]
fn observers_read_every_iteration_and_change_no_plan() {
    for row in SOLVERS.rows {
        let recorder = Recorder::default();
        let observed = solve(row, "{}", Some(&recorder)).expect("a plan");
        assert!(bits(&observed, 3) == bits(&solve(row, "{}", None).expect("a plan"), 3), "{}", row.id);
        let seen = recorder.seen.into_inner().expect("no thread has panicked");
        assert!(!seen.is_empty() && seen.iter().enumerate().all(|(i, seen)| seen.index == i), "{}", row.id);
        assert!(seen[0].has_gradient == seen[0].elites.is_empty(), "{}", row.id);
        for (i, Seen { costs, elites, samples, .. }) in seen.iter().enumerate() {
            let trace = &observed.trace[1];
            let costs = &costs[*samples..2 * samples];
            let lowest = costs.iter().copied().fold(f32::INFINITY, f32::min);
            if elites.is_empty() {
                // The best candidate of the Lagrangian solver need not be the cheapest, and GRASP's trace is shorter.
                assert!(["lagrangian", "grasp"].contains(&row.id) || trace.best[i] == lowest, "{} {i}", row.id);
            } else {
                let elites = &elites[elites.len() / 3..elites.len() / 3 * 2];
                assert_eq!((costs[elites[0]], trace.best[i]), (lowest, lowest), "{} {i}", row.id);
                assert!(elites.is_sorted_by(|&a, &b| costs[a] <= costs[b]), "{} {i}", row.id);
            }
        }
    }
}

#[test]
fn a_stopped_search_returns_the_plan_of_its_iterations() {
    for row in SOLVERS.rows {
        let recorder = Recorder { stop_after: Some(2), ..Recorder::default() };
        let stopped = solve(row, "{}", Some(&recorder)).expect("a plan");
        let expected = match row.id {
            // One iteration is all that it has.
            "predictive_sampling" => solve(row, "{}", None),
            // Two of the first steps, before the multipliers change.
            "lagrangian" => solve(row, r#"{"iterations": 2, "outer_iterations": 1}"#, None),
            // The schedules of the weights depend on the number of iterations.
            "grasp" => {
                assert_eq!(recorder.seen.lock().expect("no thread has panicked").len(), 2);
                continue;
            }
            _ => solve(row, r#"{"iterations": 2}"#, None),
        };
        assert!(bits(&stopped, 3) == bits(&expected.expect("a plan"), 3), "{}", row.id);
    }
}

/// Interrupts at the second check.
struct Second(AtomicUsize);

impl Interrupt for Second {
    fn check(&self) -> Result<()> {
        if self.0.fetch_add(1, Ordering::Relaxed) == 1 { Err(Error::Interrupted) } else { Ok(()) }
    }
}

#[test]
fn a_search_is_interrupted_between_iterations() {
    for row in SOLVERS.rows.iter().filter(|row| row.id != "predictive_sampling") {
        let (recorder, second) = (Recorder::default(), Second(AtomicUsize::new(0)));
        let between = BetweenIterations { interrupt: Some(&second), observer: Some(&recorder) };
        let interrupted = solve(row, "{}", between.observer());
        assert!(matches!(interrupted, Err(Error::Interrupted)), "{}", row.id);
        assert_eq!(recorder.seen.lock().expect("no thread has panicked").len(), 1, "{}", row.id);
    }
    let never = AtomicBool::new(false);
    let between = BetweenIterations { interrupt: Some(&never), observer: None };
    assert!(solve(SOLVERS.get("cem").expect("a solver"), "{}", between.observer()).is_ok());
    assert!(BetweenIterations { interrupt: None, observer: None }.observer().is_none(), "nothing costs nothing");
}

#[test]
fn lagrangian_plans_carry_their_multipliers() {
    for row in SOLVERS.rows {
        let plan = solve(row, "{}", None).expect("a plan");
        for trace in &plan.trace {
            assert_eq!(trace.multipliers.is_empty(), row.id != "lagrangian", "{}", row.id);
            assert!(trace.multipliers.iter().all(|&multiplier| multiplier.is_finite() && multiplier >= 0.0));
        }
        if row.id == "lagrangian" {
            assert!(plan.trace.iter().flat_map(|trace| &trace.multipliers).any(|&it| it > 0.0), "an active constraint");
        }
    }
}

/// A model whose cost is the square of the plan.
struct Square;

impl CostModel for Square {
    fn observe(&mut self, _: &Batch, _: &[usize]) -> Result<()> {
        Ok(())
    }

    fn cost(&mut self, candidates: Candidates<'_>, costs: &mut [f32]) -> Result<()> {
        let plans = candidates.actions.chunks_exact(candidates.horizon * candidates.dim);
        costs.iter_mut().zip(plans).for_each(|(cost, plan)| *cost = plan.iter().map(|a| a * a).sum());
        Ok(())
    }
}

/// Writes down what it is told.
struct Diary(Arc<Mutex<Vec<String>>>);

impl Diary {
    fn write(&self, line: String) {
        self.0.lock().expect("no thread has panicked").push(line);
    }
}

impl SearchObserver for Diary {
    fn iteration(&self, iteration: &Iteration<'_>) -> Result<ControlFlow<()>> {
        self.write(format!("iteration {}", iteration.index));
        Ok(ControlFlow::Continue(()))
    }
}

impl PlanObserver for Diary {
    fn begin(&self, slots: &[usize]) -> Result<()> {
        self.write(format!("begin {slots:?}"));
        Ok(())
    }

    fn end(&self) -> Result<()> {
        self.write("end".to_owned());
        Ok(())
    }
}

#[test]
fn a_policy_shows_its_searches_and_is_interrupted_within_one() {
    let spec = EnvSpec {
        id: "test/Line-v0".to_owned(),
        action_space: Space::uniform_box([1], DType::Float32, -1.0, 1.0),
        columns: vec![],
        observation_space: vec![],
        variation_space: VariationSpace::new(vec![], &[]),
        max_episode_steps: 100,
        cameras: vec![],
        angles: vec![],
    };
    let solver = || Box::new(Cem { samples: 20, iterations: 3, elites: 4, ..Cem::default() });
    let config = MpcConfig { horizon: 2, receding_horizon: 1, action_block: 1, ..MpcConfig::default() };
    let policy = || {
        MpcPolicy::new(solver(), Box::new(Square), config.clone(), ActionScale::unscaled(&spec), &spec, 2)
            .expect("a policy")
    };
    let infos = Batch::zeros(&Schema::new([ColumnSpec::image("pixels", 1, 1)]).expect("a schema"), 2);
    let mut actions = Batch::zeros(&Schema::new([spec.action_column()]).expect("a schema"), 2);
    let expected = {
        policy().act(&infos, &[true; 2], &mut actions).expect("the policy acts");
        actions.bytes(0).to_vec()
    };

    let lines = Arc::new(Mutex::new(vec![]));
    let mut observed = policy().observed(Box::new(Diary(Arc::clone(&lines))));
    let second = Second(AtomicUsize::new(0));
    let interrupted = observed.act_until(&infos, &[true; 2], &mut actions, &second);
    assert!(matches!(interrupted, Err(Error::Interrupted)), "{interrupted:?}");
    let take = || std::mem::take(&mut *lines.lock().expect("no thread has panicked"));
    assert_eq!(take(), ["begin [0, 1]", "iteration 0"]);
    // The policy is usable after the interrupt, and the same search has the same plan.
    observed.act_until(&infos, &[true; 2], &mut actions, &AtomicBool::new(false)).expect("the policy acts");
    assert_eq!(take(), ["begin [0, 1]", "iteration 0", "iteration 1", "iteration 2", "end"]);
    assert!(actions.bytes(0) == expected, "observers and interrupts change no plan");
}
