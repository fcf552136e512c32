//! [`Env`]: one world, its actions, its observations, and its picture.
//!
//! An environment declares its observation columns up front ([`EnvSpec`]) and writes them into a [`crate::Batch`]
//! row in place. It owns all its randomness: the same seed and the same actions give the same bytes. Its
//! full state can be taken and put back ([`Env::snapshot`]), it can start from a row of a dataset
//! ([`Env::restore_from`]), and it can always make a reachable goal ([`Env::sample_goal`]).

use crate::batch::{ColumnSpec, RowMut, RowRef};
use crate::camera_view::CameraView;
use crate::columns::ACTION;
use crate::dataset_start::DatasetStartEnv;
use crate::dispatch::DispatchEnv;
use crate::{Error, FactorValues, Key, Result, Space, VariationRequest, VariationSpace};
use std::collections::BTreeMap;

/// What never changes about an environment.
#[derive(Clone)]
pub struct EnvSpec {
    /// Its registered id with the options that differ from their defaults, such as `swm/PushT-v1` or
    /// `swm/OGBCube-v0,env_type=double` ([`crate::EnvChoice::id`]).
    pub id: String,
    /// The actions it takes: a `Float32` box, a discrete space or a multi-discrete one.
    pub action_space: Space,
    /// The columns [`Env::observe`] writes, in order; `state` is always among them.
    pub columns: Vec<ColumnSpec>,
    /// What an agent observes: columns, and between which bounds they usually lie. Worlds may leave them, as the
    /// reference's do. A single one is the observation itself.
    pub observation_space: Vec<(&'static str, Space)>,
    /// Its factors of variation.
    pub variation_space: VariationSpace,
    /// Steps after which an episode is truncated, unless the caller says otherwise.
    pub max_episode_steps: usize,
    /// The names of its cameras, the default first; none where there is only one way to look at it.
    pub cameras: Vec<String>,
}

impl EnvSpec {
    /// Numbers in one action.
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

/// What a caller may choose at a reset.
#[derive(Clone, Debug, Default)]
pub struct ResetOptions {
    /// Factors to sample and to pin.
    pub variation: VariationRequest,
    /// The start, in the layout of the `state` column; `None` follows the factors.
    pub state: Option<Vec<f64>>,
    /// The goal, in the layout of the `state` column; `None` lets the environment choose.
    pub goal_state: Option<Vec<f64>>,
}

/// One action.
#[derive(Clone, Copy, Debug)]
pub enum Action<'a> {
    /// A point of a box.
    Continuous(&'a [f32]),
    /// One of a discrete set, or one of each of several.
    Discrete(&'a [i64]),
}

impl<'a> Action<'a> {
    /// The numbers of a continuous action.
    ///
    /// # Errors
    /// When it is discrete, has another length than `dim`, or a number is not finite.
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
            Self::Continuous(values) => {
                Err(Error::mismatch("stepping", format!("an action of {} numbers", values.len()), format!("{dim}")))
            }
            Self::Discrete(choice) => {
                Err(Error::mismatch("stepping", format!("discrete action {choice:?}"), format!("{dim} numbers")))
            }
        }
    }

    /// The integers of an action of a discrete space: one, or as many as a multi-discrete space has.
    ///
    /// # Errors
    /// When it is continuous, has another length than the space, or is out of range.
    pub fn discrete(self, space: &Space) -> Result<&'a [i64]> {
        #[allow(clippy::cast_possible_truncation)]
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
            Self::Discrete(choice) => Err(Error::mismatch("stepping", format!("action {choice:?}"), expected())),
            Self::Continuous(values) => {
                Err(Error::mismatch("stepping", format!("{values:?}"), format!("integers in {}", expected())))
            }
        }
    }
}

/// What a step brought, apart from the observation.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Transition {
    /// The reward.
    pub reward: f64,
    /// The episode is over because of where the world is: the goal is reached, or cannot be any more. Which of the two,
    /// [`Env::is_success`] says.
    pub terminated: bool,
    /// The episode is over because of the clock.
    pub truncated: bool,
}

/// An RGB picture to draw into: rows of `width` pixels of 3 bytes.
pub struct FrameMut<'a> {
    /// Pixels in a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `height * width * 3` bytes.
    pub rgb: &'a mut [u8],
}

impl<'a> FrameMut<'a> {
    /// A picture over these bytes.
    ///
    /// # Panics
    /// When there are not `height * width * 3` of them.
    pub fn new(width: usize, height: usize, rgb: &'a mut [u8]) -> Self {
        assert_eq!(rgb.len(), width * height * 3, "a {width} x {height} RGB picture");
        Self { width, height, rgb }
    }
}

/// The full state of an environment, randomness included: opaque bytes, valid for the same environment id.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Snapshot(pub Vec<u8>);

/// One world.
pub trait Env: Send {
    /// What never changes about it.
    fn spec(&self) -> &EnvSpec;

    /// Starts an episode: samples factors, start and goal from `seed` alone.
    ///
    /// # Errors
    /// When the request names unknown factors or impossible values.
    fn reset(&mut self, seed: u64, options: &ResetOptions) -> Result<()>;

    /// Applies one action. Continuous actions outside the action space are clipped to it or not, as the
    /// environment's README says; non-finite ones are errors.
    ///
    /// # Errors
    /// When the action is of the wrong kind, length or range, or not finite.
    fn step(&mut self, action: Action<'_>) -> Result<Transition>;

    /// The environment as one whose calls can be dispatched early, if it runs in another process.
    fn as_dispatch(&mut self) -> Option<&mut dyn DispatchEnv> {
        None
    }

    /// Writes the columns of [`EnvSpec::columns`] into the first places of a row.
    fn observe(&self, row: &mut RowMut<'_>);

    /// Draws the world as it is.
    ///
    /// # Errors
    /// When there is nothing to draw with: a renderer that is missing, or refuses.
    fn render(&mut self, frame: FrameMut<'_>) -> Result<()>;

    /// Draws the world as it would look at the goal.
    ///
    /// # Errors
    /// As [`Env::render`].
    fn render_goal(&mut self, frame: FrameMut<'_>) -> Result<()>;

    /// Writes what a view of the world shows, in the form of its [`CameraView::column`]. Worlds with one camera know no view
    /// but that of [`Env::render`].
    ///
    /// # Errors
    /// When there is no such camera, or no such modality; and as [`Env::render`].
    fn render_view(&mut self, view: &CameraView, height: usize, width: usize, out: &mut [u8]) -> Result<()> {
        if *view == CameraView::default() {
            return self.render(FrameMut::new(width, height, out));
        }
        Err(view.unknown(self.spec()))
    }

    /// The libraries that decide its numbers and pictures, such as `mujoco` or `renderer`, with their versions: what
    /// datasets and results made with it record.
    fn libraries(&self) -> BTreeMap<String, String> {
        BTreeMap::new()
    }

    /// What is the same in every step of this episode and no number, such as the XML of its scene: stored once with it.
    fn constants(&self) -> BTreeMap<String, Vec<u8>> {
        BTreeMap::new()
    }

    /// The factors of this episode.
    fn factors(&self) -> &FactorValues;

    /// The full state, randomness included.
    fn snapshot(&self) -> Snapshot;

    /// Puts a state back; what follows equals what followed the snapshot, bit for bit.
    ///
    /// # Errors
    /// When the snapshot is of another environment.
    fn restore(&mut self, snapshot: &Snapshot) -> Result<()>;

    /// Continues from a dataset row (its `state` column, and factor columns where it has them) towards the
    /// state of another row.
    ///
    /// # Errors
    /// When a row lacks what the environment needs.
    fn restore_from(&mut self, start: RowRef<'_>, goal: RowRef<'_>) -> Result<()>;

    /// The environment's own way to start at rows of a dataset, where it cannot restore its state from a row.
    /// [`crate::dataset_start`] holds the functions that callers use.
    fn dataset_start(&self) -> Option<&dyn DatasetStartEnv> {
        None
    }

    /// As [`Env::dataset_start`], to start an episode.
    fn dataset_start_mut(&mut self) -> Option<&mut dyn DatasetStartEnv> {
        None
    }

    /// Chooses a new reachable goal that is not already reached, without moving the world.
    ///
    /// # Errors
    /// When none is found in bounded tries.
    fn sample_goal(&mut self, key: Key) -> Result<()>;

    /// Whether the goal is reached now.
    fn is_success(&self) -> bool;

    /// How far the world is from its goal, in the unit its README names: 0 at the goal, never negative, falling
    /// along a good way there (around walls, not through them). A simulator that serves as a cost model
    /// minimises it.
    fn goal_distance(&self) -> f64;
}
