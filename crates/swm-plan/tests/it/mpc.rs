//! Tests of the MPC policy: replanning, initial guesses, executed actions, history, and errors.

use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use swm_core::{
    Batch, Candidates, ColumnSpec, CostModel, DType, EnvSpec, Key, Plan, PlanProblem, PlanSpace, PlanTrace, Policy,
    Result, Schema, Solver, Space, VariationSpace,
};
use swm_plan::{ActionScale, Cem, ICem, MpcConfig, MpcPolicy, TraceLog};

/// One call of the solver: the keys and the initial guess.
type Call = (Vec<Key>, Vec<f32>);

/// A solver whose plan is `100 * (call + 1) + index`, and which records its calls.
struct RecordingSolver {
    calls: Arc<Mutex<Vec<Call>>>,
}

impl Solver for RecordingSolver {
    fn solve(&mut self, _: &mut dyn CostModel, problem: PlanProblem<'_>) -> Result<Plan> {
        let mut calls = self.calls.lock().expect("no thread has panicked");
        calls.push((problem.keys.to_vec(), problem.init.expect("an initial guess").to_vec()));
        let base = 100.0 * calls.len() as f32;
        let len = problem.horizon * problem.space.dim();
        let actions = (0..problem.keys.len() * len).map(|i| base + (i % len) as f32).collect();
        let trace = PlanTrace { best: vec![base], ..PlanTrace::default() };
        Ok(Plan { actions, costs: vec![base; problem.keys.len()], trace: vec![trace; problem.keys.len()] })
    }
}

/// A model that records the slots it observes, and their history.
#[derive(Default)]
struct RecordingModel {
    observed: Arc<Mutex<Vec<Vec<usize>>>>,
    past: Arc<Mutex<Vec<Past>>>,
}

#[derive(Debug, PartialEq)]
struct Past {
    length: i32,
    pixels: Vec<u8>,
    actions: Vec<f32>,
}

impl CostModel for RecordingModel {
    fn observe(&mut self, infos: &Batch, envs: &[usize]) -> Result<()> {
        self.observed.lock().expect("no thread has panicked").push(envs.to_vec());
        if infos.schema().find("history.length").is_some() {
            let row = infos.row(envs[0]);
            self.past.lock().expect("no thread has panicked").push(Past {
                length: row.get::<i32>("history.length")?[0],
                pixels: row.get::<u8>("history.pixels")?.to_vec(),
                actions: row.get::<f32>("history.action")?.to_vec(),
            });
        }
        Ok(())
    }

    fn cost(&mut self, _: Candidates<'_>, _: &mut [f32]) -> Result<()> {
        Ok(())
    }
}

fn spec(high: f64) -> EnvSpec {
    EnvSpec {
        id: "test/Line-v0".to_owned(),
        action_space: Space::uniform_box([1], DType::Float32, -high, high),
        columns: vec![],
        observation_space: vec![],
        variation_space: VariationSpace::new(vec![], &[]),
        max_episode_steps: 100,
        cameras: vec![],
        angles: vec![],
    }
}

/// A policy with a recording solver and a recording model, and their records.
struct Fixture {
    policy: MpcPolicy,
    calls: Arc<Mutex<Vec<Call>>>,
    observed: Arc<Mutex<Vec<Vec<usize>>>>,
    past: Arc<Mutex<Vec<Past>>>,
    infos: Batch,
    actions: Batch,
}

impl Fixture {
    fn new(config: MpcConfig, high: f64, slots: usize) -> Self {
        let calls = Arc::default();
        let cost = RecordingModel::default();
        let (observed, past) = (Arc::clone(&cost.observed), Arc::clone(&cost.past));
        let scale = ActionScale { mean: vec![1.0], std: vec![2.0] };
        let solver = Box::new(RecordingSolver { calls: Arc::clone(&calls) });
        let policy =
            MpcPolicy::new(solver, Box::new(cost), config, scale, &spec(high), slots).expect("creating the policy");
        let infos = Schema::new([ColumnSpec::image("pixels", 1, 1)]).expect("creating the schema");
        let actions = Schema::new([spec(high).action_column()]).expect("creating the schema");
        Self {
            policy,
            calls,
            observed,
            past,
            infos: Batch::zeros(&infos, slots),
            actions: Batch::zeros(&actions, slots),
        }
    }

    fn act(&mut self, active: &[bool]) -> Vec<f32> {
        self.policy.act(&self.infos, active, &mut self.actions).expect("the policy acts");
        self.actions.get::<f32>("action").expect("reading the column of actions").to_vec()
    }

    fn observed(&self) -> Vec<Vec<usize>> {
        self.observed.lock().expect("no thread has panicked").clone()
    }
}

#[test]
fn replans_due_slots_in_one_call_with_warm_starts() {
    let config = MpcConfig { horizon: 3, receding_horizon: 2, action_block: 2, ..MpcConfig::default() };
    let mut fixture = Fixture::new(config, 1e6, 3);
    for slot in 0..3 {
        fixture.policy.begin(slot, Key::new(slot as u64));
    }
    // Two model steps of two environment steps are executed: the first four values of the plan, times 2 plus 1.
    for value in 0..4 {
        assert_eq!(fixture.act(&[true, true, false])[..2], [201.0 + 2.0 * value as f32; 2]);
    }
    assert_eq!(fixture.observed(), [[0, 1]]);
    // Slot 1 begins a new episode and slot 2 becomes active: one call plans for all three slots.
    fixture.policy.begin(1, Key::new(7));
    fixture.act(&[true, true, true]);
    assert_eq!(fixture.observed(), [vec![0, 1], vec![0, 1, 2]]);
    let calls = fixture.calls.lock().expect("no thread has panicked");
    let (keys, init) = &calls[1];
    let key = |seed, plan| Key::new(seed).with("plan").at(plan);
    assert_eq!(keys[..], [key(0, 1), key(7, 0), key(2, 0)]);
    assert_eq!(init[..6], [104.0, 105.0, 0.0, 0.0, 0.0, 0.0], "the part of the last plan that was not executed");
    assert_eq!(init[6..], [0.0; 12], "new episodes start from zeros");
    assert_eq!(fixture.policy.take_latencies().len(), 5);
    assert!(fixture.policy.take_latencies().is_empty());
}

#[test]
fn cold_starts_are_zero_and_open_loop_executes_whole_plans() {
    let config = MpcConfig { horizon: 2, receding_horizon: 2, action_block: 1, ..MpcConfig::default() };
    let mut open = Fixture::new(config.clone(), 1e6, 1);
    (0..3).for_each(|_| drop(open.act(&[true])));
    assert_eq!(
        open.calls.lock().expect("no thread has panicked").iter().map(|c| c.1.clone()).collect::<Vec<_>>(),
        [[0.0; 2]; 2]
    );
    let mut cold = Fixture::new(MpcConfig { receding_horizon: 1, warm_start: false, ..config }, 1e6, 1);
    (0..2).for_each(|_| drop(cold.act(&[true])));
    assert_eq!(cold.calls.lock().expect("no thread has panicked")[1].1, [0.0; 2]);
}

#[test]
fn executed_actions_are_clipped_to_the_action_space() {
    let config = MpcConfig { horizon: 1, receding_horizon: 1, action_block: 1, ..MpcConfig::default() };
    assert_eq!(Fixture::new(config, 5.0, 1).act(&[true]), [5.0]);
}

#[test]
fn history_contains_past_frames_and_actions() {
    let config = MpcConfig {
        horizon: 1,
        receding_horizon: 1,
        action_block: 2,
        warm_start: false,
        history: 3,
        ..MpcConfig::default()
    };
    let mut fixture = Fixture::new(config, 1e6, 2);
    fixture.policy.begin(1, Key::new(0));
    for step in 0..7u8 {
        fixture.infos.get_mut::<u8>("pixels").expect("accessing the column of frames").fill(10 + step);
        fixture.act(&[false, true]);
    }
    let past = fixture.past.lock().expect("no thread has panicked");
    let pixel = |values: [u8; 2]| values.iter().flat_map(|&v| [v; 3]).collect::<Vec<_>>();
    let at = |length, pixels, actions: [f32; 4]| Past { length, pixels: pixel(pixels), actions: actions.to_vec() };
    assert_eq!(past[0], at(0, [0, 0], [0.0; 4]));
    assert_eq!(past[1], at(1, [0, 10], [0.0, 0.0, 100.0, 101.0]));
    assert_eq!(past[2], at(2, [10, 12], [100.0, 101.0, 200.0, 201.0]));
    assert_eq!(past[3], at(2, [12, 14], [200.0, 201.0, 300.0, 301.0]));
    drop(past);
    fixture.policy.begin(1, Key::new(1));
    fixture.act(&[false, true]);
    assert_eq!(fixture.past.lock().expect("no thread has panicked")[4], at(0, [0, 0], [0.0; 4]));
}

#[test]
fn errors_name_invalid_settings() {
    let make = |config: MpcConfig, scale: ActionScale, spec: &EnvSpec| {
        let solver = Box::new(RecordingSolver { calls: Arc::default() });
        let made = MpcPolicy::new(solver, Box::new(RecordingModel::default()), config, scale, spec, 1);
        made.err().expect("the input is invalid").to_string()
    };
    let scale = ActionScale::identity(1);
    let far = MpcConfig { receding_horizon: 6, ..MpcConfig::default() };
    assert!(make(far, scale.clone(), &spec(1.0)).contains("6 model steps to execute, 5 planned"));
    let none = MpcConfig { horizon: 0, ..MpcConfig::default() };
    assert!(make(none, scale.clone(), &spec(1.0)).contains("MPC horizon"));
    let huge = MpcConfig { horizon: 10_000, action_block: 10_000, ..MpcConfig::default() };
    let wide = EnvSpec { action_space: Space::uniform_box([11], DType::Float32, -1.0, 1.0), ..spec(1.0) };
    assert!(
        make(huge, ActionScale::identity(11), &wide)
            .contains("1 environments x 10000 steps x 110000 values do not fit")
    );
    assert!(make(MpcConfig::default(), ActionScale::identity(2), &spec(1.0)).contains("2 means"));
    let flat = ActionScale { mean: vec![0.0], std: vec![0.0] };
    assert!(make(MpcConfig::default(), flat, &spec(1.0)).contains("above 0"));
    let discrete = EnvSpec { action_space: Space::Discrete { n: 3, start: 0 }, ..spec(1.0) };
    assert!(make(MpcConfig::default(), scale.clone(), &discrete).contains("expected 0 of each"));
    for seconds in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        let config = MpcConfig { latency_budget: Some(seconds), ..MpcConfig::default() };
        assert!(make(config, scale.clone(), &spec(1.0)).contains("latency budget"));
    }
}

#[test]
fn integers_are_planned_as_one_hot_vectors() {
    /// A solver that plans these options, one for each choice.
    struct Options(Vec<usize>);

    impl Solver for Options {
        fn solve(&mut self, _: &mut dyn CostModel, problem: PlanProblem<'_>) -> Result<Plan> {
            let PlanSpace::Discrete { choices } = problem.space else { panic!("discrete actions") };
            assert_eq!(choices, [3, 2, 3, 2]);
            let mut options = self.0.iter();
            let mut actions = vec![];
            for &option_count in choices.iter().cycle().take(choices.len() * problem.horizon) {
                let chosen = options.next().expect("enough options");
                actions.extend((0..option_count).map(|option| f32::from(u8::from(option == *chosen))));
            }
            Ok(Plan { actions, costs: vec![0.0], ..Plan::default() })
        }
    }

    let space = Space::MultiDiscrete { nvec: vec![3, 2], start: vec![0, 5] };
    let spec = EnvSpec { action_space: space, ..spec(1.0) };
    let config = MpcConfig { horizon: 2, receding_horizon: 1, action_block: 2, history: 2, ..MpcConfig::default() };
    let (model, scale) = (RecordingModel::default(), ActionScale::unscaled(&spec));
    let (past, solver) = (Arc::clone(&model.past), Options(vec![2, 0, 1, 1, 0, 0, 0, 0]));
    let mut policy =
        MpcPolicy::new(Box::new(solver), Box::new(model), config, scale, &spec, 1).expect("creating the policy");
    let infos = Batch::zeros(&Schema::new([ColumnSpec::image("pixels", 1, 1)]).expect("creating the schema"), 1);
    let mut actions = Batch::zeros(&Schema::new([spec.action_column()]).expect("creating the schema"), 1);
    for expected in [[2, 5], [1, 6], [2, 5]] {
        policy.act(&infos, &[true], &mut actions).expect("the policy acts");
        assert_eq!(actions.get::<i64>("action").expect("the column holds integers"), expected);
    }
    let past = past.lock().expect("no thread has panicked");
    assert_eq!(past[1].actions, [0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0]);

    // An action column of another type is an error.
    let mut floats =
        Batch::zeros(&Schema::new([ColumnSpec::new("action", DType::Float32, [2])]).expect("creating the schema"), 1);
    let error = policy.act(&infos, &[true], &mut floats).expect_err("an action column of floats");
    assert!(error.to_string().contains("Int64"), "{error}");
}

#[test]
fn latency_budget_sets_the_deadline() {
    /// A solver that records its deadline.
    struct DeadlineSolver(Arc<Mutex<Option<Instant>>>);

    impl Solver for DeadlineSolver {
        fn solve(&mut self, _: &mut dyn CostModel, problem: PlanProblem<'_>) -> Result<Plan> {
            *self.0.lock().expect("no thread has panicked") = problem.deadline;
            Ok(Plan { actions: vec![0.0; 25], costs: vec![0.0], ..Plan::default() })
        }
    }

    let deadline = |latency_budget| {
        let deadline = Arc::default();
        let (solver, model) = (DeadlineSolver(Arc::clone(&deadline)), RecordingModel::default());
        let config = MpcConfig { latency_budget, ..MpcConfig::default() };
        let policy = MpcPolicy::new(Box::new(solver), Box::new(model), config, ActionScale::identity(1), &spec(1.0), 1);
        let infos = Batch::zeros(&Schema::new([ColumnSpec::image("pixels", 1, 1)]).expect("creating the schema"), 1);
        let mut actions = Batch::zeros(&Schema::new([spec(1.0).action_column()]).expect("creating the schema"), 1);
        policy.expect("creating the policy").act(&infos, &[true], &mut actions).expect("the policy acts");
        *deadline.lock().expect("no thread has panicked")
    };
    let (before, budget) = (Instant::now(), Duration::from_secs(5));
    let end = deadline(Some(5.0)).expect("a deadline");
    assert!(end >= before + budget && end <= Instant::now() + budget);
    assert_eq!(deadline(Some(1e30)), None, "beyond the range of the clock");
    assert_eq!(deadline(None), None);
}

#[test]
fn settings_that_do_not_fit_the_actions_are_refused_before_the_first_plan() {
    let make = |block| {
        let solver = Box::new(ICem { block, ..ICem::default() });
        let config = MpcConfig { action_block: 5, ..MpcConfig::default() };
        MpcPolicy::new(solver, Box::<RecordingModel>::default(), config, ActionScale::identity(1), &spec(1.0), 1)
    };
    assert!(make(5).is_ok());
    let message = make(99).err().expect("99 does not divide 5").to_string();
    assert!(message.contains("icem block: 99 for 5 dimensions of a model step"), "{message}");
}

#[test]
fn trace_log_records_plans() {
    let config = MpcConfig { horizon: 2, receding_horizon: 1, action_block: 1, ..MpcConfig::default() };
    let mut fixture = Fixture::new(config, 1e6, 2);
    let log = TraceLog::default();
    fixture.policy = fixture.policy.traced(log.clone());
    let keys = [Key::new(4), Key::new(5)];
    (0..2).for_each(|slot| fixture.policy.begin(slot, keys[slot]));
    fixture.act(&[true, false]);
    fixture.act(&[true, true]);
    let plans = log.take();
    let recorded: Vec<_> =
        plans.iter().map(|p| (p.episode, p.slot, p.replan, p.together, p.cost, p.search.best.clone())).collect();
    let [first, second] = keys.map(|key| key.seed() >> 1);
    let (one, two) = (vec![100.0], vec![200.0]);
    assert_eq!(recorded[0], (first, 0, 0, 1, 100.0, one));
    assert_eq!(recorded[1..], [(first, 0, 1, 2, 200.0, two.clone()), (second, 1, 0, 2, 200.0, two)]);
    assert!(plans.iter().all(|plan| plan.seconds >= plan.model_seconds && plan.model_seconds >= 0.0));
    assert!(log.take().is_empty(), "each plan is returned once");
    let json = serde_json::to_value(&plans[0]).expect("serialising to JSON");
    assert_eq!((&json["episode"], &json["best"]), (&first.into(), &serde_json::json!([100.0])));
}

#[test]
fn errors_name_the_source_of_invalid_plans() {
    /// A solver that returns an invalid plan, or panics.
    struct Wrong(fn(&mut dyn CostModel, usize) -> Plan);

    impl Solver for Wrong {
        fn solve(&mut self, model: &mut dyn CostModel, problem: PlanProblem<'_>) -> Result<Plan> {
            Ok((self.0)(model, problem.horizon * problem.space.dim()))
        }
    }

    /// A model whose cost panics.
    struct Panicking;

    impl CostModel for Panicking {
        fn observe(&mut self, _: &Batch, _: &[usize]) -> Result<()> {
            Ok(())
        }

        fn cost(&mut self, _: Candidates<'_>, _: &mut [f32]) -> Result<()> {
            panic!("broken weights")
        }
    }

    let message = |solver: Box<dyn Solver>| {
        let scale = ActionScale::identity(1);
        let policy = MpcPolicy::new(solver, Box::new(Panicking), MpcConfig::default(), scale, &spec(1.0), 1);
        let infos = Batch::zeros(&Schema::new([ColumnSpec::image("pixels", 1, 1)]).expect("creating the schema"), 1);
        let mut actions = Batch::zeros(&Schema::new([spec(1.0).action_column()]).expect("creating the schema"), 1);
        policy
            .expect("creating the policy")
            .act(&infos, &[true], &mut actions)
            .expect_err("the input is invalid")
            .to_string()
    };
    let wrong = |plan| message(Box::new(Wrong(plan)));
    assert!(wrong(|_, len| Plan { actions: vec![0.0; len - 1], ..Plan::default() }).contains("24 values"));
    assert!(wrong(|_, len| Plan { actions: vec![0.0; len], ..Plan::default() }).contains("0 costs"));
    let nan = wrong(|_, len| Plan {
        actions: (0..len).map(|i| if i == 7 { f32::NAN } else { 0.0 }).collect(),
        costs: vec![0.0],
        trace: vec![],
    });
    assert!(nan.contains("planned environment 0") && nan.contains("NaN at step 1"), "{nan}");
    let infinite = wrong(|_, len| Plan { actions: vec![0.0; len], costs: vec![f32::INFINITY], trace: vec![] });
    assert!(infinite.contains("a cost of inf"), "{infinite}");
    let solver = wrong(|_, len| panic!("{len} is too much"));
    assert!(solver.contains("the solver panicked while planning: 25 is too much"), "{solver}");
    let model = message(Box::<Cem>::default());
    assert!(model.contains("the model panicked while scoring candidates: broken weights"), "{model}");
}
