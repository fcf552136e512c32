//! The thread of a live environment: it takes requests, steps at the chosen speed, and puts frames into the slot.

use super::messages::{Reply, Request};
use super::recorder::Recorder;
use super::{Frame, Kind, Out, Session, Setup, check_seed};
use crate::rendering::{Rendering, colours};
use crate::{Lab, still};
use serde_json::{Value, json};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::{Duration, Instant};
use swm_core::policy::write_action;
use swm_core::pool::Reset;
use swm_core::{Error, Key, Policy, ResetOptions, Result, Space, VariationRequest, columns, limits};
use swm_data::ImageCodec;
use swm_eval::{World, WorldConfig};

/// The quality of frames.
const QUALITY: u8 = 92;
/// Elements of a state that the page receives.
const MOST_STATE: usize = 32;
/// Steps a second before the page chooses.
const FPS: f64 = 30.0;
/// The fastest that a page may choose.
const FASTEST: f64 = 240.0;

/// A live environment.
pub struct Player<'a> {
    lab: &'a Lab,
    setup: Setup,
    world: World,
    policy: Option<Box<dyn Policy>>,
    /// The action of `hand`.
    hand: Vec<f64>,
    seed: u64,
    variation: VariationRequest,
    rendering: Rendering,
    playing: bool,
    interval: Duration,
    total: f64,
    number: u64,
    ended: bool,
    recorder: Option<Recorder>,
    out: Out,
}

impl Session for Player<'static> {
    type Request = Request;
    const IS_PLAN: bool = false;

    fn kind(request: &Request) -> Kind {
        match request {
            Request::Shown {} => Kind::Shown,
            Request::Act { .. } => Kind::Replaceable,
            _ => Kind::Ordered,
        }
    }

    fn play(lab: &Lab, setup: Setup, out: Out, requests: &Receiver<Request>) -> Result<()> {
        Player::new(lab, setup, out)?.run(requests);
        Ok(())
    }
}

impl<'a> Player<'a> {
    /// Makes the environment, and starts an episode.
    ///
    /// # Errors
    /// When the environment lacks assets, or the frame size is out of range.
    pub fn new(lab: &'a Lab, setup: Setup, out: Out) -> Result<Self> {
        limits::IMAGE_SIDE.check(setup.side)?;
        let rendering = Rendering::default();
        let world = world(lab, &setup, &rendering)?;
        let hand = at_rest(&world.spec().action_space);
        let mut player = Self {
            lab,
            setup,
            world,
            policy: None,
            hand,
            seed: 0,
            variation: VariationRequest::default(),
            rendering,
            playing: false,
            interval: Duration::from_secs_f64(1.0 / FPS),
            total: 0.0,
            number: 0,
            ended: false,
            recorder: None,
            out,
        };
        player.reset()?;
        Ok(player)
    }

    /// Plays until the page is gone.
    pub fn run(&mut self, requests: &Receiver<Request>) {
        let mut next = Instant::now();
        loop {
            let waited = if self.playing {
                requests.recv_timeout(next.saturating_duration_since(Instant::now()))
            } else {
                requests.recv().map_err(|_| RecvTimeoutError::Disconnected)
            };
            let outcome = match waited {
                Err(RecvTimeoutError::Disconnected) => return,
                Ok(request) => {
                    let was_playing = self.playing;
                    let outcome = self.handle(request);
                    if self.playing && !was_playing {
                        next = Instant::now();
                    }
                    outcome
                }
                Err(RecvTimeoutError::Timeout) => {
                    // A step that took too long delays the next ones instead of being caught up.
                    next = (next + self.interval).max(Instant::now());
                    self.step()
                }
            };
            if let Err(error) = outcome {
                self.playing = false;
                self.out.failed(&error);
                self.send_frame().ok();
            }
        }
    }

    fn handle(&mut self, request: Request) -> Result<()> {
        match request {
            Request::Reset { seed, pin, variation, view, wrappers, wrap_goal } => {
                let variation = still::request(&pin, variation.as_deref())?;
                self.world.spec().variation_space.check(&variation)?;
                check_seed(seed)?;
                self.render_as(Rendering::parse(view.as_deref(), &wrappers, wrap_goal)?)?;
                (self.seed, self.variation) = (seed, variation);
                self.reset()
            }
            Request::Play { on } => {
                self.playing = on && !self.ended;
                self.send_frame()
            }
            Request::Step {} => self.step(),
            Request::Speed { fps } => {
                if !(1.0..=FASTEST).contains(&fps) {
                    return Err(Error::config(
                        "speed",
                        fps.to_string(),
                        format!("choose 1 to {FASTEST} steps a second"),
                    ));
                }
                self.interval = Duration::from_secs_f64(1.0 / fps);
                Ok(())
            }
            Request::Drive { by } => self.drive(&by),
            Request::Act { action } => {
                let space = &self.world.spec().action_space;
                space.check("action", &action)?;
                self.hand = action;
                Ok(())
            }
            Request::Shown {} => Ok(()),
            Request::Record { dataset } => self.record(&dataset),
            Request::Keep {} => {
                let recorder = self.recorder.as_mut().ok_or_else(nothing_recorded)?;
                recorder.keep(&self.world)?;
                self.report_recording();
                Ok(())
            }
            Request::Discard {} => {
                self.recorder.as_mut().ok_or_else(nothing_recorded)?.discard();
                self.report_recording();
                Ok(())
            }
            Request::Finish {} => {
                let recorder = self.recorder.take().ok_or_else(nothing_recorded)?;
                self.end(recorder)?;
                self.send_frame()
            }
        }
    }

    /// Renders in this way from now on. What cannot be rendered leaves the environment as it is.
    fn render_as(&mut self, rendering: Rendering) -> Result<()> {
        if rendering == self.rendering {
            return Ok(());
        }
        if self.recorder.is_some() {
            let problem = "a recording has one camera view and one stack of wrappers";
            return Err(Error::config("the view", problem, "finish the recording first"));
        }
        let mut world = world(self.lab, &self.setup, &rendering)?;
        // Environments check camera views when they render.
        world.restart(&[Reset { slot: 0, seed: self.seed, options: ResetOptions::default() }])?;
        (self.world, self.rendering) = (world, rendering);
        Ok(())
    }

    /// Records from now on; another recording is ended. One into another dataset that cannot begin leaves the session as it is.
    fn record(&mut self, dataset: &str) -> Result<()> {
        let no_folder = || Error::config("recording", "the lab has no folder of datasets", "set STABLEWM_HOME");
        let folder = self.lab.datasets.paths().first().ok_or_else(no_folder)?;
        let settings = self.settings()?;
        // One writer has a dataset at a time.
        if let Some(same) = self.recorder.take_if(|recorder| recorder.name() == dataset) {
            self.end(same)?;
        }
        let started = Recorder::start(folder, dataset, &self.world, &settings)?;
        let ended = self.recorder.replace(started).map_or(Ok(()), Recorder::finish);
        let reset = self.reset();
        ended.and(reset)
    }

    /// Ends a recording, and tells the page.
    fn end(&self, recorder: Recorder) -> Result<()> {
        let episodes = recorder.episodes();
        let ended = recorder.finish();
        self.out.reply(&Reply::Recording { dataset: None, episodes, rows: 0, complete: false });
        ended
    }

    /// What the manifest of a recording says of its wrappers.
    fn settings(&self) -> Result<serde_json::Map<String, Value>> {
        let Rendering { wrappers, wrap_goal, .. } = &self.rendering;
        let mut settings = serde_json::Map::new();
        if !wrappers.is_empty() {
            settings.insert("wrappers".to_owned(), self.lab.wrapping.manifest(wrappers)?);
            settings.insert("wrap_goal".to_owned(), json!(wrap_goal));
        }
        Ok(settings)
    }

    fn report_recording(&self) {
        if let Some(recorder) = &self.recorder {
            self.out.reply(&Reply::Recording {
                dataset: Some(recorder.name().to_owned()),
                episodes: recorder.episodes(),
                rows: recorder.rows(),
                complete: recorder.is_complete(),
            });
        }
    }

    /// Chooses the policy. `hand` is no policy.
    fn drive(&mut self, by: &str) -> Result<()> {
        if by == "hand" {
            // An action that arrived before stays: the page takes over with it.
            self.policy = None;
            return Ok(());
        }
        self.policy = Some((self.lab.policy)(&self.setup.env.entry, by, &self.world)?);
        self.hand = at_rest(&self.world.spec().action_space);
        self.begin_policy();
        Ok(())
    }

    fn begin_policy(&mut self) {
        if let Some(policy) = &mut self.policy {
            policy.begin(0, Key::new(self.seed));
        }
    }

    /// Starts the episode of the seed and the factors.
    fn reset(&mut self) -> Result<()> {
        let options = ResetOptions { variation: self.variation.clone(), ..ResetOptions::default() };
        self.world.restart(&[Reset { slot: 0, seed: self.seed, options }])?;
        (self.total, self.ended) = (0.0, false);
        self.begin_policy();
        if let Some(recorder) = &mut self.recorder {
            recorder.begin(&self.world, self.seed);
        }
        let (spec, side) = (self.world.spec(), self.setup.side);
        let still = still::Still {
            seed: self.seed,
            variation: self.variation.clone(),
            goal: false,
            size: (side, side),
            rendering: self.rendering.clone(),
        };
        let factors = self.world.pool().env(0).factors();
        self.out.reply(&Reply::Started {
            seed: self.seed,
            factors: factors.iter().map(|(key, value)| (key.to_owned(), json!(value))).collect(),
            command: still.command(spec)?,
            python: still.python(spec)?,
        });
        self.report_recording();
        self.send_frame()
    }

    /// One step of the policy or of the hand.
    fn step(&mut self) -> Result<()> {
        if self.ended {
            self.playing = false;
            return self.send_frame();
        }
        match &mut self.policy {
            Some(policy) => self.world.act(&mut **policy, &[true])?,
            None => write_action(&mut self.world.actions_mut().row_mut(0), 0, &self.hand),
        }
        let actions = self.recorder.as_ref().map(|_| self.world.actions_mut().clone());
        self.world.advance(&[true])?;
        let row = self.world.pool().infos().row(0);
        let value = |name| row.to_f64(name).map(|values| values.first().copied().unwrap_or_default());
        self.total += value(columns::REWARD)?;
        self.ended = value(columns::TERMINATED)? > 0.0 || value(columns::TRUNCATED)? > 0.0;
        self.playing &= !self.ended;
        if let (Some(recorder), Some(actions)) = (&mut self.recorder, actions) {
            recorder.step(&self.world, &actions, self.ended)?;
            if self.ended {
                self.report_recording();
            }
        }
        self.send_frame()
    }

    /// Puts the present frame into the slot.
    fn send_frame(&mut self) -> Result<()> {
        self.number += 1;
        let header = self.header()?.to_string();
        let infos = self.world.pool().infos();
        let column = infos.schema().index(&self.rendering.column())?;
        let pixels = colours(&infos.schema().columns()[column], infos.bytes(column));
        let mut bytes = u32::try_from(header.len()).unwrap_or_default().to_le_bytes().to_vec();
        bytes.extend(header.as_bytes());
        ImageCodec::Jpeg { quality: QUALITY }.encode(&pixels, self.setup.side, self.setup.side, &mut bytes)?;
        self.out.frames.send_replace(Arc::new(Frame { bytes }));
        Ok(())
    }

    /// What the page shows beside the frame.
    fn header(&self) -> Result<Value> {
        let row = self.world.pool().infos().row(0);
        let mut state = row.to_f64(columns::STATE)?;
        state.truncate(MOST_STATE);
        let value = |name| row.to_f64(name).map(|values| values.first().copied().unwrap_or_default());
        Ok(json!({
            "number": self.number,
            "step": value(columns::STEP_IDX)?,
            "reward": value(columns::REWARD)?,
            "total": self.total,
            "success": self.world.pool().env(0).is_success(),
            (columns::TERMINATED): value(columns::TERMINATED)? > 0.0,
            (columns::TRUNCATED): value(columns::TRUNCATED)? > 0.0,
            "playing": self.playing,
            "recorded": self.recorder.as_ref().map(Recorder::rows),
            "state": state,
        }))
    }
}

/// Makes the environment that is shown in this way.
fn world(lab: &Lab, setup: &Setup, rendering: &Rendering) -> Result<World> {
    let config = WorldConfig {
        envs: 1,
        image: Some((setup.side, setup.side)),
        views: rendering.views(),
        threads: lab.threads,
        ..WorldConfig::default()
    };
    World::of(|| rendering.env(&setup.env, &*lab.wrapping), config)
}

/// The error of a request about a recording when there is none.
fn nothing_recorded() -> Error {
    Error::config("recording", "nothing is recorded", "choose a dataset to record into first")
}

/// The action that changes least: zero where a box has it, else the middle of the box; the first choice.
fn at_rest(space: &Space) -> Vec<f64> {
    let element = |i| {
        let (low, high) = space.bounds(i);
        match space {
            Space::Box { .. } if (low <= 0.0 && high >= 0.0) || !(high - low).is_finite() => 0.0_f64.clamp(low, high),
            Space::Box { .. } => f64::midpoint(low, high),
            _ => low,
        }
    };
    (0..space.len()).map(element).collect()
}
