//! The thread of a plan session: it searches, steps, and goes back.

mod decoding;
mod shown;

use super::imagination::Imagination;
use super::messages::{Reply, Request};
use super::scratch::{Codec, Scratch};
use super::tree::{Node, Tree};
use super::watch::Watch;
use super::{Model, Planner, Planners, Position, SIMULATOR, Settings, projection, search};
use crate::folders::Folders;
use crate::session::{Kind, Out, Session, Setup, check_seed};
use crate::{Lab, still};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::{Duration, Instant};
use swm_core::policy::write_action;
use swm_core::pool::Reset;
use swm_core::run::Control;
use swm_core::{EnvSpec, Error, Key, Policy, ResetOptions, Result, VariationRequest, columns, limits};
use swm_eval::{World, WorldConfig};

/// Steps a second before the page chooses.
const FPS: f64 = 10.0;
/// The fastest that a page may choose.
const FASTEST: f64 = 60.0;

/// What happens without another request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Mode {
    Paused,
    /// Steps go on.
    Playing,
    /// Steps go on until the next plan is due, which is searched.
    Deciding,
}

/// A planner with what the session knows of it.
struct InUse {
    policy: Box<dyn Policy>,
    model: String,
    imagination: Option<Imagination>,
    codec: Codec,
    /// Environment steps of a plan that are executed.
    steps: usize,
}

/// An environment that is planned in.
pub struct PlanSession<'a> {
    setup: Setup,
    out: Out,
    models: Vec<Model>,
    positions: &'static [Position],
    planners: Box<dyn Planners + 'a>,
    in_use: Option<InUse>,
    datasets: Folders,
    fitted: Option<decoding::Fitted>,
    /// The step at which the last search was made.
    searched_at: Option<usize>,
    watch: Watch,
    world: World,
    scratch: Scratch,
    tree: Tree,
    seed: u64,
    variation: VariationRequest,
    mode: Mode,
    interval: Duration,
    /// Steps of the plan that are left.
    left: usize,
    /// Whether the next action is computed already.
    has_action: bool,
    /// What the next step differs in.
    change: Option<String>,
    is_searching: bool,
    number: u64,
    threads: usize,
}

impl Session for PlanSession<'static> {
    type Request = Request;
    const IS_PLAN: bool = true;

    fn kind(request: &Request) -> Kind {
        match request {
            Request::Shown {} => Kind::Shown,
            Request::Enough {} => Kind::EndsSearch,
            _ => Kind::Ordered,
        }
    }

    fn play(lab: &Lab, setup: Setup, out: Out, requests: &Receiver<Request>) -> Result<()> {
        PlanSession::new(lab, setup, out)?.run(requests);
        Ok(())
    }
}

/// Makes the environment, with frames of this side if a model reads them.
fn world(setup: &Setup, image: Option<usize>, threads: usize) -> Result<World> {
    let image = image.map(|side| (side, side));
    World::new(setup.env.clone(), WorldConfig { envs: 1, image, threads, ..WorldConfig::default() })
}

/// Restores the present step of a tree in an environment.
fn restore(world: &mut World, tree: &Tree) -> Result<()> {
    let snapshot = tree.snapshot();
    world.modify(&[0], |_, env| env.restore(snapshot))
}

/// Returns the positions of the state, the distance to the goal and whether it is reached.
fn observed(world: &World, positions: &[Position]) -> Result<(Vec<[f32; 2]>, f64, bool)> {
    let state = world.pool().infos().row(0).to_f64(columns::STATE)?;
    let env = world.pool().env(0);
    Ok((projection::positions(&state, positions), env.goal_distance(), env.is_success()))
}

impl<'a> PlanSession<'a> {
    /// Makes the environment, and starts an episode.
    ///
    /// # Errors
    /// When the environment lacks assets, or the frame size is out of range.
    pub fn new(lab: &'a Lab, setup: Setup, out: Out) -> Result<Self> {
        limits::IMAGE_SIDE.check(setup.side)?;
        let mut world = world(&setup, None, lab.threads)?;
        let spec = world.spec().clone();
        world.restart(&[Reset { slot: 0, seed: 0, options: ResetOptions::default() }])?;
        let positions = lab.planning.positions(&spec);
        let (at, distance, success) = observed(&world, positions)?;
        let root = Node { distance, success, at, ..Node::default() };
        let mut session = Self {
            models: lab.planning.models(&spec),
            positions,
            planners: lab.planning.planners(),
            in_use: None,
            datasets: lab.datasets.clone(),
            fitted: None,
            searched_at: None,
            watch: Watch::new(out.clone()),
            scratch: Scratch::new(&setup.env)?,
            tree: Tree::new(root, world.pool().env(0).snapshot(), 0),
            setup,
            out,
            world,
            seed: 0,
            variation: VariationRequest::default(),
            mode: Mode::Paused,
            interval: Duration::from_secs_f64(1.0 / FPS),
            left: 0,
            has_action: false,
            change: None,
            is_searching: false,
            number: 0,
            threads: lab.threads,
        };
        session.started()?;
        Ok(session)
    }

    /// Answers requests until the page is gone.
    pub fn run(&mut self, requests: &Receiver<Request>) {
        let mut next = Instant::now();
        while !self.out.gone.load(Ordering::Relaxed) {
            let waited = if self.mode == Mode::Paused {
                requests.recv().map_err(|_| RecvTimeoutError::Disconnected)
            } else {
                requests.recv_timeout(next.saturating_duration_since(Instant::now()))
            };
            let outcome = match waited {
                Err(RecvTimeoutError::Disconnected) => return,
                Ok(request) => {
                    let was_paused = self.mode == Mode::Paused;
                    let outcome = self.handle(request);
                    if was_paused {
                        next = Instant::now();
                    }
                    outcome
                }
                Err(RecvTimeoutError::Timeout) => {
                    let outcome = self.tick();
                    // A search delays the next steps instead of being caught up.
                    next = (next + self.interval).max(Instant::now());
                    outcome
                }
            };
            if let Err(error) = outcome {
                self.mode = Mode::Paused;
                self.out.failed(&error);
                self.send_frame().ok();
            }
        }
    }

    fn handle(&mut self, request: Request) -> Result<()> {
        match request {
            Request::Reset { seed, pin, variation } => {
                let variation = still::request(&pin, variation.as_deref())?;
                self.spec().variation_space.check(&variation)?;
                check_seed(seed)?;
                (self.seed, self.variation) = (seed, variation);
                self.reset()
            }
            Request::Settings { planner } => self.plan_with(&planner),
            Request::Decode { dataset } => self.decode(dataset),
            Request::Decide {} => self.go_on(Mode::Deciding),
            Request::Play { on } => self.go_on(if on { Mode::Playing } else { Mode::Paused }),
            Request::Step {} => {
                self.mode = Mode::Paused;
                self.step()
            }
            Request::Speed { fps } => {
                if !(1.0..=FASTEST).contains(&fps) {
                    let fix = format!("choose 1 to {FASTEST} steps a second");
                    return Err(Error::config("speed", fps.to_string(), fix));
                }
                self.interval = Duration::from_secs_f64(1.0 / fps);
                Ok(())
            }
            Request::Act { action } => self.act(&action),
            Request::Change { factor, value } => self.change_factor(&factor, value),
            Request::Go { node } => self.go(node),
            Request::Peek { node } => {
                let jpeg = self.scratch.image(self.tree.snapshot_of(node)?, false, self.setup.side)?;
                self.out.reply(&Reply::Peeked { node, jpeg });
                Ok(())
            }
            Request::Forget {} => {
                self.tree.forget_others();
                self.send_tree();
                Ok(())
            }
            Request::Enough {} | Request::Shown {} => Ok(()),
        }
    }

    fn spec(&self) -> &EnvSpec {
        self.world.spec()
    }

    fn go_on(&mut self, mode: Mode) -> Result<()> {
        if mode != Mode::Paused && !self.tree.node().ended {
            self.tree.check_room()?;
            self.in_use()?;
        }
        self.mode = if self.tree.node().ended { Mode::Paused } else { mode };
        self.send_frame()
    }

    /// What happens next while the session is not paused.
    fn tick(&mut self) -> Result<()> {
        if self.mode == Mode::Deciding && self.left == 0 && !self.tree.node().ended {
            self.search()?;
            self.mode = Mode::Paused;
            return self.send_frame();
        }
        self.step()
    }

    fn in_use(&mut self) -> Result<&mut InUse> {
        let none = || Error::config("planning", "no planner is chosen", "choose a model and a solver first");
        self.in_use.as_mut().ok_or_else(none)
    }

    /// Plans with these settings from now on.
    fn plan_with(&mut self, settings: &Settings) -> Result<()> {
        let found = self.models.iter().find(|model| model.name == settings.model);
        let model = found.cloned().ok_or_else(|| {
            let names = self.models.iter().map(|model| model.name.as_str());
            Error::unknown("model", &settings.model, names, "reload the page, which lists the models")
        })?;
        let config = settings.mpc(&model, self.spec())?;
        // What is refused leaves the environment and the planner as they are.
        let mut other = None;
        if self.world.pool().image() != model.image.map(|side| (side, side)) {
            let mut world = world(&self.setup, model.image, self.threads)?;
            restore(&mut world, &self.tree)?;
            other = Some(world);
        }
        let (world, observer) = (other.as_ref().unwrap_or(&self.world), Box::new(self.watch.clone()));
        let Planner { policy, scale, predictor } = self.planners.planner(settings, &model, world, observer)?;
        let codec = Codec::new(&self.spec().action_space, scale);
        let imagination = match (predictor, model.image) {
            (Some(predictor), Some(side)) => Imagination::new(predictor, side)?,
            _ => None,
        };
        let steps = config.receding_horizon * config.action_block;
        if let Some(world) = other {
            self.world = world;
        }
        let in_use = InUse { policy, model: model.name.clone(), imagination, codec, steps };
        let had_one = self.in_use.replace(in_use).is_some();
        self.searched_at = None;
        self.use_decoder();
        if had_one && self.tree.nodes().len() > 1 {
            let model = if settings.model == SIMULATOR { "" } else { settings.model.as_str() };
            let text = format!("{model} {}, horizon {}", settings.solver_text(), settings.horizon);
            self.change = Some(text.trim().to_owned());
        }
        self.begin();
        let command = settings.command(self.spec());
        self.out.send(text(&Reply::Ready { model, block: config.action_block, command }));
        self.send_frame()
    }

    /// Starts the policy anew at the present step. Equal steps and settings give equal plans.
    fn begin(&mut self) {
        (self.left, self.has_action) = (0, false);
        let key = Key::new(self.seed).at(self.tree.node().step as u64);
        if let Some(in_use) = &mut self.in_use {
            in_use.policy.begin(0, key);
        }
    }

    /// Restores the present step in the environment.
    fn restore(&mut self) -> Result<()> {
        restore(&mut self.world, &self.tree)
    }

    /// Starts the episode of the seed and the factors.
    fn reset(&mut self) -> Result<()> {
        let options = ResetOptions { variation: self.variation.clone(), ..ResetOptions::default() };
        self.world.restart(&[Reset { slot: 0, seed: self.seed, options }])?;
        let (at, distance, success) = observed(&self.world, self.positions)?;
        let root = Node { distance, success, at, ..Node::default() };
        self.tree = Tree::new(root, self.world.pool().env(0).snapshot(), self.tree.next());
        self.change = None;
        self.started()
    }

    /// Shows the first step of a tree.
    fn started(&mut self) -> Result<()> {
        self.mode = Mode::Paused;
        self.begin();
        self.send_tree();
        self.send_goal();
        self.send_frame()
    }

    /// Computes the next action, which searches if a plan is due, and shows the search.
    fn search(&mut self) -> Result<()> {
        self.in_use()?;
        self.out.enough.store(false, Ordering::Relaxed);
        self.is_searching = self.left == 0;
        if self.is_searching {
            self.send_frame()?;
        }
        self.watch.take();
        let begun = Instant::now();
        let mut control = Control::new().with_interrupt(Arc::clone(&self.out.gone));
        let Some(in_use) = &mut self.in_use else { return Ok(()) };
        let acted = self.world.act_until(&mut *in_use.policy, &[true], &mut control);
        self.is_searching = false;
        if acted.is_err() {
            self.begin();
            return acted;
        }
        self.has_action = true;
        let Some(searched) = self.watch.take() else { return Ok(()) };
        let Some(in_use) = &mut self.in_use else { return Ok(()) };
        self.left = in_use.steps;
        let cost = searched.costs.last().map(|costs| costs.best);
        let seconds = begun.elapsed().as_secs_f64();
        let (start, codec) = (self.tree.snapshot(), &in_use.codec);
        let mut plan = search::describe(&searched, seconds, (&mut self.scratch, start, codec), self.positions)?;
        if let (Some(imagination), Some(last)) = (&mut in_use.imagination, searched.kept.last()) {
            let cheapest: Vec<_> = last.candidates.iter().filter(|one| one.rank.is_some()).collect();
            plan["imagination"] = imagination.compare(&cheapest, (&mut self.scratch, start, codec))?;
        }
        let plan = plan.to_string();
        self.searched_at = Some(self.tree.node().id);
        self.tree.set_plan(&plan, cost);
        self.send_plan(&plan);
        Ok(())
    }

    /// One step of the plan.
    fn step(&mut self) -> Result<()> {
        if self.tree.node().ended {
            self.mode = Mode::Paused;
            return self.send_frame();
        }
        self.tree.check_room()?;
        if !self.has_action {
            self.search()?;
        }
        self.left = self.left.saturating_sub(1);
        self.advance()
    }

    /// Steps with the action of the environment's row.
    fn advance(&mut self) -> Result<()> {
        self.has_action = false;
        self.world.advance(&[true])?;
        let row = self.world.pool().infos().row(0);
        let value = |name| row.to_f64(name).map(|values| values.first().copied().unwrap_or_default());
        let (reward, terminated) = (value(columns::REWARD)?, value(columns::TERMINATED)? > 0.0);
        let (before, limit) = (self.tree.node(), self.world.pool().max_episode_steps());
        let node = Node {
            step: before.step + 1,
            reward,
            total: before.total + reward,
            ended: terminated || before.step + 1 >= limit,
            ..Node::default()
        };
        self.add(node)?;
        if self.tree.node().ended {
            self.mode = Mode::Paused;
        }
        self.send_frame()
    }

    /// Adds a step to the tree, with what is observed now.
    fn add(&mut self, node: Node) -> Result<()> {
        let (at, distance, success) = observed(&self.world, self.positions)?;
        let node = Node { at, distance, success, change: self.change.take(), ..node };
        let node = self.tree.add(node, self.world.pool().env(0).snapshot())?.clone();
        self.out.send(text(&Reply::Node { node, bytes: self.tree.bytes() }));
        Ok(())
    }

    /// One step with an action of the page; the plan ends.
    fn act(&mut self, action: &[f64]) -> Result<()> {
        self.spec().action_space.check("action", action)?;
        self.mode = Mode::Paused;
        if self.tree.node().ended {
            return self.send_frame();
        }
        self.tree.check_room()?;
        let values: Vec<String> = action.iter().map(|value| format!("{value:.3}")).collect();
        self.change = Some(format!("action {}", values.join(" ")));
        write_action(&mut self.world.actions_mut().row_mut(0), 0, action);
        self.advance()?;
        self.begin();
        Ok(())
    }

    /// Starts an episode with a changed factor at the state and the goal of the present step.
    fn change_factor(&mut self, factor: &str, value: Vec<f64>) -> Result<()> {
        self.tree.check_room()?;
        self.mode = Mode::Paused;
        let row = self.world.pool().infos().row(0);
        let state = row.to_f64(columns::STATE)?;
        let goal_state = row.to_f64(columns::GOAL_STATE).ok();
        let factors = self.world.pool().env(0).factors();
        let mut values: std::collections::BTreeMap<String, Vec<f64>> =
            factors.iter().map(|(key, value)| (key.to_owned(), value.to_vec())).collect();
        let text = format!("{factor} = {}", value.iter().map(ToString::to_string).collect::<Vec<_>>().join(", "));
        values.insert(factor.to_owned(), value);
        let variation = VariationRequest { variation: Some(vec![]), variation_values: values };
        self.spec().variation_space.check(&variation)?;
        let options = ResetOptions { variation, state: Some(state), goal_state };
        if let Err(error) = self.world.restart(&[Reset { slot: 0, seed: self.seed, options }]) {
            self.restore()?;
            return Err(error);
        }
        let before = self.tree.node().clone();
        self.change = Some(text);
        self.add(Node { step: before.step, total: before.total, ..Node::default() })?;
        self.begin();
        self.send_goal();
        self.send_frame()
    }

    /// Goes to a step.
    fn go(&mut self, node: usize) -> Result<()> {
        self.tree.go(node)?;
        (self.mode, self.change) = (Mode::Paused, None);
        self.restore()?;
        self.begin();
        self.send_goal();
        if let Some(plan) = self.tree.plan() {
            self.send_plan(plan);
        }
        self.send_frame()
    }
}

fn text(reply: &Reply) -> String {
    serde_json::to_string(reply).unwrap_or_default()
}
