//! [`GymEnv`]: a Gymnasium environment as an [`Env`].
//!
//! A snapshot holds the seed, the options and the actions of the episode so far. A restore replays the actions.
//! After the loss of a worker, a new worker replays the actions, too. A replay is exact for deterministic environments
//! only.

use crate::dataset_start::{self as start, GoalFrame};
use crate::describe::header;
use crate::episode::Episode;
use crate::reset_arguments::reset_arguments;
use crate::{Description, EnvLayout, Failure, Request, Transport};
use std::collections::BTreeMap;
use std::sync::Arc;
use swm_core::{
    Action, Callable, DatasetStart, DatasetStartEnv, DispatchEnv, Env, EnvSpec, Error, FactorValues, FrameMut, Key,
    PendingCall, ResetOptions, Result, RowMut, RowRef, Schema, Snapshot, Transition, VariationRequest,
};
use swm_image::resize::{PillowFilter, PillowResizer};

/// A Gymnasium environment.
pub struct GymEnv {
    transport: Box<dyn Transport>,
    layout: Arc<EnvLayout>,
    /// The maximum number of lost workers that are replaced within one request.
    restarts: usize,
    stage: Stage,
    /// `None` before the first reset and after an error.
    episode: Option<Episode>,
    /// The dispatched call whose answer is not read yet: the reset of the episode, or the step of its last action.
    dispatched: Option<EnvCall>,
    factors: FactorValues,
    /// Whether the frame in the memory shows the current state.
    frame_is_current: bool,
    /// Whether steps also render; true after the first request of a frame.
    renders_steps: bool,
    resizer: PillowResizer,
}

/// The state of the environment behind the transport.
#[derive(Clone, Copy, PartialEq)]
enum Stage {
    /// The transport is making the environment.
    Starting,
    /// The environment accepts requests.
    Ready,
    /// The environment must be made again.
    Broken,
}

/// A call of the environment. It becomes a [`Request`] with the arguments of the current episode.
#[derive(Clone, Copy, PartialEq)]
enum EnvCall {
    Reset,
    /// A step with the last of the episode's actions.
    Step,
    Render,
}

impl GymEnv {
    /// Creates an environment over a transport and waits for its description. Up to `restarts` lost workers are
    /// replaced within one request.
    ///
    /// # Errors
    /// When the environment cannot be made, or its actions or observations have unsupported spaces.
    pub fn new(id: &str, mut transport: Box<dyn Transport>, restarts: usize) -> Result<Self> {
        let mut lost = 0;
        let description = loop {
            match transport.describe() {
                Ok(description) => break description,
                Err(Failure::Lost(how)) if lost < restarts => {
                    lost += 1;
                    tracing::warn!("{id}: {how}; starting another worker ({lost} of {restarts})");
                    transport.restart().map_err(|failure| failure.explain(id, "making the environment", 0))?;
                }
                Err(failure) => return Err(failure.explain(id, "making the environment", lost)),
            }
        };
        let mut env = Self::with_layout(Arc::new(EnvLayout::new(id, description)?), transport, restarts)?;
        env.stage = Stage::Ready;
        Ok(env)
    }

    /// Creates an environment with a known layout, without waiting for its description.
    ///
    /// # Errors
    /// When the defaults of its factors violate a constraint.
    pub fn with_layout(layout: Arc<EnvLayout>, transport: Box<dyn Transport>, restarts: usize) -> Result<Self> {
        let filter = if layout.pixel_art() { PillowFilter::Nearest } else { PillowFilter::Triangle };
        let no_factors = VariationRequest { variation: Some(vec![]), ..VariationRequest::default() };
        Ok(Self {
            factors: layout.spec.variation_space.resolve(&no_factors, Key::new(0))?,
            resizer: PillowResizer::new(filter),
            transport,
            layout,
            restarts,
            stage: Stage::Starting,
            episode: None,
            dispatched: None,
            frame_is_current: false,
            renders_steps: false,
        })
    }

    /// The layout that environments of this id share.
    pub fn layout(&self) -> &Arc<EnvLayout> {
        &self.layout
    }

    /// Makes a call. If the worker is lost, replays the episode in a new worker and repeats the call.
    fn env_call(&mut self, env_call: EnvCall) -> Result<()> {
        let mut lost = 0;
        loop {
            let answer = match lost {
                0 => self.ready().and_then(|()| self.send(env_call)),
                _ => self.replay(env_call).and_then(|()| self.send(env_call)),
            };
            match answer {
                Ok(()) => return Ok(()),
                Err(Failure::Lost(how)) if lost < self.restarts => {
                    lost += 1;
                    self.stage = Stage::Broken;
                    let (id, restarts) = (&self.layout.spec.id, self.restarts);
                    tracing::warn!("{id}: {how}; its episode is played again in a new worker ({lost} of {restarts})");
                }
                Err(failure) => {
                    self.stage = Stage::Broken;
                    let steps = self.episode.take().map_or(0, |now| now.actions.len() / self.layout.action.len());
                    let what = match env_call {
                        EnvCall::Reset => "its reset".to_owned(),
                        EnvCall::Step => format!("its step {steps}"),
                        EnvCall::Render => "its render".to_owned(),
                    };
                    return Err(failure.explain(&self.layout.spec.id, &what, lost));
                }
            }
        }
    }

    /// Waits until the environment is made. A broken environment is made again.
    fn ready(&mut self) -> Result<(), Failure> {
        if self.stage == Stage::Broken {
            self.transport.restart()?;
            self.stage = Stage::Starting;
        }
        if self.stage == Stage::Starting {
            let description = self.transport.describe()?;
            self.check_description(&description)?;
            self.stage = Stage::Ready;
        }
        Ok(())
    }

    /// Checks that the environment has the same description as earlier environments of its id.
    fn check_description(&self, description: &Description) -> Result<(), Failure> {
        if *description == self.layout.description {
            return Ok(());
        }
        Err(Failure::Refused(Error::config(
            &self.layout.spec.id,
            "two environments of this id differ in columns, spaces or frames",
            "give all environments of an id the same columns, spaces and frame size",
        )))
    }

    /// Replays the episode in a new environment, up to the call that failed.
    fn replay(&mut self, env_call: EnvCall) -> Result<(), Failure> {
        self.ready()?;
        if env_call == EnvCall::Reset {
            return Ok(());
        }
        let Some(episode) = &self.episode else { return Ok(()) };
        self.transport.call(Request::Reset(&episode.reset))?;
        let n = self.layout.action.len();
        let past = episode.actions.len() - if env_call == EnvCall::Step { n } else { 0 };
        for action in episode.actions[..past].chunks_exact(n) {
            self.transport.memory_mut()[self.layout.action.clone()].copy_from_slice(action);
            self.transport.call(Request::Step)?;
        }
        Ok(())
    }

    fn send(&mut self, env_call: EnvCall) -> Result<(), Failure> {
        let Some(episode) = &self.episode else { return Ok(()) };
        let request = match env_call {
            EnvCall::Reset => Request::Reset(&episode.reset),
            EnvCall::Render => Request::Render,
            EnvCall::Step => {
                // A dispatched action is already in the memory, which only the worker accesses until it answers.
                if self.dispatched.is_none() {
                    let range = self.layout.action.clone();
                    let last = episode.actions.len() - range.len();
                    self.transport.memory_mut()[range].copy_from_slice(&episode.actions[last..]);
                }
                self.step_request()
            }
        };
        self.dispatched = None;
        self.transport.call(request)?;
        if self.flag(header::FORKED) {
            return Err(Failure::Refused(Error::external(
                &self.layout.spec.id,
                "it forked a process that returned from its call, so two processes play one episode; \
                 end the child with os._exit in the environment",
            )));
        }
        self.frame_is_current = matches!(request, Request::Render | Request::StepAndRender);
        Ok(())
    }

    /// The request of a step, with a frame if steps render.
    fn step_request(&self) -> Request<'static> {
        if self.renders_steps { Request::StepAndRender } else { Request::Step }
    }

    /// Waits for the result of the dispatched call, if there is one, because another call follows.
    fn finish_dispatched(&mut self) -> Result<()> {
        match self.dispatched {
            None => Ok(()),
            Some(EnvCall::Reset) => self.run_reset(true),
            Some(_) => self.run_step(),
        }
    }

    /// Replaces the current episode with an episode without actions, and reuses the memory of the actions.
    fn start_episode(&mut self, reset: String, goal: Option<GoalFrame>) {
        let mut actions = self.episode.take().map(|episode| episode.actions).unwrap_or_default();
        actions.clear();
        self.episode = Some(Episode { reset, goal, actions });
        self.frame_is_current = false;
    }

    /// Makes the reset call of the episode and reads its factors; `checks` that the values are finite. At a recorded start, the bridge
    /// writes NaN where a goal is unknown.
    fn run_reset(&mut self, checks: bool) -> Result<()> {
        self.env_call(EnvCall::Reset)?;
        if checks {
            self.layout.finite.check(&self.layout, self.transport.memory());
        }
        let doubles = self.transport.memory()[self.layout.factors()].chunks_exact(size_of::<f64>());
        let values: Vec<f64> = doubles.map(bytemuck::pod_read_unaligned).collect();
        let space = &self.layout.spec.variation_space;
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

    /// Makes the step call of the last action of the episode.
    fn run_step(&mut self) -> Result<()> {
        self.frame_is_current = false;
        self.env_call(EnvCall::Step)?;
        self.layout.finite.check(&self.layout, self.transport.memory());
        Ok(())
    }

    /// Reads a double in the header of the buffer; 0 before the buffer exists.
    fn double(&self, at: usize) -> f64 {
        let bytes = self.transport.memory().get(at..at + 8);
        bytes.map_or(0.0, bytemuck::pod_read_unaligned)
    }

    /// Reads a flag in the header of the buffer; false before the buffer exists.
    fn flag(&self, at: usize) -> bool {
        self.transport.memory().get(at).is_some_and(|&byte| byte != 0)
    }
}

impl DispatchEnv for GymEnv {
    fn dispatch(&mut self, call: PendingCall<'_>) -> bool {
        if !self.transport.runs_in_parallel() || self.stage != Stage::Ready || self.dispatched.is_some() {
            return false;
        }
        match call {
            PendingCall::Reset(seed, options) => {
                let Ok(arguments) = reset_arguments(&self.layout, seed, options) else { return false };
                let arguments = arguments.to_string();
                if !self.transport.dispatch(Request::Reset(&arguments)) {
                    return false;
                }
                self.start_episode(arguments, None);
                self.dispatched = Some(EnvCall::Reset);
            }
            PendingCall::Step(action) => {
                let request = self.step_request();
                let (Some(episode), Ok(bytes)) = (&mut self.episode, self.layout.bytes(action)) else { return false };
                self.transport.memory_mut()[self.layout.action.clone()].copy_from_slice(bytes);
                if !self.transport.dispatch(request) {
                    return false;
                }
                episode.actions.extend_from_slice(bytes);
                self.dispatched = Some(EnvCall::Step);
            }
        }
        true
    }
}

impl DatasetStartEnv for GymEnv {
    fn required_columns(&self, stored: &Schema, callables: &[Callable]) -> Result<Vec<String>> {
        start::columns(&self.layout, stored, callables)
    }

    /// The callables and their arguments belong to the arguments of the reset, so a replay of the episode starts at the
    /// same state.
    fn reset_from(&mut self, seed: u64, options: &ResetOptions, from: DatasetStart<'_>) -> Result<()> {
        self.finish_dispatched()?;
        let (seed, options) = start::reset(&self.layout, seed, options, from.start)?;
        let mut arguments = reset_arguments(&self.layout, seed, &options)?;
        arguments["recorded"] = start::json(&self.layout, &from)?;
        self.start_episode(arguments.to_string(), GoalFrame::of(&from));
        self.run_reset(false)
    }
}

impl Env for GymEnv {
    fn spec(&self) -> &EnvSpec {
        &self.layout.spec
    }

    fn reset(&mut self, seed: u64, options: &ResetOptions) -> Result<()> {
        let arguments = reset_arguments(&self.layout, seed, options)?.to_string();
        let dispatched = self.dispatched == Some(EnvCall::Reset);
        if !dispatched || self.episode.as_ref().is_none_or(|episode| episode.reset != arguments) {
            self.finish_dispatched()?;
            self.start_episode(arguments, None);
        }
        self.run_reset(true)
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
        let bytes = self.layout.bytes(action)?;
        let dispatched = self.dispatched == Some(EnvCall::Step);
        if !dispatched || self.episode.as_ref().is_none_or(|episode| !episode.actions.ends_with(bytes)) {
            self.finish_dispatched()?;
            let Some(episode) = &mut self.episode else {
                return Err(Error::config(
                    &self.layout.spec.id,
                    "the environment was stepped outside an episode",
                    "reset it first",
                ));
            };
            episode.actions.extend_from_slice(bytes);
        }
        self.run_step()?;
        Ok(Transition {
            reward: self.double(header::REWARD),
            terminated: self.flag(header::TERMINATED),
            truncated: self.flag(header::TRUNCATED),
        })
    }

    fn observe(&self, row: &mut RowMut<'_>) {
        let memory = self.transport.memory();
        for (i, range) in self.layout.columns.iter().enumerate() {
            match memory.get(range.clone()) {
                Some(bytes) => row.bytes(i).copy_from_slice(bytes),
                None => row.bytes(i).fill(0),
            }
        }
    }

    fn render(&mut self, frame: FrameMut<'_>) -> Result<()> {
        let layout = Arc::clone(&self.layout);
        let Some(region) = layout.frame() else {
            return Err(Error::config(
                format!("frames of {}", layout.spec.id),
                layout.no_frame(),
                "run it without frames, or give it a render mode 'rgb_array'",
            ));
        };
        self.finish_dispatched()?;
        self.renders_steps = true;
        if !self.frame_is_current {
            if self.episode.is_none() {
                return Err(Error::config(
                    &layout.spec.id,
                    "the environment was rendered outside an episode",
                    "reset it first",
                ));
            }
            self.env_call(EnvCall::Render)?;
        }
        self.resizer.resize(
            &self.transport.memory()[region.range()],
            (region.size[0], region.size[1]),
            frame.rgb,
            (frame.height, frame.width),
        );
        Ok(())
    }

    /// Writes the frame of the goal's dataset row, else `info['goal']` of the reset, else black pixels.
    fn render_goal(&mut self, frame: FrameMut<'_>) -> Result<()> {
        self.finish_dispatched()?;
        match (self.layout.goal(), &self.episode) {
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
        self.layout.libraries().clone()
    }

    fn factors(&self) -> &FactorValues {
        &self.factors
    }

    /// The episode so far: the arguments of its reset, the frame of its goal, its actions.
    fn snapshot(&self) -> Snapshot {
        Episode::snapshot(self.episode.as_ref(), &self.layout.spec.id)
    }

    /// Replays the episode of the snapshot. If the current episode has the same reset and its actions are a prefix of
    /// the snapshot's actions, the replay continues the current episode.
    fn restore(&mut self, snapshot: &Snapshot) -> Result<()> {
        let id = &self.layout.spec.id;
        let Some(Episode { reset, goal, actions }) = Episode::parse(snapshot, id, self.layout.action.len()) else {
            return Err(Error::mismatch(
                format!("restoring {id}"),
                "a snapshot of another environment, or a snapshot from before the first reset",
                "a snapshot of an episode of this environment",
            ));
        };
        start::check_methods(&self.layout, &reset)?;
        self.finish_dispatched()?;
        let is_prefix = |now: &&Episode| now.reset == reset && now.goal == goal && actions.starts_with(&now.actions);
        let prefix = self.episode.as_ref().filter(is_prefix);
        let mut at = match prefix.map(|now| now.actions.len()) {
            Some(at) => at,
            None => {
                self.start_episode(reset, goal);
                self.run_reset(false)?;
                0
            }
        };
        while at < actions.len() {
            let next = at + self.layout.action.len();
            if let Some(episode) = &mut self.episode {
                episode.actions.extend_from_slice(&actions[at..next]);
            }
            self.run_step()?;
            at = next;
        }
        Ok(())
    }

    fn restore_from(&mut self, _: RowRef<'_>, _: RowRef<'_>) -> Result<()> {
        Err(Error::config(
            format!("starting {} from a row of a dataset", self.layout.spec.id),
            "the environment sets a state at a reset only",
            "start an episode at the row with `swm_core::dataset_start::reset`",
        ))
    }

    fn sample_goal(&mut self, _: Key) -> Result<()> {
        Err(Error::config(
            format!("a new goal of {}", self.layout.spec.id),
            "a Gymnasium environment samples its goal at a reset",
            "reset it with another seed",
        ))
    }

    fn is_success(&self) -> bool {
        self.flag(header::SUCCESS)
    }

    /// `info['goal_distance']`; infinite without that entry.
    fn goal_distance(&self) -> f64 {
        if self.episode.is_some() { self.double(header::DISTANCE) } else { f64::INFINITY }
    }
}
