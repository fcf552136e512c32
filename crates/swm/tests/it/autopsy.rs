//! `swm autopsy`, and faults planted in a world model of Two-Room.

use crate::{Swm, text};
use rand::Rng as _;
use std::collections::BTreeMap;
use std::process::Stdio;
use std::rc::Rc;
use std::sync::Arc;
use std::time::Duration;
use swm::autopsy::with;
use swm::core::results::{ArmRuns, Autopsy, Counting, Finding, Ingredient, Run, game, letters, members};
use swm::core::run::Control;
use swm::core::{
    Batch, Candidates, CostModel, Env, EnvPool, Key, Manifest, Origin, Policy, Predictor, Result as SwmResult,
    VariationRequest,
};
use swm::data::Reader;
use swm::eval::{
    Choice, Condition, EvalRequest, Model, PolicyKind, PolicyRequest, ResolvedPolicy, Resolver, RunOptions,
    StartsRequest, World,
};
use swm::models::train::DatasetInfo;
use swm::models::{CheckpointInfo, LoadedModel};
use swm::plan::ActionScale;
use swm::resolver::HomeResolver;

/// The ingredients without a probe.
const FOUR: [Ingredient; 4] = [Ingredient::Search, Ingredient::Replanning, Ingredient::Dynamics, Ingredient::Distance];

/// Options that make an autopsy take seconds.
const FAST: [&str; 7] = [
    "--episodes=4",
    "--ingredients=SDE",
    "solver=cem,samples=6,iterations=2,elites=2",
    "budget=20",
    "horizon=2",
    "receding-horizon=1",
    "seed=3",
];

#[test]
fn autopsy_runs_its_arms_and_continues_after_a_kill() {
    let swm = Swm::new();
    let args = |folder: &'static str| {
        [&["autopsy", "zoo:two-room/lewm", "--env", "swm/TwoRoom-v1", "--output", folder][..], &FAST].concat()
    };
    let whole = swm.json(&args("whole"));
    let arms = whole["autopsy"]["arms"].as_array().expect("arms");
    let names: Vec<String> = arms.iter().map(|arm| arm["ingredients"].to_string()).collect();
    // E comes after D: S, D, SD, DE and SDE, beside the unchanged policy.
    assert_eq!(names.len(), 6, "{names:?}");
    assert_eq!((&names[0][..], &names[3][..]), ("[]", "[\"search\",\"dynamics\"]"));
    let contributions = whole["autopsy"]["contributions"].as_array().expect("contributions");
    let sum: f64 = contributions.iter().filter_map(|found| found["recovered"]["value"].as_f64()).sum();
    let full = arms[5]["recovered"]["value"].as_f64().expect("the arm with all ingredients");
    assert!((sum - full).abs() < 1e-9, "contributions sum to {sum}, not {full}");
    // The page has the verdict, and a strip for each failure that an ingredient repairs.
    let page = std::fs::read_to_string(swm.path("whole/index.html")).expect("the page");
    let repairs = whole["autopsy"]["repairs"].as_array().expect("repairs");
    let is_repaired = |repair: &&serde_json::Value| repair["sets"][0].as_array().is_some_and(|set| !set.is_empty());
    assert!(page.contains("Smallest repairs") || repairs.is_empty());
    assert_eq!(page.matches("data:image/png").count(), repairs.iter().filter(is_repaired).count());
    // A kill loses only the arm that is played.
    let mut child =
        swm.command(&args("killed")).stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("swm starts");
    std::thread::sleep(Duration::from_millis(700));
    let _ = child.kill();
    child.wait().expect("the process ends");
    assert_eq!(swm.json(&[&args("killed")[..], &["--envs=3", "--threads=1"]].concat()), whole);
    let shown = swm.run(&args("whole"));
    let (out, err) = (text(&shown.stdout), text(&shown.stderr));
    assert!(out.contains("search x 10") && out.contains("smallest repair"), "{out}");
    assert!(err.contains("6 arms x 3 planning seeds x 4 starts: at most 0 s"), "all arms are known: {err}");
    assert!(out.lines().all(|line| line.chars().count() <= 80), "a line is wider than 80 columns: {out}");
    // Another file of that name is the user's.
    std::fs::write(swm.path("whole/autopsy.json"), r#"{"mine": "notes"}"#).expect("writing a file");
    swm.fails(&args("whole"), 2, &["autopsy.json", "was not written by this program"]);
    let status = swm.run(&["study", "status", "whole"]);
    assert!(text(&status.stdout).contains("19 of 19 cells"), "{}", text(&status.stdout));
}

#[test]
fn autopsies_that_explain_nothing_are_refused() {
    let swm = Swm::new();
    let env = ["--env", "swm/TwoRoom-v1"];
    let fails = |args: &[&str], parts: &[&str]| swm.fails(&[&["autopsy"], args, &env[..]].concat(), 2, parts);
    let unknown = swm.run(&["autopsy", "nowhere"]);
    let error = text(&unknown.stderr);
    assert!(!unknown.status.success() && error.contains("nowhere") && !error.contains("file of the study"), "{error}");
    fails(&["expert"], &["does not plan in a trained world model"]);
    fails(&["zoo:two-room/pldm", "--ingredients", "SX"], &["'X'", "S, R, D, C and E"]);
    fails(&["zoo:two-room/pldm", "--ingredients", "SE"], &["add D"]);
    // The capsule already plans after every model step.
    fails(&["zoo:two-room/pldm", "--ingredients", "R"], &["none changes the policy"]);
    fails(&["zoo:two-room/pldm", "--planning-seeds", "2"], &["give 3 to"]);
    fails(&["zoo:two-room/pldm", "solver=cem", "solver=icem"], &["solver"]);
    fails(&["zoo:two-room/pldm", "protocol=compat"], &["use protocol=strict"]);
    fails(&["zoo:two-room/pldm", "policy=random"], &["policy=random", "'zoo:two-room/pldm'"]);
    fails(&["zoo:two-room/pldm", "episodes=3"], &["episodes=3: the number of starts is an option", "--episodes 3"]);
    fails(&["zoo:two-room/pldm", "--ingredients", "SDs"], &["'s' is given twice"]);
    let estimate = swm.json(&["autopsy", "zoo:two-room/pldm", "--estimate", "--ingredients=SD", "--episodes=2"]);
    assert!(estimate["seconds"].as_f64().is_some_and(|seconds| seconds > 0.0), "{estimate}");
    assert!(estimate["arms"] == 4 && !swm.path("autopsy").exists());
}

/// A world model of Two-Room whose latent is the position of the agent. It does not know the wall.
#[derive(Clone, Copy)]
struct Positions {
    /// The angle by which its dynamics turn actions, in degrees.
    turned: f32,
    /// The side of the cells within which its encoder does not tell positions apart, in pixels; 0 for none.
    cell: f32,
}

/// The pixels that the agent of Two-Room walks with an action of length 1.
const SPEED: f32 = 5.0;
/// Environment steps in a model step.
const BLOCK: usize = 5;
const ENV: &str = "swm/TwoRoom-v1";

impl Positions {
    fn latent(self, position: [f32; 2]) -> [f32; 2] {
        position.map(|x| if self.cell > 0.0 { (x / self.cell).round() * self.cell } else { x })
    }

    /// The position after an action.
    fn next(self, at: [f32; 2], action: &[f32]) -> [f32; 2] {
        let (sin, cos) = self.turned.to_radians().sin_cos();
        let [x, y] = [action[0].clamp(-1.0, 1.0), action[1].clamp(-1.0, 1.0)];
        [at[0] + SPEED * (cos * x - sin * y), at[1] + SPEED * (sin * x + cos * y)]
    }
}

/// The cost of [`Positions`], with the present and the goal of the observed environments.
struct PositionCost(Positions, Vec<[[f32; 2]; 2]>);

impl CostModel for PositionCost {
    fn observe(&mut self, infos: &Batch, envs: &[usize]) -> SwmResult<()> {
        let position = |env: usize, column: &str| -> SwmResult<[f32; 2]> {
            let values = infos.row(env).get::<f32>(column)?;
            Ok([values[0], values[1]])
        };
        let observed = envs.iter().map(|&env| Ok([position(env, "state")?, position(env, "goal_state")?]));
        self.1 = observed.collect::<SwmResult<_>>()?;
        Ok(())
    }

    fn cost(&mut self, candidates: Candidates<'_>, costs: &mut [f32]) -> SwmResult<()> {
        let len = candidates.horizon * candidates.dim;
        for (i, (actions, cost)) in candidates.actions.chunks_exact(len).zip(costs).enumerate() {
            let [start, goal] = self.1[i / candidates.samples];
            let end = actions.chunks_exact(2).fold(start, |at, action| self.0.next(at, action));
            let [end, goal] = [end, goal].map(|position| self.0.latent(position));
            *cost = end.iter().zip(goal).map(|(a, b)| (a - b).powi(2)).sum();
        }
        Ok(())
    }
}

impl Predictor for Positions {
    fn frameskip(&self) -> usize {
        BLOCK
    }

    fn columns(&self) -> Vec<String> {
        vec!["state".to_owned()]
    }

    fn latent_dim(&self) -> usize {
        2
    }

    fn encode(&mut self, rows: &Batch, latents: &mut [f32]) -> SwmResult<()> {
        for (position, latent) in rows.get::<f32>("state")?.chunks_exact(2).zip(latents.chunks_exact_mut(2)) {
            latent.copy_from_slice(&self.latent([position[0], position[1]]));
        }
        Ok(())
    }

    fn rollout(&mut self, _: &[f32], _: &[f32], _: usize, _: &mut [f32]) -> SwmResult<()> {
        unreachable!("an autopsy does not measure prediction errors")
    }
}

impl LoadedModel for Positions {
    fn info(&self) -> SwmResult<CheckpointInfo> {
        Ok(CheckpointInfo {
            family: "positions",
            weights: format!("{}-{}", self.turned, self.cell),
            config: serde_json::Value::Null,
            toml: String::new(),
            dataset_info: DatasetInfo {
                action: ActionScale::identity(2),
                columns: BTreeMap::new(),
                env: Some(ENV.to_owned()),
            },
            image_size: None,
            action_block: BLOCK,
            history: 1,
            manifest: Manifest::new("train", 0, serde_json::Value::Null),
        })
    }

    fn cost(&self) -> Option<Box<dyn CostModel>> {
        Some(Box::new(PositionCost(*self, vec![])))
    }

    fn predictor(&self) -> Option<Box<dyn Predictor>> {
        Some(Box::new(*self))
    }
}

/// A policy with a planted fault.
#[derive(Clone, Copy)]
struct Planted {
    model: Positions,
    /// Candidates of an iteration.
    samples: usize,
    /// Model steps of a plan, and how many of them are executed.
    horizon: usize,
    executed: usize,
    /// The largest error of executed actions along each axis, which stays the same for ten steps.
    noise: f32,
}

/// No fault.
const HEALTHY: Planted =
    Planted { model: Positions { turned: 0.0, cell: 0.0 }, samples: 24, horizon: 4, executed: 2, noise: 0.0 };

/// A policy whose actions are executed with errors that no model predicts.
struct Noisy {
    policy: Box<dyn Policy>,
    noise: f32,
    /// The key of the episode and the number of its steps, by slot.
    slots: Vec<(Key, u64)>,
}

impl Policy for Noisy {
    fn begin(&mut self, slot: usize, key: Key) {
        self.slots[slot] = (key.with("noise"), 0);
        self.policy.begin(slot, key);
    }

    fn act(&mut self, infos: &Batch, active: &[bool], actions: &mut Batch) -> SwmResult<()> {
        self.policy.act(infos, active, actions)?;
        for slot in (0..active.len()).filter(|&slot| active[slot]) {
            let (key, steps) = &mut self.slots[slot];
            let mut rng = key.at(*steps / 10).rng();
            *steps += 1;
            for value in actions.row_mut(slot).at::<f32>(0) {
                *value = (*value + self.noise * rng.random_range(-1.0..1.0)).clamp(-1.0, 1.0);
            }
        }
        Ok(())
    }

    fn observe_envs(&mut self, envs: &EnvPool, active: &[bool]) -> SwmResult<()> {
        self.policy.observe_envs(envs, active)
    }
}

/// A resolver of policies whose actions are executed with errors.
struct NoisyResolver(HomeResolver, f32);

impl Resolver for NoisyResolver {
    fn env(&self, request: &EvalRequest) -> SwmResult<Box<dyn Env>> {
        self.0.env(request)
    }

    fn dataset(&self, name: &str) -> SwmResult<Arc<dyn Reader>> {
        self.0.dataset(name)
    }

    fn policy(&self, request: &PolicyRequest, world: &World) -> SwmResult<ResolvedPolicy> {
        let found = self.0.policy(request, world)?;
        let slots = vec![(Key::new(0), 0); world.pool().len()];
        Ok(ResolvedPolicy { policy: Box::new(Noisy { policy: found.policy, noise: self.1, slots }), ..found })
    }
}

impl Planted {
    /// The policy with some ingredients, from `episodes` starts.
    fn run(self, set: &[Ingredient], planning_seed: Option<u64>, episodes: usize, seed: u64) -> Run {
        const NAME: &str = "positions";
        let home = HomeResolver::new(Origin::User).with_checkpoint(NAME, Rc::new(self.model));
        let resolver = NoisyResolver(home, self.noise);
        let elites = (self.samples / 4).max(2);
        let settings = serde_json::json!({"samples": self.samples, "iterations": 3, "elites": elites, "sigma": 1.0});
        let kind = PolicyKind::Plan {
            model: Model::Checkpoint(NAME.to_owned()),
            solver: Choice { id: "cem".to_owned(), settings },
            mpc: serde_json::json!({
                "horizon": self.horizon, "receding_horizon": self.executed, "action_block": BLOCK,
            }),
            objective: serde_json::Value::Null,
        };
        // The goal is behind a door, so that agents that walk straight towards it find the way.
        let pins =
            [("target.position", vec![164.0, 112.0]), ("door.position", vec![112.0; 3]), ("door.size", vec![21.0; 3])];
        let variation = VariationRequest {
            variation: Some(vec!["agent.position".to_owned()]),
            variation_values: pins.map(|(key, values)| (key.to_owned(), values)).into(),
        };
        let request = EvalRequest {
            version: EvalRequest::VERSION,
            env: ENV.to_owned(),
            wrappers: vec![],
            wrap_goal: false,
            image: None,
            policies: vec![PolicyRequest { name: NAME.to_owned(), kind: with(&kind, set, None).expect("an arm") }],
            starts: StartsRequest::Episodic,
            episodes,
            seed,
            budget: Some(60),
            counting: Counting::default(),
            conditions: vec![Condition { name: "in distribution".to_owned(), variation }],
            prediction: None,
            planning_seed,
        };
        let options = RunOptions { envs: 32, threads: 2, ..RunOptions::default() };
        let results = request.run(&resolver, &options, &mut Control::new()).expect("the evaluation succeeds");
        results.runs.into_iter().find(|run| run.policy == NAME).expect("the run of the policy")
    }

    /// The run that selects the failures, and the runs of all arms.
    fn play(self, episodes: usize, seed: u64) -> (Run, Vec<ArmRuns>) {
        let arms = game(&FOUR).coalitions().into_iter().map(|coalition| {
            let ingredients = members(&FOUR, coalition);
            let runs =
                (1..=3).map(|planning_seed| self.run(&ingredients, Some(planning_seed), episodes, seed)).collect();
            ArmRuns { ingredients, runs }
        });
        (self.run(&[], None, episodes, seed), arms.collect())
    }
}

/// The run of some of its starts.
fn only(run: &Run, starts: &[usize]) -> Run {
    let episodes = starts.iter().map(|&start| run.episodes[start].clone()).collect();
    Run::new(&run.condition, &run.policy, Counting::default(), episodes, run.timing.clone())
}

/// The findings of `trials` autopsies, each of `size` of the starts, drawn without replacement.
fn findings((selection, arms): &(Run, Vec<ArmRuns>), size: usize, trials: u64) -> Vec<Finding> {
    use rand::seq::index::sample;
    let finding = |trial: u64| {
        let key = Key::new(trial).with("trial");
        let starts = sample(&mut key.rng(), selection.episodes.len(), size).into_vec();
        let arm = |arm: &ArmRuns| ArmRuns {
            ingredients: arm.ingredients.clone(),
            runs: arm.runs.iter().map(|run| only(run, &starts)).collect(),
        };
        let arms: Vec<ArmRuns> = arms.iter().map(arm).collect();
        Autopsy::of(&only(selection, &starts), &arms, Counting::default(), key).expect("an autopsy").finding
    };
    (0..trials).map(finding).collect()
}

#[test]
fn wrong_dynamics_are_found() {
    let planted = Planted { model: Positions { turned: 60.0, ..HEALTHY.model }, ..HEALTHY };
    let (selection, arms) = planted.play(30, 5);
    let found = Autopsy::of(&selection, &arms, Counting::default(), Key::new(0)).expect("an autopsy");
    assert_eq!(found.finding, Finding::Culprit(Ingredient::Dynamics), "{found:#?}");
}

/// A fault: its culprit, and policies with the fault, the weakest first.
type Fault = (&'static str, Option<Ingredient>, Vec<Planted>);

/// Three of the policies, whose faults cost about 35, 45 and 55 points of success, and at least 30 and at most 60.
fn calibrated(planted: &[Planted]) -> Vec<(f64, Planted)> {
    // Not the starts of the autopsies.
    let rate = |planted: &Planted| planted.run(&[], None, 100, 77).success.rate;
    let healthy = rate(&HEALTHY);
    let costs: Vec<(f64, Planted)> = planted.iter().map(|planted| (healthy - rate(planted), *planted)).collect();
    let mut chosen: Vec<usize> = vec![];
    for wanted in [0.35, 0.45, 0.55] {
        let fits = |i: &usize| (0.3..=0.6).contains(&costs[*i].0) && !chosen.contains(i);
        let far = |i: &usize| (costs[*i].0 - wanted).abs();
        chosen.extend((0..costs.len()).filter(fits).min_by(|a, b| far(a).total_cmp(&far(b))));
    }
    chosen.sort_unstable();
    chosen.into_iter().map(|i| costs[i]).collect()
}

/// The figures of `docs/autopsy.md`.
#[test]
#[ignore = "minutes: plays every arm for each fault and severity"]
fn planted_faults_are_found_and_healthy_policies_are_not_accused() {
    let turned = |degrees: u16| Planted { model: Positions { turned: f32::from(degrees), cell: 0.0 }, ..HEALTHY };
    let blind = |pixels: u16| Planted { model: Positions { turned: 0.0, cell: f32::from(pixels) }, ..HEALTHY };
    let open = |steps: usize| Planted { horizon: steps, executed: steps, noise: 0.6, ..HEALTHY };
    let faults: [Fault; 5] = [
        ("none", None, vec![HEALTHY, Planted { executed: 1, ..HEALTHY }, Planted { samples: 48, ..HEALTHY }]),
        ("dynamics", Some(Ingredient::Dynamics), (15..27).map(|i| turned(2 * i)).collect()),
        ("encoder", Some(Ingredient::Distance), (6..18).map(|i| blind(5 * i)).collect()),
        (
            "search",
            Some(Ingredient::Search),
            (2..14).rev().map(|samples| Planted { samples, horizon: 6, ..HEALTHY }).collect(),
        ),
        ("open loop", Some(Ingredient::Replanning), (2..12).map(open).collect()),
    ];
    let mut wrong = vec![];
    for (name, culprit, planted) in faults {
        let severities = match culprit {
            Some(_) => calibrated(&planted),
            None => planted.into_iter().map(|planted| (0.0, planted)).collect(),
        };
        for (cost, planted) in severities {
            let played = planted.play(150, 11);
            let rate = |arm: &ArmRuns| {
                let rate = arm.runs.iter().map(|run| run.success.rate).sum::<f64>() / arm.runs.len() as f64;
                format!("{} {:.0}", letters(&arm.ingredients), 100.0 * rate)
            };
            let rates: Vec<String> = played.1.iter().map(rate).collect();
            let mut counts: BTreeMap<String, usize> = BTreeMap::new();
            for finding in findings(&played, 30, 100) {
                *counts.entry(format!("{finding:?}")).or_default() += 1;
            }
            println!("{name}, cost {cost:.2}: {counts:?}; {}", rates.join(", "));
            let count = |is_counted: &dyn Fn(&str) -> bool| -> usize {
                counts.iter().filter(|(name, _)| is_counted(name)).map(|(_, count)| count).sum()
            };
            let right = culprit.map_or(String::new(), |culprit| format!("{:?}", Finding::Culprit(culprit)));
            let accused = count(&|name| name.contains('(') && name != right);
            // Other ingredients repair the faults of the encoder and of plans without replanning as well.
            let is_clear = ["none", "dynamics", "search"].contains(&name);
            if is_clear && (accused > 5 || (cost >= 0.5 && count(&|name| name == right) < 95)) {
                wrong.push((name, cost));
            }
        }
    }
    assert!(wrong.is_empty(), "too many wrong findings: {wrong:?}");
}

#[test]
fn a_probe_is_an_ingredient_with_a_dataset() {
    let swm = Swm::new();
    swm.json(&[
        "collect",
        "swm/TwoRoom-v1",
        "--output=rooms",
        "--policy=explore",
        "--episodes=30",
        "--image=64",
        "--max-steps=30",
    ]);
    let autopsy = ["autopsy", "zoo:two-room/lewm", "--ingredients=DC", "--episodes=6", "--output=out"];
    let quick = ["budget=10", "solver=cem,samples=4,iterations=1,elites=2"];
    let args = [&autopsy[..], &quick].concat();
    swm.fails(&args, 2, &["C needs a probe", "--probe-data"]);
    let found = swm.json(&[&args[..], &["--probe-data=rooms"]].concat());
    let arms = found["autopsy"]["arms"].as_array().expect("arms");
    let sets: Vec<&serde_json::Value> = arms.iter().map(|arm| &arm["ingredients"]).collect();
    assert_eq!(serde_json::json!(sets), serde_json::json!([[], ["dynamics"], ["probe"], ["dynamics", "probe"]]));
    // Both probes, and what the position of the agent alone predicts: all of it, since it is the state of Two-Room.
    assert_eq!((&found["probes"]["dataset"], &found["probes"]["trivial"]), (&"rooms".into(), &"proprio".into()));
    let elements = found["probes"]["elements"].as_array().expect("scores");
    assert!(elements.len() >= 2 && elements[0]["element"] == "state[0]", "{elements:?}");
    for score in &elements[..2] {
        let [linear, network, trivial] =
            ["linear", "network", "trivial"].map(|key| score[key].as_f64().expect("an R²"));
        assert!(trivial > 0.95 && linear.max(network) > 0.5 && linear.max(network) <= trivial + 0.05, "{score}");
    }
    let page = std::fs::read_to_string(swm.path("out/index.html")).expect("the page");
    assert!(page.contains("What the latents hold") && page.contains("R², proprio alone"));
    // Without C, the probes say what the latents hold as well, and no arm uses them. Other columns say less of the state.
    let without = ["autopsy", "zoo:two-room/lewm", "--ingredients=D", "--episodes=2", "--output=d"];
    let baseline = ["--probe-data=rooms", "--probe-baseline=reward,goal_state"];
    let without = swm.json(&[&without[..], &baseline, &quick].concat());
    let [other, same] = [&without, &found].map(|found| &found["probes"]["elements"][0]);
    assert_eq!((&other["linear"], &other["network"]), (&same["linear"], &same["network"]));
    assert_eq!(without["probes"]["trivial"], "reward,goal_state");
    assert!(other["trivial"].as_f64() < same["trivial"].as_f64(), "{other}");
    // With another dataset of this name, arms with a probe are other cells: two arms, three planning seeds.
    let cells = std::fs::read_dir(swm.path("out").join("cells")).expect("the cells of the autopsy");
    let has_probe = |path: std::path::PathBuf| {
        let text = std::fs::read_to_string(path).expect("reading a cell");
        let results: serde_json::Value = serde_json::from_str(&text).expect("parsing a cell");
        results["manifest"]["hashes"]["probe dataset"].is_string()
    };
    let probed = cells.filter(|cell| has_probe(cell.as_ref().expect("a cell").path())).count();
    assert_eq!(probed, 6);
}
