//! [`HomeResolver`] loads the environments, wrappers, solvers, datasets and checkpoints that an evaluation request names.
//! Environments, wrappers and solvers belong to this build; datasets and checkpoints are in the [home folder](crate::home).

mod probing;
mod watching;

pub use watching::WatchedPolicy;

use crate::{describe, home, zoo};
use probing::FittedProbe;
use serde::de::DeserializeOwned;
use std::cell::RefCell;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::rc::Rc;
use std::sync::{Arc, Mutex, PoisonError};
use swm_core::policy::ExpertPolicy;
use swm_core::{
    CostModel, Env, EnvChoice, EnvEntry, EnvSpec, Error, ExpertEntry, Named as _, Origin, Policy, RandomPolicy, Result,
    Solver,
};
use swm_data::Reader;
use swm_envs::wrappers::{GoalFrame, Stack, WRAPPERS, WrapperEntry};
use swm_eval::{
    Choice, EndCost, EvalRequest, MixturePolicy, Model, NoOpPolicy, PolicyChoice, PolicyKind, PolicyRequest, Predictor,
    ResolvedPolicy, Resolver, World,
};
use swm_models::{CheckpointInfo, Device, LoadedModel, device, load};
use swm_plan::objective::ObjectiveConfig;
use swm_plan::{
    ActionKind, ActionScale, MpcConfig, MpcPolicy, PlanRecord, SOLVERS, Score, SimulatedLatents, SimulatorCost,
    TraceLog, pairing,
};

/// A [`Resolver`] of names in this build and in the home folder. It loads every checkpoint once.
///
/// A request that comes from a file may name built-in and registered environments, local datasets and checkpoints, and
/// wrappers that read no files. Other names are refused.
pub struct HomeResolver {
    /// Who chose the names in the requests.
    origin: Origin,
    /// The environment that the user named, besides a request that comes from a file.
    env: Option<String>,
    /// The wrappers of the last request. All environments share the wrappers and the files that the wrappers read.
    wrapping: RefCell<Option<Wrapping>>,
    /// The loaded checkpoints, by path.
    checkpoints: RefCell<BTreeMap<PathBuf, Rc<dyn LoadedModel>>>,
    /// The fitted probes, by checkpoint, dataset and columns.
    probes: RefCell<BTreeMap<ProbeKey, FittedProbe>>,
    /// The traced plans; `None` without tracing.
    traces: Option<Traces>,
    /// The device of the models.
    device: Device,
}

/// Wrappers, and whether they apply to the frame of the goal.
#[derive(Clone)]
struct Wrapping {
    choices: Vec<Choice>,
    stack: Arc<Stack>,
    goal: GoalFrame,
}

/// The checkpoint, the dataset and the columns of a probe.
type ProbeKey = (String, String, Vec<String>);

/// The plans of each run, with the name of its policy.
type Traces = Arc<Mutex<Vec<(String, Vec<PlanRecord>)>>>;

impl HomeResolver {
    /// Creates a resolver of requests whose names `origin` chose.
    pub fn new(origin: Origin) -> Self {
        Self {
            origin,
            env: None,
            wrapping: RefCell::default(),
            checkpoints: RefCell::default(),
            probes: RefCell::default(),
            traces: None,
            device: Device::flex(),
        }
    }

    /// Traces the plans of policies.
    pub fn tracing(self) -> Self {
        Self { traces: Some(Traces::default()), ..self }
    }

    /// Loads checkpoints on a device.
    pub fn on(self, device: Device) -> Self {
        Self { device, ..self }
    }

    /// Accepts requests for the environment with this id, because the user named it.
    pub fn with_env(self, id: &str) -> Self {
        Self { env: Some(id.to_owned()), ..self }
    }

    /// Uses a loaded checkpoint wherever a request names `name`.
    pub fn with_checkpoint(self, name: &str, loaded: Rc<dyn LoadedModel>) -> Self {
        self.checkpoints.borrow_mut().insert(PathBuf::from(name), loaded);
        self
    }

    /// Who chose the names in the requests.
    pub fn origin(&self) -> &Origin {
        &self.origin
    }

    /// Returns the environment with an id that a request, or the file that it comes from, names.
    ///
    /// # Errors
    /// As [`crate::env`].
    pub fn choose_env(&self, id: &str) -> Result<EnvChoice> {
        let origin = if self.env.as_deref() == Some(id) { &Origin::User } else { &self.origin };
        crate::env(id, origin)
    }

    /// Returns the plans of every run since the last call, in order, with the names of their policies.
    pub fn take_traces(&self) -> Vec<(String, Vec<PlanRecord>)> {
        let Some(traces) = &self.traces else { return vec![] };
        std::mem::take(&mut *traces.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// Returns the checkpoint with this path or name; it is loaded at the first call.
    ///
    /// # Errors
    /// When the checkpoint does not exist or is damaged.
    pub fn checkpoint(&self, given: &str) -> Result<Rc<dyn LoadedModel>> {
        if let Some(loaded) = self.checkpoints.borrow().get(Path::new(given)) {
            return Ok(Rc::clone(loaded));
        }
        self.check_local("checkpoint", given)?;
        let path = home::find_checkpoint(given)?;
        if let Some(loaded) = self.checkpoints.borrow().get(&path) {
            return Ok(Rc::clone(loaded));
        }
        let loaded: Rc<dyn LoadedModel> = Rc::from(load(&path, &self.device)?);
        self.checkpoints.borrow_mut().insert(path, Rc::clone(&loaded));
        Ok(loaded)
    }

    /// Refuses a URI that a file chose.
    fn check_local(&self, kind: &str, name: &str) -> Result<()> {
        if name.contains("://") {
            self.origin.check_user(&format!("the {kind} '{name}'"), "which opens a network connection", None)?;
        }
        Ok(())
    }

    /// Returns the name of a dataset; a URI of the hub gets its commit.
    ///
    /// # Errors
    /// When a file chose a URI, or the hub does not have it.
    pub fn pinned_dataset(&self, given: &str) -> Result<String> {
        self.check_local("dataset", given)?;
        home::pinned_dataset(given)
    }

    /// As [`HomeResolver::pinned_dataset`], for a checkpoint.
    ///
    /// # Errors
    /// As [`HomeResolver::pinned_dataset`].
    pub fn pinned_checkpoint(&self, given: &str) -> Result<String> {
        self.check_local("checkpoint", given)?;
        home::pinned_checkpoint(given)
    }

    fn wrapping(&self, request: &EvalRequest) -> Result<Wrapping> {
        let goal = if request.wrap_goal { GoalFrame::Wrapped } else { GoalFrame::Clean };
        if let Some(last) = &*self.wrapping.borrow()
            && last.choices == request.wrappers
            && last.goal == goal
        {
            return Ok(last.clone());
        }
        let wrappers = request.wrappers.iter().map(|choice| {
            let settings = choice.settings.as_object().cloned().unwrap_or_default();
            let entry = WRAPPERS.get(&choice.id)?;
            check_wrapper(&self.origin, entry)?;
            entry.make(&settings.into_iter().collect())
        });
        let stack = Arc::new(Stack::new(wrappers)?);
        let wrapping = Wrapping { choices: request.wrappers.clone(), stack, goal };
        *self.wrapping.borrow_mut() = Some(wrapping.clone());
        Ok(wrapping)
    }

    /// Makes a policy that plans by restoring and stepping the environment itself.
    fn simulator_policy(&self, name: &str, score: &str, planner: Planner, world: &World) -> Result<ResolvedPolicy> {
        let (spec, score) = (world.spec(), parse_score(score)?);
        let scale = ActionScale::unscaled(spec);
        let cost = SimulatorCost::new(self.maker(spec)?, scale.clone(), planner.mpc.action_block, score)?;
        Ok(self.traced(name, planner.policy(Box::new(cost), scale, world)?))
    }

    /// Returns a function that makes environments like those of a world, with the wrappers of the last request.
    fn maker(&self, spec: &EnvSpec) -> Result<impl Fn() -> Result<Box<dyn Env>> + Send + Sync + use<>> {
        let (env, wrapping) = (self.choose_env(&spec.id)?, self.wrapping.borrow().clone());
        Ok(move || match &wrapping {
            Some(Wrapping { stack, goal, .. }) => Ok(stack.wrap(env.env()?, *goal)),
            None => env.env(),
        })
    }

    /// Makes a policy that plans as with a checkpoint, but steps the environment in place of its dynamics.
    fn true_dynamics_policy(
        &self,
        name: &str,
        (given, cost): (&str, EndCost),
        planner: Planner,
        world: &World,
    ) -> Result<ResolvedPolicy> {
        let loaded = self.checkpoint(given)?;
        let info = loaded.info()?;
        check_trained_on(&info, given, world.spec())?;
        let (make, scale) = (self.maker(world.spec())?, info.dataset_info.action.clone());
        let block = planner.mpc.action_block;
        let cost: Box<dyn CostModel> = match cost {
            EndCost::Success => Box::new(SimulatorCost::new(make, scale.clone(), block, Score::Success)?),
            EndCost::Latent => {
                let model = loaded.predictor().ok_or_else(|| {
                    let problem = format!("a {} model offers no latents of observations", info.family);
                    Error::config(
                        format!("checkpoint {given}"),
                        problem,
                        "plan with its own dynamics (an autopsy: leave out D and E)",
                    )
                })?;
                Box::new(SimulatedLatents::new(make, scale.clone(), block, model)?)
            }
        };
        let policy = planner.policy(cost, scale, world)?;
        Ok(self.with_provenance(self.traced(name, policy), info))
    }

    /// Makes a policy that plans with a checkpoint.
    fn model_policy(&self, name: &str, given: &str, planner: Planner, world: &World) -> Result<ResolvedPolicy> {
        let loaded = self.checkpoint(given)?;
        let info = loaded.info()?;
        check_trained_on(&info, given, world.spec())?;
        let cost = loaded.cost().ok_or_else(|| {
            let problem = format!("a {} model acts and does not predict", info.family);
            Error::config(format!("checkpoint {given}"), problem, "evaluate it without a solver")
        })?;
        let policy = planner.policy(cost, info.dataset_info.action.clone(), world)?;
        Ok(self.with_provenance(self.traced(name, policy), info))
    }

    /// Adds the checkpoint's hash and libraries, and the device of the computation, to a policy.
    fn with_provenance(&self, policy: ResolvedPolicy, info: CheckpointInfo) -> ResolvedPolicy {
        ResolvedPolicy {
            weights: Some(info.weights),
            libraries: info.manifest.libraries,
            device: Some(device::name_after(&self.device, &info.manifest.device)),
            ..policy
        }
    }

    /// Records the plans of a policy if this resolver traces.
    fn traced(&self, name: &str, policy: MpcPolicy) -> ResolvedPolicy {
        let Some(traces) = &self.traces else { return ResolvedPolicy::from(Box::new(policy) as Box<dyn Policy>) };
        let (log, traces, name) = (TraceLog::default(), Arc::clone(traces), name.to_owned());
        let policy: Box<dyn Policy> = Box::new(policy.traced(log.clone()));
        let searches = move || {
            let records = log.take();
            let searches = records.iter().map(|record| record.search.clone()).collect();
            traces.lock().unwrap_or_else(PoisonError::into_inner).push((name.clone(), records));
            searches
        };
        ResolvedPolicy { searches: Some(Box::new(searches)), ..ResolvedPolicy::from(policy) }
    }
}

impl Resolver for HomeResolver {
    fn env(&self, request: &EvalRequest) -> Result<Box<dyn Env>> {
        let (env, wrapping) = (self.choose_env(&request.env)?.env()?, self.wrapping(request)?);
        Ok(wrapping.stack.wrap(env, wrapping.goal))
    }

    fn dataset(&self, name: &str) -> Result<Arc<dyn Reader>> {
        self.check_local("dataset", name)?;
        home::open_dataset(name)
    }

    fn policy(&self, request: &PolicyRequest, world: &World) -> Result<ResolvedPolicy> {
        let (spec, slots) = (world.spec(), world.pool().len());
        match &request.kind {
            PolicyKind::Random => Ok(ResolvedPolicy::from(Box::new(RandomPolicy::new(spec, slots)) as Box<dyn Policy>)),
            PolicyKind::NoOp => Ok(ResolvedPolicy::from(Box::new(NoOpPolicy::new(spec)?) as Box<dyn Policy>)),
            PolicyKind::Replay | PolicyKind::Nearest => {
                let problem = "only an evaluation knows the starts whose actions it repeats";
                Err(Error::config(format!("policy '{}'", request.name), problem, "use it in `swm eval`"))
            }
            PolicyKind::Expert { id } => {
                scripted(&self.choose_env(&spec.id)?.entry, id, world).map(ResolvedPolicy::from)
            }
            PolicyKind::Direct { checkpoint: given, .. } => {
                let (policy, info) = direct(&*self.checkpoint(given)?, given, spec, slots)?;
                Ok(self.with_provenance(ResolvedPolicy::from(policy), info))
            }
            PolicyKind::Plan { model, solver, mpc, objective } => {
                let planner = Planner::new(solver, mpc, objective)?;
                match model {
                    Model::Simulator { score } => self.simulator_policy(&request.name, score, planner, world),
                    Model::Checkpoint(given) => self.model_policy(&request.name, given, planner, world),
                    Model::TrueDynamics { checkpoint, cost } => {
                        self.true_dynamics_policy(&request.name, (checkpoint, *cost), planner, world)
                    }
                    Model::Probe { checkpoint, dataset, columns, true_dynamics } => {
                        let source = (checkpoint.as_str(), dataset.as_str(), columns.as_slice());
                        self.probe_policy(&request.name, source, *true_dynamics, planner, world)
                    }
                }
            }
        }
    }

    fn predictor(&self, request: &PolicyRequest) -> Result<Option<Box<dyn Predictor>>> {
        let PolicyKind::Plan { model: Model::Checkpoint(given), .. } = &request.kind else { return Ok(None) };
        Ok(self.checkpoint(given)?.predictor())
    }
}

/// Refuses a wrapper that reads files if a file chose it.
///
/// # Errors
/// As [`Origin::check_user`].
pub fn check_wrapper(origin: &Origin, entry: &WrapperEntry) -> Result<()> {
    if entry.reads_files() {
        origin.check_user(&format!("the wrapper '{}'", entry.id), "which reads files", None)?;
    }
    Ok(())
}

/// A solver with the settings of model-predictive control and the objective.
struct Planner {
    id: String,
    solver: Box<dyn Solver>,
    mpc: MpcConfig,
    objective: ObjectiveConfig,
}

impl Planner {
    fn new(solver: &Choice, mpc: &serde_json::Value, objective: &serde_json::Value) -> Result<Self> {
        fn parse<T: DeserializeOwned>(setting: &str, value: &serde_json::Value) -> Result<T> {
            serde_json::from_value(value.clone())
                .map_err(|error| Error::config(setting, error.to_string(), "`swm eval --help` lists the settings"))
        }
        let (id, solver) = (solver.id.clone(), (SOLVERS.get(&solver.id)?.make)(&solver.settings)?);
        let mpc = parse("MPC settings", mpc)?;
        let objective = if objective.is_null() { ObjectiveConfig::default() } else { parse("objective", objective)? };
        Ok(Self { id, solver, mpc, objective })
    }

    /// Makes the policy; fails if the solver cannot minimise this cost.
    fn policy(self, mut cost: Box<dyn CostModel>, scale: ActionScale, world: &World) -> Result<MpcPolicy> {
        if self.mpc.fast {
            cost.plan_together();
        }
        let spec = world.spec();
        let mut cost = self.objective.apply(cost)?;
        pairing(&self.id, &mut *cost, ActionKind::of(&spec.action_space))?;
        MpcPolicy::new(self.solver, cost, self.mpc, scale, spec, world.pool().len())
    }
}

/// Returns the policy of a choice for a world, and the hashes of the checkpoints' weights as a manifest stores them:
/// under `policy`, in a mixture under `policy.INDEX`.
///
/// # Errors
/// When neither an expert nor a checkpoint has a name, or a checkpoint was trained on another environment or requires a
/// solver.
pub fn policy_of_choice(
    entry: &EnvEntry,
    choice: &PolicyChoice,
    world: &World,
) -> Result<(Box<dyn Policy>, BTreeMap<String, String>)> {
    let (mut policies, mut hashes) = (vec![], BTreeMap::new());
    for (index, name) in choice.names().into_iter().enumerate() {
        let (policy, weights) = policy_by_name(entry, name, world)?;
        let part = if choice.is_mixture() { format!("policy.{index}") } else { "policy".to_owned() };
        hashes.extend(weights.map(|weights| (part, weights)));
        policies.push(policy);
    }
    Ok((Box::new(MixturePolicy::new(choice.clone(), policies, world.pool().len())), hashes))
}

/// Returns the policy with a name for a world: a [`scripted`] policy, or a checkpoint that acts without a solver. For a
/// checkpoint, also returns the hash of the weights.
fn policy_by_name(entry: &EnvEntry, name: &str, world: &World) -> Result<(Box<dyn Policy>, Option<String>)> {
    let trained = zoo::trained_expert(entry, &world.spec().id, name);
    let name = trained.as_deref().unwrap_or(name);
    let is_scripted = ["random", "expert"].contains(&name) || entry.experts.iter().any(|expert| expert.id == name);
    if is_scripted || !home::checkpoint(name)?.exists() {
        return Ok((scripted(entry, name, world)?, None));
    }
    let (policy, info) = checkpoint_policy(name, world.spec(), world.pool().len())?;
    Ok((policy, Some(info.weights)))
}

/// Returns the environment's expert with this name, scripted or of the zoo; for one of the zoo also the hash of its weights.
///
/// # Errors
/// When the environment has no such expert.
pub fn expert(entry: &EnvEntry, name: &str, world: &World) -> Result<(Box<dyn Policy>, Option<String>)> {
    match zoo::trained_expert(entry, &world.spec().id, name) {
        Some(trained) => policy_by_name(entry, &trained, world),
        None => Ok((scripted(entry, name, world)?, None)),
    }
}

/// Loads a checkpoint that acts without a solver; returns its policy for `slots` environments and its description.
///
/// # Errors
/// When the checkpoint does not exist, was trained on another environment, or requires a solver.
pub fn checkpoint_policy(given: &str, spec: &EnvSpec, slots: usize) -> Result<(Box<dyn Policy>, CheckpointInfo)> {
    direct(&*HomeResolver::new(Origin::User).checkpoint(given)?, given, spec, slots)
}

/// As [`checkpoint_policy`], of a checkpoint that is loaded; `given` names it in errors.
///
/// # Errors
/// When it was trained on another environment, or requires a solver.
pub fn direct(
    loaded: &dyn LoadedModel,
    given: &str,
    spec: &EnvSpec,
    slots: usize,
) -> Result<(Box<dyn Policy>, CheckpointInfo)> {
    let info = loaded.info()?;
    check_trained_on(&info, given, spec)?;
    let policy = loaded.policy(spec, slots).ok_or_else(|| {
        let problem = format!("a {} model predicts and does not act", info.family);
        Error::config(format!("checkpoint {given}"), problem, "plan with it (`swm eval` does)")
    })??;
    Ok((policy, info))
}

/// Returns an untrained policy: `random`, `expert` (the environment's first expert), or an expert by its id.
///
/// # Errors
/// When the environment has no such expert.
pub fn scripted(entry: &EnvEntry, name: &str, world: &World) -> Result<Box<dyn Policy>> {
    let slots = world.pool().len();
    let Some(expert) = find_expert(entry, name)? else {
        return Ok(Box::new(RandomPolicy::new(world.spec(), slots)));
    };
    Ok(Box::new(ExpertPolicy::new(world.spec(), (0..slots).map(|_| (expert.make)()).collect())))
}

/// Checks the name of an untrained policy, as [`scripted`] does, before an environment is made.
///
/// # Errors
/// When the environment has no such expert.
pub fn check_scripted(entry: &EnvEntry, name: &str) -> Result<()> {
    find_expert(entry, name).map(drop)
}

/// Returns the expert with this name; `None` for the random policy.
fn find_expert(entry: &EnvEntry, name: &str) -> Result<Option<&'static ExpertEntry>> {
    if name == "random" {
        return Ok(None);
    }
    match entry.experts {
        [first, ..] if name == "expert" => Ok(Some(first)),
        [] => {
            let hint = format!("{}: choose random or a checkpoint", describe::without_experts(entry));
            Err(Error::unknown("policy", name, ["random"], hint))
        }
        experts => experts.iter().find(|expert| expert.id == name).map(Some).ok_or_else(|| {
            let known = ["random", "expert"].into_iter().chain(experts.iter().map(|expert| expert.id()));
            Error::unknown("policy", name, known, format!("`swm envs` lists the experts of {}", entry.id))
        }),
    }
}

/// Returns the score of simulated plans with this name.
///
/// # Errors
/// When no score has the name.
pub fn parse_score(name: &str) -> Result<Score> {
    serde_json::from_value(name.into()).map_err(|_| {
        let hint = format!("the scores of simulated plans are {}", Score::NAMES.join(", "));
        Error::unknown("score", name, Score::NAMES, hint)
    })
}

/// Fails if a checkpoint was trained on another environment.
fn check_trained_on(info: &CheckpointInfo, name: &str, spec: &EnvSpec) -> Result<()> {
    match &info.dataset_info.env {
        Some(env) if *env != spec.id => Err(Error::config(
            format!("checkpoint {name}"),
            format!("it was trained on {env}, not on {}", spec.id),
            format!("evaluate it with --env {env}, or train a checkpoint on {}", spec.id),
        )),
        _ => Ok(()),
    }
}
