//! [`MujocoEnv`]: the environment shared by all families of this crate, around a [`Task`].
//!
//! The environment owns the model and its state ([`Physics`]), the factors of the episode, and the renderer's scene;
//! the task edits the model, starts episodes, applies actions, computes rewards, and stores the goal.
//!
//! The `state` column contains the state of the physics (time, `qpos`, `qvel`, `act`, `qacc_warmstart`, `ctrl`,
//! `eq_active`, `mocap_pos`, `mocap_quat`) followed by the task state. An episode can continue from a recorded `state`.

use crate::physics::check_finite;
use crate::render::{self, AbstractScene, Camera, FrameBuffer};
use crate::task::{StepOutcome, Task};
use crate::{Physics, link};
use mujoco_rs::wrappers::MjModel;
use mujoco_rs::wrappers::mj_model::MjtObjBase;
use std::collections::BTreeMap;
use std::sync::Arc;
use swm_core::{
    Action, CameraView, ColumnSpec, DType, Env, EnvSpec, Error, FactorValues, FrameMut, Key, Modality, ResetOptions,
    Result, RowMut, RowRef, Snapshot, Transition, VariationRequest, columns, factors,
};

/// An environment that runs a [`Task`] in MuJoCo.
pub(crate) struct MujocoEnv<T> {
    spec: EnvSpec,
    physics: Physics,
    task: T,
    factors: FactorValues,
    /// The cameras of the model by name. The default camera is the first.
    cameras: Vec<(String, Camera)>,
    /// Allocated at the first rendering.
    scene: Option<Box<AbstractScene>>,
    /// Memory for the state that is restored after a goal was rendered or sampled; reused.
    scratch: Vec<f64>,
}

impl<T: Task> MujocoEnv<T> {
    /// Creates the environment with every factor at its default, at the start of the episode of seed 0. `spec` lists
    /// the task's columns; `state` and `unstable` are inserted before them, and the model's cameras are added.
    ///
    /// # Errors
    /// When the model cannot be copied or edited.
    pub fn new(mut spec: EnvSpec, model: Arc<MjModel>, mut task: T) -> Result<Self> {
        let mut physics = Physics::new(model)?;
        let none = VariationRequest { variation: Some(vec![]), ..VariationRequest::default() };
        let factors = spec.variation_space.resolve(&none, Key::new(0))?;
        task.apply_factors(&mut physics, &factors)?;
        let state = physics.state_len() + task.task_state_len(physics.model());
        let shared =
            [ColumnSpec::new(columns::STATE, DType::Float64, [state]), ColumnSpec::new("unstable", DType::Bool, [])];
        spec.columns.splice(..0, shared);
        let cameras = cameras(physics.model(), task.camera());
        spec.cameras = cameras.iter().map(|(name, _)| name.clone()).collect();
        let mut env = Self { spec, physics, task, factors, cameras, scene: None, scratch: vec![] };
        env.start_episode(0)?;
        Ok(env)
    }

    /// Starts an episode with the present factors.
    fn start_episode(&mut self, seed: u64) -> Result<()> {
        self.physics.reset();
        self.task.start(&mut self.physics, &self.factors, Key::new(seed).with("start"))
    }

    /// Edits the model for these factors, unless they equal the present factors.
    fn apply_factors(&mut self, factors: FactorValues) -> Result<()> {
        if factors.iter().eq(self.factors.iter()) {
            return Ok(());
        }
        if !self.task.overwrites_edits() {
            self.physics.restore_model();
        }
        self.task.apply_factors(&mut self.physics, &factors)?;
        self.factors = factors;
        Ok(())
    }

    /// The length of the `state` column.
    fn state_len(&self) -> usize {
        self.spec.columns[0].len()
    }

    /// Splits a state into the task state and the state of the physics. The task state is `None` if `state` contains
    /// only `qpos` and `qvel`. `what` names the state in errors.
    fn split_state<'a>(&self, what: &str, state: &'a [f64]) -> Result<(Option<&'a [f64]>, &'a [f64])> {
        let (physics, pose) = (self.physics.state_len(), self.physics.pose_len());
        match state.len() {
            n if n == self.state_len() => Ok((Some(&state[physics..]), &state[..physics])),
            n if n == pose => Ok((None, state)),
            n => Err(Error::mismatch(
                format!("setting a {what}"),
                format!("{n} values"),
                format!("{} (the `state` column) or {pose} (qpos and qvel)", self.state_len()),
            )),
        }
    }

    /// Sets a state given by the caller: a `state` column, or `qpos` and `qvel`.
    fn set_state(&mut self, state: &[f64]) -> Result<()> {
        let (task_state, physics) = self.split_state("state", state)?;
        match task_state {
            Some(task_state) => {
                check_finite("a state", task_state)?;
                self.task.load_task_state(&mut self.physics, task_state);
                self.task.update_markers(&mut self.physics, physics);
                self.physics.set_state(physics)
            }
            None => self.physics.set_pose(physics),
        }
    }

    /// Sets the goal to a state given by the caller, or from other values that the task accepts, such as a position.
    fn set_goal(&mut self, goal: &[f64]) -> Result<()> {
        check_finite("a goal state", goal)?;
        if ![self.state_len(), self.physics.pose_len()].contains(&goal.len())
            && let Some(set) = self.preserving_state(|task, physics, _| task.set_goal_values(physics, goal))?
        {
            return set;
        }
        let (task_state, state) = self.split_state("goal state", goal)?;
        if let Some(task_state) = task_state {
            return self.preserving_state(|task, physics, _| task.set_goal_state(physics, state, task_state))?;
        }
        // If only `qpos` and `qvel` are given, the goal state takes its other values from the present state.
        let mut full = vec![0.0; self.state_len()];
        let (present, task_state) = full.split_at_mut(self.physics.state_len());
        self.physics.state(present);
        present[1..=state.len()].copy_from_slice(state);
        self.task.save_task_state(task_state);
        self.preserving_state(|task, physics, _| task.set_goal_state(physics, present, task_state))?
    }

    /// Runs `act`, which may change the state of the physics, and restores the state.
    fn preserving_state<R>(
        &mut self,
        act: impl FnOnce(&mut T, &mut Physics, &mut Option<Box<AbstractScene>>) -> R,
    ) -> Result<R> {
        let mut scratch = std::mem::take(&mut self.scratch);
        scratch.clear();
        self.physics.save(&mut scratch);
        let result = act(&mut self.task, &mut self.physics, &mut self.scene);
        self.task.update_markers(&mut self.physics, Physics::saved_state(&scratch));
        let restored = self.physics.load(&scratch);
        self.scratch = scratch;
        restored.map(|()| result)
    }
}

/// The cameras of a model by name. The default camera is the first.
fn cameras(model: &MjModel, default: Camera) -> Vec<(String, Camera)> {
    let count = usize::try_from(model.ncam()).unwrap_or(0);
    let name = |index| {
        model.id_to_name(MjtObjBase::mjOBJ_CAMERA, index).map_or_else(|| format!("camera{index}"), str::to_owned)
    };
    let mut all: Vec<_> = (0..count).map(|index| (name(index), Camera::Fixed(index))).collect();
    all.push(("free".to_owned(), Camera::Free));
    match all.iter().position(|(_, camera)| *camera == default) {
        Some(first) => all[..=first].rotate_right(1),
        None => all.insert(0, ("default".to_owned(), default)),
    }
    all
}

impl<T: Task> Env for MujocoEnv<T> {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn reset(&mut self, seed: u64, options: &ResetOptions) -> Result<()> {
        self.apply_factors(self.spec.variation_space.resolve(&options.variation, Key::new(seed))?)?;
        self.task.receive_request(&options.variation);
        self.start_episode(seed)?;
        if let Some(state) = &options.state {
            self.set_state(state)?;
        }
        match &options.goal_state {
            Some(goal) => self.set_goal(goal),
            None => Ok(()),
        }
    }

    fn step(&mut self, action: Action<'_>) -> Result<Transition> {
        let action = action.continuous(self.spec.action_dim())?;
        let StepOutcome { reward, terminated } = self.task.step(&mut self.physics, action);
        // MuJoCo resets the state of a diverged simulation, so later steps would not continue this episode.
        let terminated = terminated || self.physics.is_unstable();
        Ok(Transition { reward, terminated, truncated: false })
    }

    fn observe(&self, row: &mut RowMut<'_>) {
        let state = row.at::<f64>(0);
        let (physics, task_state) = state.split_at_mut(self.physics.state_len());
        self.physics.state(physics);
        self.task.save_task_state(task_state);
        row.set(1, &[u8::from(self.physics.is_unstable())]);
        self.task.observe(&self.physics, row);
    }

    fn render(&mut self, frame: FrameMut<'_>) -> Result<()> {
        let size = (frame.width, frame.height);
        render::draw(&mut self.scene, &mut self.physics, self.task.camera(), size, FrameBuffer::Rgb(frame.rgb))
    }

    fn render_goal(&mut self, frame: FrameMut<'_>) -> Result<()> {
        let size = (frame.width, frame.height);
        self.preserving_state(|task, physics, scene| {
            task.move_to_goal(physics);
            render::draw(scene, physics, task.camera(), size, FrameBuffer::Rgb(frame.rgb))
        })?
    }

    fn render_view(&mut self, view: &CameraView, height: usize, width: usize, out: &mut [u8]) -> Result<()> {
        let camera = match &view.camera {
            None => self.task.camera(),
            Some(name) => {
                self.cameras.iter().find(|(known, _)| known == name).ok_or_else(|| view.unknown(&self.spec))?.1
            }
        };
        let misaligned =
            |_| Error::mismatch("rendering a camera view", "a buffer not aligned to 4 bytes", "an aligned buffer");
        let buffer = match view.modality {
            Modality::Rgb => FrameBuffer::Rgb(out),
            Modality::Depth => FrameBuffer::Depth(bytemuck::try_cast_slice_mut(out).map_err(misaligned)?),
            Modality::Segmentation => FrameBuffer::Segmentation(bytemuck::try_cast_slice_mut(out).map_err(misaligned)?),
        };
        render::draw(&mut self.scene, &mut self.physics, camera, (width, height), buffer)
    }

    fn libraries(&self) -> BTreeMap<String, String> {
        let mut libraries = BTreeMap::from([("mujoco".to_owned(), link::VERSION.to_owned())]);
        // An environment without a renderer can still be reset and stepped.
        if let Ok(name) = render::name() {
            libraries.insert("renderer".to_owned(), name);
        }
        libraries
    }

    fn factors(&self) -> &FactorValues {
        &self.factors
    }

    fn snapshot(&self) -> Snapshot {
        let mut values = Vec::with_capacity(self.physics.saved_len() + self.state_len());
        self.physics.save(&mut values);
        let mut task_values = vec![0.0; self.state_len() - self.physics.state_len() + self.task.goal_len()];
        let (task_state, goal) = task_values.split_at_mut(self.state_len() - self.physics.state_len());
        self.task.save_task_state(task_state);
        self.task.save_goal(goal);
        values.extend(task_values);
        factors::snapshot(&self.spec.id, &self.factors, values.into_iter().flat_map(f64::to_le_bytes))
    }

    fn restore(&mut self, snapshot: &Snapshot) -> Result<()> {
        let (changed, bytes) =
            factors::parse_snapshot(&self.spec.id, &self.spec.variation_space, &self.factors, snapshot)?;
        let saved = self.physics.saved_len();
        let (values, rest) = bytes.as_chunks();
        let task_state = self.state_len() - self.physics.state_len();
        let expected = saved + task_state + self.task.goal_len();
        if values.len() != expected || !rest.is_empty() {
            return Err(factors::wrong_snapshot(&self.spec.id, format!("{} bytes of state", bytes.len())));
        }
        self.scratch.clear();
        self.scratch.extend(values.iter().map(|&value| f64::from_le_bytes(value)));
        if let Some(factors) = changed {
            self.apply_factors(factors)?;
        }
        let (physics, rest) = self.scratch.split_at(saved);
        let (task_state, goal) = rest.split_at(task_state);
        self.task.load_task_state(&mut self.physics, task_state);
        self.task.load_goal(goal);
        self.task.update_markers(&mut self.physics, Physics::saved_state(physics));
        self.physics.load(physics)
    }

    fn restore_from(&mut self, start: RowRef<'_>, goal: RowRef<'_>) -> Result<()> {
        let (state, goal) = (start.to_f64(columns::STATE)?, goal.to_f64(columns::STATE)?);
        self.apply_factors(factors::from_row(&self.spec.variation_space, &self.factors, start)?)?;
        self.set_state(&state)?;
        self.set_goal(&goal)
    }

    fn sample_goal(&mut self, key: Key) -> Result<()> {
        self.preserving_state(|task, physics, _| task.sample_goal(physics, key))?
    }

    fn is_success(&self) -> bool {
        self.task.is_success(&self.physics)
    }

    fn goal_distance(&self) -> f64 {
        self.task.goal_distance(&self.physics)
    }
}
