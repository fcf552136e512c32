//! [`Wrapped`]: an environment whose frames pass through visual wrappers, and [`Stack`], which wraps environments.

use super::{EpisodeFrame, VisualWrapper, parse};
use std::collections::BTreeMap;
use swm_core::{
    Action, Callable, CameraView, DatasetStart, DatasetStartEnv, DispatchEnv, Env, EnvSpec, Error, FactorValues,
    FrameMut, Key, Modality, ResetOptions, Result, RowMut, RowRef, Schema, Snapshot, Transition, dataset_start, limits,
};

/// The treatment of the goal frame by wrappers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum GoalFrame {
    /// The goal frame stays unchanged, as in the reference, whose wrappers change only the frames of steps. This is the
    /// default, so that results are comparable with the reference's.
    #[default]
    Clean,
    /// The goal frame is changed like every other frame, so that start and goal differ only by the state.
    Wrapped,
}

/// Wrappers in the order in which they are applied, for any number of environments.
#[derive(Default)]
pub struct Stack(Vec<Box<dyn VisualWrapper>>);

impl Stack {
    /// Makes a stack of wrappers.
    ///
    /// # Errors
    /// When there are too many, or the error of a wrapper.
    pub fn new(wrappers: impl ExactSizeIterator<Item = Result<Box<dyn VisualWrapper>>>) -> Result<Self> {
        limits::WRAPPERS.check(wrappers.len())?;
        wrappers.collect::<Result<_>>().map(Self)
    }

    /// Reads wrappers in command-line form, such as `noise,std=8`. Files are read once for all environments.
    ///
    /// # Errors
    /// When a wrapper or a parameter is unknown, a value is not allowed, or a file cannot be read.
    pub fn parse<S: AsRef<str>>(texts: &[S]) -> Result<Self> {
        Self::new(texts.iter().map(|text| parse(text.as_ref())))
    }

    /// Returns whether the stack has no wrappers.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Wraps an environment; an empty stack returns it unchanged.
    pub fn wrap(&self, env: Box<dyn Env>, goal: GoalFrame) -> Box<dyn Env> {
        if self.is_empty() {
            return env;
        }
        Box::new(Wrapped::new(env, self.0.iter().map(|wrapper| wrapper.fork()).collect(), goal))
    }
}

/// An environment whose frames pass through wrappers, first to last. Everything but the frames is unchanged.
///
/// Steps are counted from the last reset or [`Env::restore_from`]; randomness comes from the seed of the last reset.
/// Both are part of the snapshot.
pub struct Wrapped {
    env: Box<dyn Env>,
    wrappers: Vec<Box<dyn VisualWrapper>>,
    goal: GoalFrame,
    seed: u64,
    step: u64,
}

impl Wrapped {
    /// Wraps an environment.
    pub fn new(env: Box<dyn Env>, wrappers: Vec<Box<dyn VisualWrapper>>, goal: GoalFrame) -> Self {
        let mut wrapped = Self { env, wrappers, goal, seed: 0, step: 0 };
        wrapped.begin(0, 0);
        wrapped
    }

    /// Starts the wrappers' episode of a seed, and sets the number of steps taken in it.
    fn begin(&mut self, seed: u64, step: u64) {
        (self.seed, self.step) = (seed, step);
        let episode = Key::new(seed).with("wrapper");
        for (wrapper, index) in self.wrappers.iter_mut().zip(0..) {
            wrapper.reset(episode.at(index));
        }
    }

    fn apply(&mut self, frame: &mut FrameMut<'_>, which: EpisodeFrame) {
        for wrapper in &mut self.wrappers {
            wrapper.apply(frame, which);
        }
    }

    /// Returns the bytes with which snapshots of this stack of wrappers begin.
    fn tag(&self) -> Vec<u8> {
        let ids: Vec<&str> = self.wrappers.iter().map(|wrapper| wrapper.id()).collect();
        format!("wrapped[{}]", ids.join(",")).into_bytes()
    }
}

impl DatasetStartEnv for Wrapped {
    fn required_columns(&self, stored: &Schema, callables: &[Callable]) -> Result<Vec<String>> {
        dataset_start::required_columns(&*self.env, stored, callables)
    }

    fn reset_from(&mut self, seed: u64, options: &ResetOptions, from: DatasetStart<'_>) -> Result<()> {
        dataset_start::reset(&mut *self.env, seed, options, from)?;
        self.begin(seed, 0);
        Ok(())
    }
}

impl Env for Wrapped {
    fn spec(&self) -> &EnvSpec {
        self.env.spec()
    }

    fn reset(&mut self, seed: u64, options: &ResetOptions) -> Result<()> {
        self.env.reset(seed, options)?;
        self.begin(seed, 0);
        Ok(())
    }

    fn step(&mut self, action: Action<'_>) -> Result<Transition> {
        let transition = self.env.step(action)?;
        self.step += 1;
        Ok(transition)
    }

    fn as_dispatch(&mut self) -> Option<&mut dyn DispatchEnv> {
        self.env.as_dispatch()
    }

    fn dataset_start(&self) -> Option<&dyn DatasetStartEnv> {
        Some(self)
    }

    fn dataset_start_mut(&mut self) -> Option<&mut dyn DatasetStartEnv> {
        Some(self)
    }

    fn observe(&self, row: &mut RowMut<'_>) {
        self.env.observe(row);
    }

    fn render(&mut self, mut frame: FrameMut<'_>) -> Result<()> {
        self.env.render(FrameMut { rgb: &mut *frame.rgb, ..frame })?;
        self.apply(&mut frame, EpisodeFrame::Step(self.step));
        Ok(())
    }

    fn render_goal(&mut self, mut frame: FrameMut<'_>) -> Result<()> {
        self.env.render_goal(FrameMut { rgb: &mut *frame.rgb, ..frame })?;
        if self.goal == GoalFrame::Wrapped {
            self.apply(&mut frame, EpisodeFrame::Goal);
        }
        Ok(())
    }

    /// Wrappers change the colours of every camera, and neither depth nor segmentation.
    fn render_view(&mut self, view: &CameraView, height: usize, width: usize, out: &mut [u8]) -> Result<()> {
        self.env.render_view(view, height, width, out)?;
        if view.modality == Modality::Rgb {
            self.apply(&mut FrameMut::new(width, height, out), EpisodeFrame::Step(self.step));
        }
        Ok(())
    }

    fn libraries(&self) -> BTreeMap<String, String> {
        self.env.libraries()
    }

    fn constants(&self) -> BTreeMap<String, Vec<u8>> {
        self.env.constants()
    }

    fn factors(&self) -> &FactorValues {
        self.env.factors()
    }

    fn snapshot(&self) -> Snapshot {
        let mut bytes = self.tag();
        bytes.extend(self.seed.to_le_bytes());
        bytes.extend(self.step.to_le_bytes());
        bytes.extend(self.env.snapshot().0);
        Snapshot(bytes)
    }

    fn restore(&mut self, snapshot: &Snapshot) -> Result<()> {
        let tag = self.tag();
        let body = snapshot.0.strip_prefix(&tag[..]).and_then(|rest| rest.split_at_checked(16));
        let Some((counters, inner)) = body else {
            return Err(Error::mismatch(
                "restoring a snapshot",
                "a snapshot of an environment without wrappers or with other wrappers",
                format!("a snapshot of {} with {}", self.spec().id, String::from_utf8_lossy(&tag)),
            ));
        };
        self.env.restore(&Snapshot(inner.to_vec()))?;
        let [seed, step] = [0, 1].map(|i| u64::from_le_bytes(counters.as_chunks().0[i]));
        self.begin(seed, step);
        Ok(())
    }

    fn restore_from(&mut self, start: RowRef<'_>, goal: RowRef<'_>) -> Result<()> {
        self.env.restore_from(start, goal)?;
        self.step = 0;
        Ok(())
    }

    fn sample_goal(&mut self, key: Key) -> Result<()> {
        self.env.sample_goal(key)
    }

    fn is_success(&self) -> bool {
        self.env.is_success()
    }

    fn goal_distance(&self) -> f64 {
        self.env.goal_distance()
    }

    fn success_distance(&self) -> f64 {
        self.env.success_distance()
    }
}
