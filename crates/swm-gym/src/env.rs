//! [`GymEnv`]: a Gymnasium environment as a world.
//!
//! An episode is its seed, its options and the actions so far. That is what a snapshot holds, and what brings a world
//! back whose worker is gone: a new one plays the episode again. So an environment that is not deterministic cannot be
//! restored exactly.

use crate::describe::head;
use crate::recorded::{self, Goal};
use crate::{Description, Failure, Form, Request, Transport};
use std::collections::BTreeMap;
use std::sync::Arc;
use swm_core::{
    Action, Callable, DatasetStart, DatasetStartEnv, DispatchEnv, Env, EnvSpec, Error, FactorValues, FrameMut, Key,
    PendingCall, ResetOptions, Result, RowMut, RowRef, Schema, Snapshot, Transition, VariationRequest,
};
use swm_image::resize::{PillowFilter, PillowResizer};

/// How many lines of a traceback an error shows: the end, which names what was raised.
const LINES: usize = 12;

/// A Gymnasium environment.
pub struct GymEnv {
    transport: Box<dyn Transport>,
    form: Arc<Form>,
    /// How often a lost worker is replaced within one request.
    restarts: usize,
    stage: Stage,
    /// None before the first reset and after an error.
    episode: Option<Episode>,
    /// What the environment does already, before it was asked for: the reset of the episode, or the last of its actions.
    announced: Option<Ask>,
    factors: FactorValues,
    /// Whether the picture in the memory is of now.
    drawn: bool,
    /// Whether somebody looks: then a step brings its picture along.
    looked_at: bool,
    resizer: PillowResizer,
}

/// How far the environment behind the transport is.
#[derive(Clone, Copy, PartialEq)]
enum Stage {
    /// It is being made.
    Begun,
    /// It answers.
    Ready,
    /// It must be made anew.
    Broken,
}

/// What decides everything so far.
struct Episode {
    /// The arguments of its reset, as JSON.
    reset: String,
    /// The picture of its goal, where it starts from a dataset that has one.
    goal: Option<Goal>,
    /// The bytes of its actions, one after the other.
    actions: Vec<u8>,
}

/// What is asked for: as [`Request`], but of the episode as it is.
#[derive(Clone, Copy, PartialEq)]
enum Ask {
    Reset,
    /// The last of the episode's actions.
    Step,
    Render,
}

impl GymEnv {
    /// A world over a transport, once its environment says what it is. A worker that is lost is replaced so many times
    /// within one request.
    ///
    /// # Errors
    /// When the environment cannot be made, or has actions or observations that no column can hold.
    pub fn new(id: &str, mut transport: Box<dyn Transport>, restarts: usize) -> Result<Self> {
        let mut lost = 0;
        let description = loop {
            match transport.describe() {
                Ok(description) => break description,
                Err(Failure::Lost(how)) if lost < restarts => {
                    lost += 1;
                    tracing::warn!("{id}: {how}; starting another worker ({lost} of {restarts})");
                    transport.restart().map_err(|failure| explain(id, "making it", 0, failure))?;
                }
                Err(failure) => return Err(explain(id, "making it", lost, failure)),
            }
        };
        let mut env = Self::like(Arc::new(Form::new(id, description)?), transport, restarts)?;
        env.stage = Stage::Ready;
        Ok(env)
    }

    /// A world of which another one told what it is: does not wait for its environment.
    ///
    /// # Errors
    /// When the defaults of its factors contradict each other.
    pub fn like(form: Arc<Form>, transport: Box<dyn Transport>, restarts: usize) -> Result<Self> {
        let nothing = VariationRequest { variation: Some(vec![]), ..VariationRequest::default() };
        Ok(Self {
            factors: form.spec.variation_space.resolve(&nothing, Key::new(0))?,
            resizer: PillowResizer::new(if form.pixel_art() { PillowFilter::Nearest } else { PillowFilter::Triangle }),
            transport,
            form,
            restarts,
            stage: Stage::Begun,
            episode: None,
            announced: None,
            drawn: false,
            looked_at: false,
        })
    }

    /// What worlds of this id share.
    pub fn form(&self) -> &Arc<Form> {
        &self.form
    }

    /// Asks, in a new environment with the same past where the old one is lost.
    fn ask(&mut self, ask: Ask) -> Result<()> {
        let mut lost = 0;
        loop {
            let answer = match lost {
                0 => self.ready().and_then(|()| self.pass_on(ask)),
                _ => self.replay(ask).and_then(|()| self.pass_on(ask)),
            };
            match answer {
                Ok(()) => return Ok(()),
                Err(Failure::Lost(how)) if lost < self.restarts => {
                    lost += 1;
                    self.stage = Stage::Broken;
                    let (id, restarts) = (&self.form.spec.id, self.restarts);
                    tracing::warn!("{id}: {how}; its episode is played again in a new worker ({lost} of {restarts})");
                }
                Err(failure) => {
                    self.stage = Stage::Broken;
                    self.episode = None;
                    let what = match ask {
                        Ask::Reset => "its reset",
                        Ask::Step => "its step",
                        Ask::Render => "its render",
                    };
                    return Err(explain(&self.form.spec.id, what, lost, failure));
                }
            }
        }
    }

    /// Waits until the environment is made, anew if need be.
    fn ready(&mut self) -> Result<(), Failure> {
        if self.stage == Stage::Broken {
            self.transport.restart()?;
            self.stage = Stage::Begun;
        }
        if self.stage == Stage::Begun {
            let description = self.transport.describe()?;
            self.agree(&description)?;
            self.stage = Stage::Ready;
        }
        Ok(())
    }

    /// Environments of one id are alike.
    fn agree(&self, description: &Description) -> Result<(), Failure> {
        if *description == self.form.description {
            return Ok(());
        }
        Err(Failure::Refused(Error::config(
            &self.form.spec.id,
            "two environments of this id have other columns, spaces or pictures",
            "what an environment observes must not change from one to the next",
        )))
    }

    /// Brings a new environment to where the old one was before it was asked.
    fn replay(&mut self, ask: Ask) -> Result<(), Failure> {
        self.ready()?;
        if ask == Ask::Reset {
            return Ok(());
        }
        let Some(episode) = &self.episode else { return Ok(()) };
        self.transport.call(Request::Reset(&episode.reset))?;
        let n = self.form.action.len();
        let past = episode.actions.len() - if ask == Ask::Step { n } else { 0 };
        for action in episode.actions[..past].chunks_exact(n) {
            self.transport.memory_mut()[self.form.action.clone()].copy_from_slice(action);
            self.transport.call(Request::Step)?;
        }
        Ok(())
    }

    fn pass_on(&mut self, ask: Ask) -> Result<(), Failure> {
        let Some(episode) = &self.episode else { return Ok(()) };
        let request = match ask {
            Ask::Reset => Request::Reset(&episode.reset),
            Ask::Render => Request::Render,
            Ask::Step => {
                // Announced, it is there already, and the memory is the environment's.
                if self.announced.is_none() {
                    let place = self.form.action.clone();
                    let last = episode.actions.len() - place.len();
                    self.transport.memory_mut()[place].copy_from_slice(&episode.actions[last..]);
                }
                self.step_request()
            }
        };
        self.announced = None;
        self.transport.call(request)?;
        self.drawn = matches!(request, Request::Render | Request::DrawnStep);
        Ok(())
    }

    /// With a picture, if somebody looks.
    fn step_request(&self) -> Request<'static> {
        if self.looked_at { Request::DrawnStep } else { Request::Step }
    }

    /// Finishes what was announced, whether or not it was asked for.
    fn settle(&mut self) -> Result<()> {
        match self.announced {
            None => Ok(()),
            Some(Ask::Reset) => self.begin(),
            Some(_) => self.advance(),
        }
    }

    /// An episode without actions.
    fn open(&mut self, reset: String, goal: Option<Goal>) {
        let mut actions = self.episode.take().map(|episode| episode.actions).unwrap_or_default();
        actions.clear();
        self.episode = Some(Episode { reset, goal, actions });
        self.drawn = false;
    }

    /// Starts the episode and reads its factors.
    fn begin(&mut self) -> Result<()> {
        self.ask(Ask::Reset)?;
        let numbers = self.transport.memory()[self.form.factors()].chunks_exact(size_of::<f64>());
        let values: Vec<f64> = numbers.map(bytemuck::pod_read_unaligned).collect();
        let space = &self.form.spec.variation_space;
        let mut rest = &values[..];
        let pinned = space.factors().iter().map(|factor| {
            let (value, more) = rest.split_at(factor.space.len());
            rest = more;
            (factor.key.clone(), value.to_vec())
        });
        let request = VariationRequest { variation: Some(vec![]), variation_values: pinned.collect() };
        self.factors = space.resolve(&request, Key::new(0))?;
        Ok(())
    }

    /// Takes the action that was just added to the episode.
    fn advance(&mut self) -> Result<()> {
        self.drawn = false;
        self.ask(Ask::Step)
    }

    /// The arguments of a reset; what the environment would not understand is an error here.
    fn arguments(&self, seed: u64, options: &ResetOptions) -> Result<serde_json::Value> {
        let id = &self.form.spec.id;
        if options.state.is_some() || options.goal_state.is_some() {
            return Err(Error::config(
                format!("{id}, the state of a reset"),
                "a Gymnasium environment starts where its seed says",
                "choose the start by seed, or by its factors of variation if it has any",
            ));
        }
        let space = &self.form.spec.variation_space;
        let VariationRequest { variation, variation_values } = &options.variation;
        let asked = !variation_values.is_empty() || variation.as_ref().is_some_and(|keys| !keys.is_empty());
        if asked && space.factors().is_empty() {
            let problem = "it has none: neither the environment nor a wrapper of it has a `variation_space`";
            return Err(Error::config(format!("factors of variation of {id}"), problem, "ask for none"));
        }
        let mut arguments = serde_json::json!({"seed": small(seed)});
        if let Some(keys) = variation {
            for key in keys {
                space.select(key)?;
            }
            let all = keys.iter().any(|key| key == "all");
            arguments["variation"] = if all { serde_json::json!(["all"]) } else { serde_json::json!(keys) };
        }
        if !variation_values.is_empty() {
            for (key, value) in variation_values {
                let known = space.factors().iter().map(|factor| factor.key.as_str());
                let Some(place) = space.find(key) else {
                    return Err(Error::unknown("factor of variation", key, known, "`swm fovs ENV` lists them"));
                };
                space.factors()[place].space.check(key, value)?;
            }
            arguments["variation_values"] = serde_json::json!(variation_values);
        }
        Ok(arguments)
    }

    /// A number of the head of the buffer; 0 before there is one.
    fn number(&self, at: usize) -> f64 {
        let bytes = self.transport.memory().get(at..at + 8);
        bytes.map_or(0.0, bytemuck::pod_read_unaligned)
    }

    fn flag(&self, at: usize) -> bool {
        self.transport.memory().get(at).is_some_and(|&byte| byte != 0)
    }
}

/// A seed as Gymnasium environments take it: libraries below them want 31 bits. Those that fit stay as they are.
fn small(seed: u64) -> u64 {
    const BITS: u64 = (1 << 31) - 1;
    if seed <= BITS { seed } else { (seed ^ (seed >> 31) ^ (seed >> 62)) & BITS }
}

/// A failure as an error of the platform.
fn explain(id: &str, what: &str, lost: usize, failure: Failure) -> Error {
    match failure {
        Failure::Refused(error) => error,
        Failure::Raised(traceback) => {
            let lines: Vec<&str> = traceback.trim_end().lines().collect();
            let end = &lines[lines.len().saturating_sub(LINES)..];
            Error::external(format!("{id}: {what} raised"), end.join("\n"))
        }
        Failure::Lost(how) if lost == 0 => Error::external(format!("{id}: {what}"), how),
        Failure::Lost(how) => {
            Error::external(format!("{id}: {what} failed in {} workers, one after the other", lost + 1), how)
        }
    }
}

impl DispatchEnv for GymEnv {
    fn dispatch(&mut self, call: PendingCall<'_>) -> bool {
        if !self.transport.apart() || self.stage != Stage::Ready || self.announced.is_some() {
            return false;
        }
        match call {
            PendingCall::Reset(seed, options) => {
                let Ok(arguments) = self.arguments(seed, options) else { return false };
                let arguments = arguments.to_string();
                if !self.transport.announce(Request::Reset(&arguments)) {
                    return false;
                }
                self.open(arguments, None);
                self.announced = Some(Ask::Reset);
            }
            PendingCall::Step(action) => {
                let request = self.step_request();
                let (Some(episode), Ok(bytes)) = (&mut self.episode, self.form.bytes(action)) else { return false };
                self.transport.memory_mut()[self.form.action.clone()].copy_from_slice(bytes);
                if !self.transport.announce(request) {
                    return false;
                }
                episode.actions.extend_from_slice(bytes);
                self.announced = Some(Ask::Step);
            }
        }
        true
    }
}

impl DatasetStartEnv for GymEnv {
    fn required_columns(&self, stored: &Schema, callables: &[Callable]) -> Result<Vec<String>> {
        recorded::columns(&self.form, stored, callables)
    }

    /// The callables and their arguments belong to the arguments of the reset, so that a replay of the episode starts at the
    /// same state.
    fn reset_from(&mut self, seed: u64, options: &ResetOptions, from: DatasetStart<'_>) -> Result<()> {
        self.settle()?;
        let (seed, options) = recorded::reset(&self.form, seed, options, from.start)?;
        let mut arguments = self.arguments(seed, &options)?;
        arguments["recorded"] = recorded::json(&self.form, &from)?;
        self.open(arguments.to_string(), Goal::of(&from));
        self.begin()
    }
}

impl Env for GymEnv {
    fn spec(&self) -> &EnvSpec {
        &self.form.spec
    }

    fn reset(&mut self, seed: u64, options: &ResetOptions) -> Result<()> {
        let arguments = self.arguments(seed, options)?.to_string();
        let announced = self.announced == Some(Ask::Reset);
        if !announced || self.episode.as_ref().is_none_or(|episode| episode.reset != arguments) {
            self.settle()?;
            self.open(arguments, None);
        }
        self.begin()
    }

    fn as_dispatch(&mut self) -> Option<&mut dyn DispatchEnv> {
        Some(self)
    }

    fn dataset_start(&self) -> Option<&dyn DatasetStartEnv> {
        Some(self)
    }

    fn dataset_start_mut(&mut self) -> Option<&mut dyn DatasetStartEnv> {
        Some(self)
    }

    fn step(&mut self, action: Action<'_>) -> Result<Transition> {
        let bytes = self.form.bytes(action)?;
        let announced = self.announced == Some(Ask::Step);
        if !announced || self.episode.as_ref().is_none_or(|episode| !episode.actions.ends_with(bytes)) {
            self.settle()?;
            let Some(episode) = &mut self.episode else {
                return Err(Error::config(&self.form.spec.id, "stepped outside an episode", "reset it first"));
            };
            episode.actions.extend_from_slice(bytes);
        }
        self.advance()?;
        Ok(Transition {
            reward: self.number(head::REWARD),
            terminated: self.flag(head::TERMINATED),
            truncated: self.flag(head::TRUNCATED),
        })
    }

    fn observe(&self, row: &mut RowMut<'_>) {
        let memory = self.transport.memory();
        for (i, place) in self.form.columns.iter().enumerate() {
            match memory.get(place.clone()) {
                Some(bytes) => row.bytes(i).copy_from_slice(bytes),
                None => row.bytes(i).fill(0),
            }
        }
    }

    fn render(&mut self, frame: FrameMut<'_>) -> Result<()> {
        let form = Arc::clone(&self.form);
        let Some(picture) = form.picture() else {
            return Err(Error::config(
                format!("pictures of {}", form.spec.id),
                form.no_picture(),
                "ask for no pictures, or give it a render mode 'rgb_array'",
            ));
        };
        self.settle()?;
        self.looked_at = true;
        if !self.drawn {
            if self.episode.is_none() {
                return Err(Error::config(&form.spec.id, "drawn outside an episode", "reset it first"));
            }
            self.ask(Ask::Render)?;
        }
        self.resizer.resize(
            &self.transport.memory()[picture.range()],
            (picture.size[0], picture.size[1]),
            frame.rgb,
            (frame.height, frame.width),
        );
        Ok(())
    }

    /// The picture in the goal's row of a dataset, or the one that `info['goal']` held at the reset, black where there is
    /// none.
    fn render_goal(&mut self, frame: FrameMut<'_>) -> Result<()> {
        self.settle()?;
        match (self.form.goal(), &self.episode) {
            (_, Some(Episode { goal: Some(goal), .. })) => {
                self.resizer.resize(&goal.rgb, (goal.size[0], goal.size[1]), frame.rgb, (frame.height, frame.width))
            }
            (Some(goal), Some(_)) => {
                self.resizer.resize(
                    &self.transport.memory()[goal.range()],
                    (goal.size[0], goal.size[1]),
                    frame.rgb,
                    (frame.height, frame.width),
                );
            }
            _ => frame.rgb.fill(0),
        }
        Ok(())
    }

    fn libraries(&self) -> BTreeMap<String, String> {
        self.form.libraries().clone()
    }

    fn factors(&self) -> &FactorValues {
        &self.factors
    }

    /// The episode so far: the arguments of its reset, the picture of its goal, its actions.
    fn snapshot(&self) -> Snapshot {
        let mut bytes = format!("{}\n", self.form.spec.id).into_bytes();
        if let Some(Episode { reset, goal, actions }) = &self.episode {
            let ([height, width], rgb) = goal.as_ref().map_or(([0, 0], &[][..]), |goal| (goal.size, &goal.rgb));
            bytes.extend(format!("{reset}\n{height} {width}\n").bytes());
            bytes.extend(rgb);
            bytes.extend(actions);
        }
        Snapshot(bytes)
    }

    /// Plays the episode again, from where this one parts from it.
    fn restore(&mut self, snapshot: &Snapshot) -> Result<()> {
        let id = &self.form.spec.id;
        let line = |bytes: &[u8]| -> Option<(String, usize)> {
            let end = bytes.iter().position(|&byte| byte == b'\n')?;
            Some((String::from_utf8(bytes[..end].to_vec()).ok()?, end + 1))
        };
        let parsed = line(&snapshot.0).filter(|(of, _)| of == id).and_then(|(_, at)| {
            let (reset, n) = line(&snapshot.0[at..])?;
            let (size, m) = line(&snapshot.0[at + n..])?;
            let (height, width) = size.split_once(' ')?;
            let size: [usize; 2] = [height.parse().ok()?, width.parse().ok()?];
            let (rgb, actions) =
                snapshot.0[at + n + m..].split_at_checked(size[0].checked_mul(size[1])?.checked_mul(3)?)?;
            let goal = (!rgb.is_empty()).then(|| Goal { size, rgb: rgb.to_vec() });
            actions.len().is_multiple_of(self.form.action.len()).then_some((reset, goal, actions))
        });
        let Some((reset, goal, actions)) = parsed else {
            return Err(Error::mismatch(
                format!("restoring {id}"),
                "a snapshot of another environment, or of one before its first reset",
                "one of an episode of this environment",
            ));
        };
        self.settle()?;
        let same = |now: &&Episode| now.reset == reset && now.goal == goal && actions.starts_with(&now.actions);
        let begun = self.episode.as_ref().filter(same);
        let mut at = match begun.map(|now| now.actions.len()) {
            Some(at) => at,
            None => {
                self.open(reset, goal);
                self.begin()?;
                0
            }
        };
        while at < actions.len() {
            let next = at + self.form.action.len();
            if let Some(episode) = &mut self.episode {
                episode.actions.extend_from_slice(&actions[at..next]);
            }
            self.advance()?;
            at = next;
        }
        Ok(())
    }

    fn restore_from(&mut self, _: RowRef<'_>, _: RowRef<'_>) -> Result<()> {
        Err(Error::config(
            format!("starting {} from a row of a dataset", self.form.spec.id),
            "a Gymnasium environment is put into a state at a reset",
            "start its episode there (`swm_core::dataset_start::reset`)",
        ))
    }

    fn sample_goal(&mut self, _: Key) -> Result<()> {
        Err(Error::config(
            format!("a new goal of {}", self.form.spec.id),
            "a Gymnasium environment chooses its goal itself, at a reset",
            "reset it with another seed",
        ))
    }

    fn is_success(&self) -> bool {
        self.flag(head::SUCCESS)
    }

    /// What `info['goal_distance']` says, infinite where it says nothing.
    fn goal_distance(&self) -> f64 {
        if self.episode.is_some() { self.number(head::DISTANCE) } else { f64::INFINITY }
    }
}
