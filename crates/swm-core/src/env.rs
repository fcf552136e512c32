//! [`Env`]: one environment, with its actions, observations, goals and frames.
//!
//! An environment declares its observation columns up front ([`EnvSpec`]) and writes them into a [`crate::Batch`] row
//! in place. An environment owns all its randomness: the same seed and the same actions give the same bytes. Its full
//! state can be saved and restored ([`Env::snapshot`]), it can start from a row of a dataset ([`Env::restore_from`]),
//! and it can always sample a reachable goal ([`Env::sample_goal`]).

use crate::batch::{ColumnSpec, RowMut, RowRef};
use crate::camera_view::CameraView;
use crate::columns::ACTION;
use crate::dataset_start::DatasetStartEnv;
use crate::dispatch::DispatchEnv;
use crate::{Error, FactorValues, Key, Result, Space, VariationRequest, VariationSpace};
use std::collections::BTreeMap;

/// The constant properties of an environment.
#[derive(Clone)]
pub struct EnvSpec {
    /// The registered id with the options that differ from their defaults, such as `swm/PushT-v1` or
    /// `swm/OGBCube-v0,env_type=double` ([`crate::EnvChoice::id`]).
    pub id: String,
    /// The action space: a `Float32` box, a discrete space or a multi-discrete one.
    pub action_space: Space,
    /// The columns [`Env::observe`] writes, in order; `state` is always among them.
    pub columns: Vec<ColumnSpec>,
    /// The columns an agent observes, with their usual bounds. As in the reference implementation, values may exceed
    /// the bounds. A single column is the observation itself; several columns form a dictionary.
    pub observation_space: Vec<(&'static str, Space)>,
    /// The factors of variation.
    pub variation_space: VariationSpace,
    /// The default time limit: steps after which an episode is truncated.
    pub max_episode_steps: usize,
    /// The names of the cameras, the default camera first; empty for an environment with a single unnamed view.
    pub cameras: Vec<String>,
    /// The elements of columns that are angles of full turns, in radians: the column and the index of the element. Equal
    /// angles may differ by full turns, so regressions predict their sine and cosine.
    pub angles: Vec<(&'static str, usize)>,
}

impl EnvSpec {
    /// The dimension of an action.
    pub fn action_dim(&self) -> usize {
        self.action_space.len()
    }

    /// The column that holds actions: `Float32` for boxes, `Int64` for discrete spaces.
    pub fn action_column(&self) -> ColumnSpec {
        let shape = match &self.action_space {
            Space::Discrete { .. } => vec![1],
            other => other.shape(),
        };
        ColumnSpec::new(ACTION, self.action_space.dtype(), shape)
    }
}

/// The options of [`Env::reset`].
#[derive(Clone, Debug, Default)]
pub struct ResetOptions {
    /// Factors to sample and to pin.
    pub variation: VariationRequest,
    /// The initial state, in the layout of the `state` column; by default the environment samples it
    /// from the factors and the seed.
    pub state: Option<Vec<f64>>,
    /// The goal state, in the layout of the `state` column; by default the environment samples it.
    pub goal_state: Option<Vec<f64>>,
}

/// One action.
#[derive(Clone, Copy, Debug)]
pub enum Action<'a> {
    /// A point of a box, `[dim]`.
    Continuous(&'a [f32]),
    /// One integer of a discrete space, or one integer for each dimension of a multi-discrete space.
    Discrete(&'a [i64]),
}

impl<'a> Action<'a> {
    /// The elements of a continuous action of dimension `dim`.
    ///
    /// # Errors
    /// When the action is discrete, has another dimension, or an element is not finite.
    pub fn continuous(self, dim: usize) -> Result<&'a [f32]> {
        match self {
            Self::Continuous(values) if values.len() == dim => match values.iter().find(|v| !v.is_finite()) {
                None => Ok(values),
                Some(_) => Err(Error::NotFinite {
                    what: "an action".to_owned(),
                    given: format!("{values:?}"),
                    fix: "check the policy or the model that produced it".to_owned(),
                }),
            },
            Self::Continuous(values) => Err(Error::mismatch(
                "stepping",
                format!("an action of dimension {}", values.len()),
                format!("dimension {dim}"),
            )),
            Self::Discrete(choice) => Err(Error::mismatch(
                "stepping",
                format!("discrete action {choice:?}"),
                format!("a continuous action of dimension {dim}"),
            )),
        }
    }

    /// The integers of an action of a discrete or multi-discrete space.
    ///
    /// # Errors
    /// When the action is continuous, has another dimension than the space, or is out of range.
    pub fn discrete(self, space: &Space) -> Result<&'a [i64]> {
        let bounds = |i| {
            let (low, high) = space.bounds(i);
            low as i64..=high as i64
        };
        let expected = || (0..space.len()).map(|i| format!("{:?}", bounds(i))).collect::<Vec<_>>().join(", ");
        match self {
            Self::Discrete(choice)
                if choice.len() == space.len()
                    && choice.iter().enumerate().all(|(i, choice)| bounds(i).contains(choice)) =>
            {
                Ok(choice)
            }
            Self::Discrete(choice) => Err(Error::mismatch(
                "stepping",
                format!("discrete action {choice:?}"),
                format!("integers in {}", expected()),
            )),
            Self::Continuous(values) => Err(Error::mismatch(
                "stepping",
                format!("continuous action {values:?}"),
                format!("integers in {}", expected()),
            )),
        }
    }
}

/// The outcome of a step, without the observation.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Transition {
    /// The reward.
    pub reward: f64,
    /// Whether a terminal state ended the episode: the goal is reached, or cannot be reached any more.
    /// [`Env::is_success`] distinguishes the two cases.
    pub terminated: bool,
    /// Whether the time limit ended the episode.
    pub truncated: bool,
}

/// An RGB frame to render into.
///
/// # Shapes
/// `rgb` is `[height, width, 3]` bytes, row-major.
pub struct FrameMut<'a> {
    /// The width in pixels.
    pub width: usize,
    /// The height in pixels.
    pub height: usize,
    /// The pixels.
    pub rgb: &'a mut [u8],
}

impl<'a> FrameMut<'a> {
    /// A frame over these bytes, `[height, width, 3]`.
    ///
    /// # Panics
    /// When the size of `rgb` differs from `height * width * 3`.
    pub fn new(width: usize, height: usize, rgb: &'a mut [u8]) -> Self {
        assert_eq!(rgb.len(), width * height * 3, "the buffer must have the size of a {width} x {height} RGB frame");
        Self { width, height, rgb }
    }
}

/// The full state of an environment, including its random generators: opaque bytes, valid for the same environment id.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Snapshot(pub Vec<u8>);

/// One environment.
pub trait Env: Send {
    /// The constant properties.
    fn spec(&self) -> &EnvSpec;

    /// Starts an episode: samples factors, initial state and goal from `seed` alone.
    ///
    /// # Errors
    /// When the request names unknown factors or invalid values.
    fn reset(&mut self, seed: u64, options: &ResetOptions) -> Result<()>;

    /// Applies one action. Each environment's README documents whether continuous actions outside the action space are
    /// clipped.
    ///
    /// # Errors
    /// When the action has the wrong kind, dimension or range, or is not finite.
    fn step(&mut self, action: Action<'_>) -> Result<Transition>;

    /// Writes the columns of [`EnvSpec::columns`] into the first columns of a row.
    fn observe(&self, row: &mut RowMut<'_>);

    /// Renders the present state with the default camera.
    ///
    /// # Errors
    /// When the renderer is missing or fails.
    fn render(&mut self, frame: FrameMut<'_>) -> Result<()>;

    /// Renders the goal state with the default camera.
    ///
    /// # Errors
    /// As [`Env::render`].
    fn render_goal(&mut self, frame: FrameMut<'_>) -> Result<()>;

    /// Renders a camera view of the present state into `out`, the bytes of a row of [`CameraView::column`]. By default
    /// an environment has the view of [`Env::render`] only.
    ///
    /// # Errors
    /// When the environment has no such camera or modality; and as [`Env::render`].
    fn render_view(&mut self, view: &CameraView, height: usize, width: usize, out: &mut [u8]) -> Result<()> {
        if *view == CameraView::default() {
            return self.render(FrameMut::new(width, height, out));
        }
        Err(view.unknown(self.spec()))
    }

    /// The versions of the libraries that affect observations, rewards or frames, such as `mujoco` or `renderer`.
    /// Datasets and results record them.
    fn libraries(&self) -> BTreeMap<String, String> {
        BTreeMap::new()
    }

    /// Data that is constant over the episode and not a column, such as the XML of the scene. Datasets store it once
    /// per episode.
    fn constants(&self) -> BTreeMap<String, Vec<u8>> {
        BTreeMap::new()
    }

    /// The factors of this episode.
    fn factors(&self) -> &FactorValues;

    /// The full state, including the random generators.
    fn snapshot(&self) -> Snapshot;

    /// Restores a snapshot. The following steps equal those that followed the snapshot, bit for bit.
    ///
    /// # Errors
    /// When the snapshot is of another environment.
    fn restore(&mut self, snapshot: &Snapshot) -> Result<()>;

    /// Sets the state to that of a dataset row (its `state` column, and factor columns if present) and the goal to the
    /// state of another row.
    ///
    /// # Errors
    /// When a row lacks a required column.
    fn restore_from(&mut self, start: RowRef<'_>, goal: RowRef<'_>) -> Result<()>;

    /// Samples a new reachable goal that is not reached yet. The state of the environment does not change.
    ///
    /// # Errors
    /// When no goal is found within a bounded number of tries.
    fn sample_goal(&mut self, key: Key) -> Result<()>;

    /// Whether the present state satisfies the goal.
    fn is_success(&self) -> bool;

    /// The distance from the present state to the goal, in the unit that the environment's README names.
    ///
    /// It is at least 0, is 0 at the goal, and decreases along feasible paths to the goal: around walls, not through
    /// them. A cost model that simulates the environment uses it as the cost.
    fn goal_distance(&self) -> f64;

    /// The distance to the goal with the weights of the success criterion: below 1 only for states that satisfy the goal.
    ///
    /// By default this is [`Env::goal_distance`] in its own unit. An environment overrides it if its goal distance
    /// weighs parts of the state otherwise than its success criterion does.
    fn success_distance(&self) -> f64 {
        self.goal_distance()
    }

    /// Returns the interface for dispatching calls early, if the environment runs in another process.
    fn as_dispatch(&mut self) -> Option<&mut dyn DispatchEnv> {
        None
    }

    /// Returns the environment's own interface for starting at dataset rows; `None` if the environment
    /// starts by [`Env::restore_from`]. Callers use the functions of [`crate::dataset_start`] instead of this method.
    fn dataset_start(&self) -> Option<&dyn DatasetStartEnv> {
        None
    }

    /// The mutable form of [`Env::dataset_start`].
    fn dataset_start_mut(&mut self) -> Option<&mut dyn DatasetStartEnv> {
        None
    }
}
