//! [`Home`]: what the names in an evaluation's request stand for: environments, wrappers and solvers of this build,
//! datasets and checkpoints at home.

use crate::home;
use std::cell::RefCell;
use std::sync::{Arc, Mutex, PoisonError};
use swm_core::policy::ExpertPolicy;
use swm_core::{Env, EnvEntry, EnvSpec, Error, Named as _, Policy, RandomPolicy, Result};
use swm_data::Reader;
use swm_envs::wrappers::{GoalFrame, Stack, WRAPPERS};
use swm_eval::{Choice, EvalRequest, Model, PolicyKind, PolicyRequest, Predictor, ResolvedPolicy, Resolver, World};
use swm_models::{CheckpointInfo, Device, load};
use swm_plan::ActionKind;
use swm_plan::objective::ObjectiveConfig;
use swm_plan::pairing;
use swm_plan::{ActionScale, MpcConfig, MpcPolicy, PlanRecord, SOLVERS, Score, SimulatorCost, TraceLog};

/// Knows what is built in and what is at home.
#[derive(Default)]
pub struct Home {
    /// The wrappers last asked for, made once: what they read from files is shared by all environments, a simulator's
    /// included.
    stack: RefCell<Option<Wrapping>>,
    /// Every plan, with the name of the policy that made it; none where nobody asked for traces.
    traces: Option<Traces>,
}

/// Wrappers, and what they do to the picture of the goal.
#[derive(Clone)]
struct Wrapping {
    choices: Vec<Choice>,
    stack: Arc<Stack>,
    goal: GoalFrame,
}

/// Plans and who made them.
type Traces = Arc<Mutex<Vec<(String, PlanRecord)>>>;

impl Home {
    /// One that keeps every plan of the policies it makes.
    pub fn tracing() -> Self {
        Self { traces: Some(Traces::default()), ..Self::default() }
    }

    /// The plans made since the last call, in the order they were made, each with the name of its policy.
    pub fn take_traces(&self) -> Vec<(String, PlanRecord)> {
        let Some(traces) = &self.traces else { return vec![] };
        std::mem::take(&mut *traces.lock().unwrap_or_else(PoisonError::into_inner))
    }

    fn wrapping(&self, request: &EvalRequest) -> Result<Wrapping> {
        let goal = if request.wrap_goal { GoalFrame::Wrapped } else { GoalFrame::Clean };
        if let Some(known) = &*self.stack.borrow()
            && known.choices == request.wrappers
            && known.goal == goal
        {
            return Ok(known.clone());
        }
        let made = request.wrappers.iter().map(|choice| {
            let settings = choice.settings.as_object().cloned().unwrap_or_default();
            WRAPPERS.get(&choice.id)?.make(&settings.into_iter().collect())
        });
        let stack = Arc::new(Stack::new(made.collect::<Result<_>>()?));
        let wrapping = Wrapping { choices: request.wrappers.clone(), stack, goal };
        *self.stack.borrow_mut() = Some(wrapping.clone());
        Ok(wrapping)
    }

    /// A policy that plans; its plans are traced where that was asked for.
    fn planning(&self, name: &str, policy: MpcPolicy) -> ResolvedPolicy {
        let Some(traces) = &self.traces else { return ResolvedPolicy::from(Box::new(policy) as Box<dyn Policy>) };
        let (log, traces, name) = (TraceLog::default(), Arc::clone(traces), name.to_owned());
        let policy: Box<dyn Policy> = Box::new(policy.traced(log.clone()));
        let searches = move || {
            let records = log.take();
            let searches = records.iter().map(|record| record.search.clone()).collect();
            let named = records.into_iter().map(|record| (name.clone(), record));
            traces.lock().unwrap_or_else(PoisonError::into_inner).extend(named);
            searches
        };
        ResolvedPolicy { searches: Some(Box::new(searches)), ..ResolvedPolicy::from(policy) }
    }
}

impl Resolver for Home {
    fn env(&self, request: &EvalRequest) -> Result<Box<dyn Env>> {
        let (env, wrapping) = (crate::env(&request.env)?.env()?, self.wrapping(request)?);
        Ok(wrapping.stack.wrap(env, wrapping.goal))
    }

    fn dataset(&self, name: &str) -> Result<Arc<dyn Reader>> {
        home::open_dataset(name)
    }

    fn policy(&self, request: &PolicyRequest, world: &World) -> Result<ResolvedPolicy> {
        let (spec, slots) = (world.spec(), world.pool().len());
        let env = crate::env(&spec.id)?;
        match &request.kind {
            PolicyKind::Random => Ok(ResolvedPolicy::from(Box::new(RandomPolicy::new(spec, slots)) as Box<dyn Policy>)),
            PolicyKind::Expert { id } => scripted(&env.entry, id, world).map(ResolvedPolicy::from),
            PolicyKind::Direct { checkpoint: given, .. } => {
                let (policy, info) = direct(given, spec, slots)?;
                Ok(ResolvedPolicy {
                    weights: Some(info.weights),
                    libraries: info.manifest.libraries,
                    device: Some(info.manifest.device),
                    ..ResolvedPolicy::from(policy)
                })
            }
            PolicyKind::Plan { model, solver, mpc, objective } => {
                let (id, solver) = (&solver.id, (SOLVERS.get(&solver.id)?.make)(&solver.settings)?);
                let actions = ActionKind::of(&spec.action_space);
                let wrong = |what: &str, error: serde_json::Error| {
                    Error::config(what, error.to_string(), "`swm eval --help` lists what there is")
                };
                let mpc: MpcConfig = serde_json::from_value(mpc.clone()).map_err(|e| wrong("MPC settings", e))?;
                let objective = match objective {
                    serde_json::Value::Null => ObjectiveConfig::default(),
                    given => serde_json::from_value(given.clone()).map_err(|e| wrong("objective", e))?,
                };
                match model {
                    Model::Simulator { score } => {
                        let score = parse_score(score)?;
                        let scale = ActionScale::unscaled(spec);
                        let wrapping = self.stack.borrow().clone();
                        let make = move || match &wrapping {
                            Some(Wrapping { stack, goal, .. }) => Ok(stack.wrap(env.env()?, *goal)),
                            None => env.env(),
                        };
                        let cost = SimulatorCost::new(make, scale.clone(), mpc.action_block, score)?;
                        let mut cost = objective.apply(Box::new(cost))?;
                        pairing(id, &mut *cost, actions)?;
                        let policy = MpcPolicy::new(solver, cost, mpc, scale, spec, slots)?;
                        Ok(self.planning(&request.name, policy))
                    }
                    Model::Checkpoint(given) => {
                        let loaded = load(&home::find_checkpoint(given)?, &Device::flex())?;
                        let info = loaded.info()?;
                        fits(info.dataset_info.env.as_deref(), given, spec)?;
                        let cost = loaded.cost().ok_or_else(|| {
                            let problem = format!("a {} acts and does not predict", info.family);
                            Error::config(format!("checkpoint {given}"), problem, "let it act (`swm eval` does)")
                        })?;
                        let (mut cost, scale) = (objective.apply(cost)?, info.dataset_info.action);
                        pairing(id, &mut *cost, actions)?;
                        let policy = MpcPolicy::new(solver, cost, mpc, scale, spec, slots)?;
                        Ok(ResolvedPolicy {
                            weights: Some(info.weights),
                            libraries: info.manifest.libraries,
                            device: Some(info.manifest.device),
                            ..self.planning(&request.name, policy)
                        })
                    }
                }
            }
        }
    }

    fn predictor(&self, request: &PolicyRequest) -> Result<Option<Box<dyn Predictor>>> {
        let PolicyKind::Plan { model: Model::Checkpoint(given), .. } = &request.kind else { return Ok(None) };
        Ok(load(&home::find_checkpoint(given)?, &Device::flex())?.predictor())
    }
}

/// Who acts in a world, and the hash of the weights if a checkpoint does: as [`scripted`], or by the name or path of a
/// checkpoint that acts by itself.
///
/// # Errors
/// When there is neither such an expert nor such a checkpoint, or the checkpoint is of another world or only predicts.
pub fn acting(entry: &EnvEntry, name: &str, world: &World) -> Result<(Box<dyn Policy>, Option<String>)> {
    let known = ["random", "expert"].contains(&name) || entry.experts.iter().any(|expert| expert.id == name);
    if known || !home::checkpoint(name).exists() {
        return Ok((scripted(entry, name, world)?, None));
    }
    let (policy, info) = direct(name, world.spec(), world.pool().len())?;
    Ok((policy, Some(info.weights)))
}

/// The policy of a checkpoint that acts by itself, and what the checkpoint holds.
///
/// # Errors
/// When there is no such checkpoint, it is of another world, or it only predicts.
pub fn direct(given: &str, spec: &EnvSpec, slots: usize) -> Result<(Box<dyn Policy>, CheckpointInfo)> {
    let loaded = load(&home::find_checkpoint(given)?, &Device::flex())?;
    let info = loaded.info()?;
    fits(info.dataset_info.env.as_deref(), given, spec)?;
    let policy = loaded.policy(spec, slots).ok_or_else(|| {
        let problem = format!("a {} predicts and does not act", info.family);
        Error::config(format!("checkpoint {given}"), problem, "plan in it (`swm eval` does)")
    })??;
    Ok((policy, info))
}

/// Who acts in a world without having been trained: `random`, `expert` (the environment's first), or an expert by name.
///
/// # Errors
/// When the environment has no such expert.
pub fn scripted(entry: &EnvEntry, name: &str, world: &World) -> Result<Box<dyn Policy>> {
    let slots = world.pool().len();
    if name == "random" {
        return Ok(Box::new(RandomPolicy::new(world.spec(), slots)));
    }
    let expert = match entry.experts {
        [first, ..] if name == "expert" => first,
        [] => {
            let hint = format!("{} has no experts: choose random or a checkpoint", entry.id);
            return Err(Error::unknown("policy", name, ["random"], hint));
        }
        experts => experts.iter().find(|expert| expert.id == name).ok_or_else(|| {
            let known = ["random", "expert"].into_iter().chain(experts.iter().map(|expert| expert.id()));
            Error::unknown("policy", name, known, format!("`swm envs` lists the experts of {}", entry.id))
        })?,
    };
    Ok(Box::new(ExpertPolicy::new(world.spec(), (0..slots).map(|_| (expert.make)()).collect())))
}

/// What a simulator judges a plan by, by name.
///
/// # Errors
/// When there is no such score.
pub fn parse_score(name: &str) -> Result<Score> {
    serde_json::from_value(name.into())
        .map_err(|_| Error::config("the simulator's score", format!("'{name}'"), "choose terminal, running or reach"))
}

/// Refuses a checkpoint trained on another environment.
fn fits(trained_on: Option<&str>, name: &str, spec: &EnvSpec) -> Result<()> {
    match trained_on {
        Some(env) if env != spec.id => Err(Error::config(
            format!("checkpoint {name}"),
            format!("it was trained on {env}, not on {}", spec.id),
            format!("evaluate it with --env {env}, or train one on {}", spec.id),
        )),
        _ => Ok(()),
    }
}
