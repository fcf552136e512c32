//! [`World`]: what all environments of this crate share, around the [`Task`] that tells them apart.
//!
//! A world owns its model and state ([`Physics`]), the factors of its episode, and its picture; a task edits the model,
//! begins episodes, steps, rewards, and knows the goal. What a task remembers beyond the physics (a goal, a score) is a
//! list of numbers, so that states, snapshots and dataset rows are made in one place.
//!
//! The `state` column holds the physics (time, `qpos`, `qvel`, `act`, `qacc_warmstart`, `ctrl`, `eq_active`, `mocap_pos`,
//! `mocap_quat`) and then the task's memory: enough to go on from.

use crate::render::{self, Camera, Picture, Stage};
use crate::{Physics, link};
use mujoco_rs::wrappers::MjModel;
use mujoco_rs::wrappers::mj_model::MjtObjBase;
use std::collections::BTreeMap;
use std::sync::Arc;
use swm_core::{
    Action, ColumnSpec, DType, Env, EnvSpec, Error, FactorValues, FrameMut, Key, Modality, ResetOptions, Result,
    RowMut, RowRef, Snapshot, Transition, VariationRequest, View, factors,
};

/// The place of a task's first column. Before it stand `state` and `unstable`.
pub(crate) const FIRST: usize = 2;

/// What one control step brought.
pub(crate) struct Step {
    /// The reward.
    pub reward: f64,
    /// The task is done, or cannot be done any more.
    pub terminated: bool,
}

/// What makes a world this one. Coordinates and columns are the task's own affair.
pub(crate) trait Task: Send {
    /// Makes the model that of these factors. It comes as it was compiled, unless [`Task::overwrites`];
    /// [`Physics::replace_model`] takes another one where an edit of the model is not enough. Not called again while factors stay the same.
    fn arrange(&mut self, physics: &mut Physics, factors: &FactorValues) -> Result<()>;

    /// Whether [`Task::arrange`] sets every number of the model that the task ever edits. If so, the model is not put back first,
    /// which takes long where it has many meshes.
    fn overwrites(&self) -> bool {
        false
    }

    /// What a reset asks for, before [`Task::start`]: for tasks that draw what nobody asks for.
    fn heed(&mut self, _asked: &VariationRequest) {}

    /// Begins an episode. The state is the model's initial one ([`Physics::reset`]), and must be settled (forward) on return.
    fn start(&mut self, physics: &mut Physics, factors: &FactorValues, key: Key) -> Result<()>;

    /// Applies one action, whose numbers are finite.
    fn step(&mut self, physics: &mut Physics, action: &[f32]) -> Step;

    /// Writes the task's columns, from [`FIRST`] on.
    fn observe(&self, physics: &Physics, row: &mut RowMut<'_>);

    /// Numbers of [`Task::remember`], the same for all episodes.
    fn memory_len(&self, model: &MjModel) -> usize;

    /// Writes what the task knows beyond the physics: its goal, its score.
    fn remember(&self, into: &mut [f64]);

    /// Takes back what it remembered. The model is that of the factors; the state is not there yet.
    fn recall(&mut self, physics: &mut Physics, memory: &[f64]);

    /// Numbers of [`Task::remember_goal`].
    fn goal_len(&self) -> usize {
        0
    }

    /// Writes the goal: with it, snapshots go on towards the goal they were taken with. The `state` column does without, as a
    /// state is the same wherever one wants to go.
    fn remember_goal(&self, _into: &mut [f64]) {}

    /// Takes back the goal it remembered.
    fn recall_goal(&mut self, _goal: &[f64]) {}

    /// Takes its goal from a state somewhere else: numbers of [`Physics::state`], and the memory there. It may put that state to
    /// look at it: the world puts the present one back.
    fn aim(&mut self, physics: &mut Physics, state: &[f64], memory: &[f64]) -> Result<()>;

    /// Takes a goal in words of its own, such as a place, where these are ones; the world puts the state back.
    fn aim_at(&mut self, _physics: &mut Physics, _goal: &[f64]) -> Option<Result<()>> {
        None
    }

    /// Chooses a reachable goal that is not reached. It may use the physics to find one: the world puts the state back.
    fn sample_goal(&mut self, physics: &mut Physics, key: Key) -> Result<()>;

    /// Puts the world where the goal is reached, for a picture: the world puts the state back.
    fn show_goal(&mut self, physics: &mut Physics);

    /// Makes the model show the goal and what the task remembers, for a state of the physics that is about to be put back: after
    /// a goal was taken, chosen, recalled or shown. The physics' own state may be anything afterwards.
    fn mark_goal(&mut self, _physics: &mut Physics, _state: &[f64]) {}

    /// Whether the goal is reached now.
    fn is_success(&self, physics: &Physics) -> bool;

    /// How far from the goal; 0 there.
    fn goal_distance(&self, physics: &Physics) -> f64;

    /// Through which camera one sees it, of those of the model.
    fn camera(&self) -> Camera;
}

/// An environment: a [`Task`] in its physics.
pub(crate) struct World<T> {
    spec: EnvSpec,
    physics: Physics,
    task: T,
    factors: FactorValues,
    /// Cameras by name.
    cameras: Vec<(String, Camera)>,
    stage: Option<Box<Stage>>,
    /// Reused for states put back after a goal was shown or sampled.
    scratch: Vec<f64>,
}

impl<T: Task> World<T> {
    /// The world with every factor at its default, at the start of the episode of seed 0. `spec` lists the task's columns;
    /// `state` and `unstable` are put before them, and the model's cameras are added.
    ///
    /// # Errors
    /// When the model cannot be copied or arranged.
    pub fn new(mut spec: EnvSpec, model: Arc<MjModel>, mut task: T) -> Result<Self> {
        let mut physics = Physics::new(model)?;
        let none = VariationRequest { variation: Some(vec![]), ..VariationRequest::default() };
        let factors = spec.variation_space.resolve(&none, Key::new(0))?;
        task.arrange(&mut physics, &factors)?;
        let state = physics.state_len() + task.memory_len(physics.model());
        let own = [ColumnSpec::new("state", DType::Float64, [state]), ColumnSpec::new("unstable", DType::Bool, [])];
        spec.columns.splice(..0, own);
        let cameras = cameras(physics.model(), task.camera());
        spec.cameras = cameras.iter().map(|(name, _)| name.clone()).collect();
        let mut world = Self { spec, physics, task, factors, cameras, stage: None, scratch: vec![] };
        world.begin(0)?;
        Ok(world)
    }

    /// Begins an episode with the present factors.
    fn begin(&mut self, seed: u64) -> Result<()> {
        self.physics.reset();
        self.task.start(&mut self.physics, &self.factors, Key::new(seed).with("start"))
    }

    /// Makes the model that of these factors.
    fn arrange(&mut self, factors: FactorValues) -> Result<()> {
        if factors.iter().eq(self.factors.iter()) {
            return Ok(());
        }
        if !self.task.overwrites() {
            self.physics.restore_model();
        }
        self.task.arrange(&mut self.physics, &factors)?;
        self.factors = factors;
        Ok(())
    }

    /// Numbers of the `state` column.
    fn state_len(&self) -> usize {
        self.spec.columns[0].len()
    }

    /// Parts a state into physics and memory. `qpos` and `qvel` alone are enough for the physics; the rest of it then is
    /// `None`, and so is the memory.
    fn parts<'a>(&self, what: &str, state: &'a [f64]) -> Result<(Option<&'a [f64]>, &'a [f64])> {
        let (physics, pose) = (self.physics.state_len(), self.physics.pose_len());
        match state.len() {
            n if n == self.state_len() => Ok((Some(&state[physics..]), &state[..physics])),
            n if n == pose => Ok((None, state)),
            n => Err(Error::mismatch(
                format!("taking a {what}"),
                format!("{n} numbers"),
                format!("{} (the `state` column) or {pose} (qpos and qvel)", self.state_len()),
            )),
        }
    }

    /// Puts a state that somebody asks for.
    fn put(&mut self, state: &[f64]) -> Result<()> {
        let (memory, physics) = self.parts("state", state)?;
        match memory {
            Some(memory) => {
                finite("a state", memory)?;
                self.task.recall(&mut self.physics, memory);
                self.task.mark_goal(&mut self.physics, physics);
                self.physics.set_state(physics)
            }
            None => self.physics.set_pose(physics),
        }
    }

    /// Takes the goal from a state that somebody asks for.
    fn aim(&mut self, goal: &[f64]) -> Result<()> {
        finite("a goal state", goal)?;
        if ![self.state_len(), self.physics.pose_len()].contains(&goal.len())
            && let Some(aimed) = self.aside(|task, world, _| task.aim_at(world, goal))?
        {
            return aimed;
        }
        let (memory, physics) = self.parts("goal state", goal)?;
        if let Some(memory) = memory {
            return self.aside(|task, world, _| task.aim(world, physics, memory))?;
        }
        // The rest of the state is the present one.
        let mut state = vec![0.0; self.state_len()];
        let (now, memory) = state.split_at_mut(self.physics.state_len());
        self.physics.state(now);
        now[1..=physics.len()].copy_from_slice(physics);
        self.task.remember(memory);
        self.aside(|task, world, _| task.aim(world, now, memory))?
    }

    /// Does something with the physics and puts its state back.
    fn aside<R>(&mut self, act: impl FnOnce(&mut T, &mut Physics, &mut Option<Box<Stage>>) -> R) -> Result<R> {
        let mut scratch = std::mem::take(&mut self.scratch);
        scratch.clear();
        self.physics.save(&mut scratch);
        let done = act(&mut self.task, &mut self.physics, &mut self.stage);
        self.task.mark_goal(&mut self.physics, Physics::saved_state(&scratch));
        let back = self.physics.load(&scratch);
        self.scratch = scratch;
        back.map(|()| done)
    }
}

/// The cameras of a model by name, the default one first, the free one last.
fn cameras(model: &MjModel, default: Camera) -> Vec<(String, Camera)> {
    let count = usize::try_from(model.ncam()).unwrap_or(0);
    let name = |place| {
        model.id_to_name(MjtObjBase::mjOBJ_CAMERA, place).map_or_else(|| format!("camera{place}"), str::to_owned)
    };
    let mut all: Vec<_> = (0..count).map(|place| (name(place), Camera::Fixed(place))).collect();
    all.push(("free".to_owned(), Camera::Free));
    match all.iter().position(|(_, camera)| *camera == default) {
        Some(first) => all[..=first].rotate_right(1),
        None => all.insert(0, ("default".to_owned(), default)),
    }
    all
}

/// Refuses numbers that are not finite.
fn finite(what: &str, numbers: &[f64]) -> Result<()> {
    match numbers.iter().position(|number| !number.is_finite()) {
        None => Ok(()),
        Some(place) => Err(Error::NotFinite {
            what: what.to_owned(),
            given: format!("{} at place {place}", numbers[place]),
            fix: "take it from the `state` column of a recorded row".to_owned(),
        }),
    }
}

impl<T: Task> Env for World<T> {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn reset(&mut self, seed: u64, options: &ResetOptions) -> Result<()> {
        self.arrange(self.spec.variation_space.resolve(&options.variation, Key::new(seed))?)?;
        self.task.heed(&options.variation);
        self.begin(seed)?;
        if let Some(state) = &options.state {
            self.put(state)?;
        }
        match &options.goal_state {
            Some(goal) => self.aim(goal),
            None => Ok(()),
        }
    }

    fn step(&mut self, action: Action<'_>) -> Result<Transition> {
        let action = action.continuous(self.spec.action_dim())?;
        let Step { reward, terminated } = self.task.step(&mut self.physics, action);
        // Where the numbers ran away, the rest of the episode would be of another one.
        let terminated = terminated || self.physics.is_unstable();
        Ok(Transition { reward, terminated, truncated: false })
    }

    fn observe(&self, row: &mut RowMut<'_>) {
        let state = row.at::<f64>(0);
        let (physics, memory) = state.split_at_mut(self.physics.state_len());
        self.physics.state(physics);
        self.task.remember(memory);
        row.set(1, &[u8::from(self.physics.is_unstable())]);
        self.task.observe(&self.physics, row);
    }

    fn render(&mut self, frame: FrameMut<'_>) -> Result<()> {
        let size = (frame.width, frame.height);
        render::draw(&mut self.stage, &mut self.physics, self.task.camera(), size, Picture::Rgb(frame.rgb))
    }

    fn render_goal(&mut self, frame: FrameMut<'_>) -> Result<()> {
        let size = (frame.width, frame.height);
        self.aside(|task, physics, stage| {
            task.show_goal(physics);
            render::draw(stage, physics, task.camera(), size, Picture::Rgb(frame.rgb))
        })?
    }

    fn render_view(&mut self, view: &View, height: usize, width: usize, out: &mut [u8]) -> Result<()> {
        let camera = match &view.camera {
            None => self.task.camera(),
            Some(name) => {
                self.cameras.iter().find(|(known, _)| known == name).ok_or_else(|| view.unknown(&self.spec))?.1
            }
        };
        let numbers = |_| Error::mismatch("drawing a view", "bytes that are no numbers of 4 bytes", "a column's row");
        let picture = match view.modality {
            Modality::Rgb => Picture::Rgb(out),
            Modality::Depth => Picture::Depth(bytemuck::try_cast_slice_mut(out).map_err(numbers)?),
            Modality::Segmentation => Picture::Segmentation(bytemuck::try_cast_slice_mut(out).map_err(numbers)?),
        };
        render::draw(&mut self.stage, &mut self.physics, camera, (width, height), picture)
    }

    fn libraries(&self) -> BTreeMap<String, String> {
        let mut libraries = BTreeMap::from([("mujoco".to_owned(), link::VERSION.to_owned())]);
        // What would draw: whoever works from states leaves it out.
        if let Ok(name) = render::name() {
            libraries.insert("renderer".to_owned(), name);
        }
        libraries
    }

    fn factors(&self) -> &FactorValues {
        &self.factors
    }

    fn snapshot(&self) -> Snapshot {
        let mut numbers = Vec::with_capacity(self.physics.saved_len() + self.state_len());
        self.physics.save(&mut numbers);
        let mut memory = vec![0.0; self.state_len() - self.physics.state_len() + self.task.goal_len()];
        let (head, goal) = memory.split_at_mut(self.state_len() - self.physics.state_len());
        self.task.remember(head);
        self.task.remember_goal(goal);
        numbers.extend(memory);
        factors::snapshot(&self.spec.id, &self.factors, numbers.into_iter().flat_map(f64::to_le_bytes))
    }

    fn restore(&mut self, snapshot: &Snapshot) -> Result<()> {
        let (changed, bytes) = factors::restored(&self.spec.id, &self.spec.variation_space, &self.factors, snapshot)?;
        let saved = self.physics.saved_len();
        let (numbers, rest) = bytes.as_chunks();
        let memory = self.state_len() - self.physics.state_len();
        let expected = saved + memory + self.task.goal_len();
        if numbers.len() != expected || !rest.is_empty() {
            return Err(factors::foreign(&self.spec.id, format!("{} bytes of state", bytes.len())));
        }
        self.scratch.clear();
        self.scratch.extend(numbers.iter().map(|&number| f64::from_le_bytes(number)));
        if let Some(factors) = changed {
            self.arrange(factors)?;
        }
        let (physics, rest) = self.scratch.split_at(saved);
        let (memory, goal) = rest.split_at(memory);
        self.task.recall(&mut self.physics, memory);
        self.task.recall_goal(goal);
        self.task.mark_goal(&mut self.physics, Physics::saved_state(physics));
        self.physics.load(physics)
    }

    fn restore_from(&mut self, start: RowRef<'_>, goal: RowRef<'_>) -> Result<()> {
        let (state, goal) = (start.to_f64("state")?, goal.to_f64("state")?);
        self.arrange(factors::from_row(&self.spec.variation_space, &self.factors, start)?)?;
        self.put(&state)?;
        self.aim(&goal)
    }

    fn sample_goal(&mut self, key: Key) -> Result<()> {
        self.aside(|task, physics, _| task.sample_goal(physics, key))?
    }

    fn is_success(&self) -> bool {
        self.task.is_success(&self.physics)
    }

    fn goal_distance(&self) -> f64 {
        self.task.goal_distance(&self.physics)
    }
}
