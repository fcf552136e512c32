//! Plans of a solver as they are searched, behind a WebSocket: the candidates of every iteration, what they lead to in the
//! environment, and a tree of the steps that were played, to any of which a page can go back.
//!
//! - [`Planning`]: what the program knows of models; this crate receives it as data.
//! - [`messages`]: requests and replies. `session`: the thread that answers them.
//! - `watch`: reads the iterations of a search. `scratch`: plays candidates in a private environment. `projection`: paths
//!   in the plane. `imagination`: what a model predicts beside what happens. `search`: all of it as one JSON document.
//! - [`tree`]: the steps that were played, with snapshots.

mod imagination;
pub mod messages;
mod projection;
mod scratch;
mod search;
mod session;
mod settings;
pub mod tree;
mod watch;

pub use session::PlanSession;
pub use settings::Settings;

use serde::Serialize;
use serde_json::json;
use swm_core::run::Control;
use swm_core::{EnvSpec, Policy, Predictor, Result};
use swm_data::Reader;
use swm_eval::World;
use swm_plan::{ActionKind, ActionScale, PlanObserver, SOLVERS};

/// The name of the model that is the environment itself.
pub const SIMULATOR: &str = "simulator";

/// A model that plans are made in.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Model {
    /// The name by which pages choose it, as `swm eval` names it.
    pub name: String,
    /// The family, such as `lewm`.
    pub family: String,
    /// Environment steps in a model step; `None` if the page chooses.
    pub block: Option<usize>,
    /// The side of the frames that it reads, in pixels; `None` if it reads none.
    pub image: Option<usize>,
    /// Frames that a prediction reads.
    pub history: usize,
}

/// Two elements of a state that are a position on the frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Position {
    /// What is there, such as `agent`.
    pub name: &'static str,
    /// The indices of x and y in the column `state`.
    pub elements: [usize; 2],
    /// The side of the frame in the units of the state.
    pub side: f64,
    /// Whether y points up.
    pub is_up: bool,
}

/// A policy that plans.
pub struct Planner {
    /// The policy, for one environment.
    pub policy: Box<dyn Policy>,
    /// The scale of its actions.
    pub scale: ActionScale,
    /// The model for predictions that are compared with what happens, if it offers them.
    pub predictor: Option<Box<dyn Predictor>>,
}

/// Maps latents `[n, dim]` to RGB frames of the side that a model reads, `[n, side, side, 3]`.
pub type Decode = dyn Fn(&[f32]) -> Vec<u8>;

/// Decodes the latents of a model to frames.
pub struct FrameDecoder {
    /// The decoder.
    pub decode: Box<Decode>,
    /// The fraction of the variance of pixels that it explains on episodes that it was not fitted on.
    pub explained: f64,
}

/// The models and the solvers that fit an environment, the solvers with their default settings and what they need.
pub fn listed(planning: &dyn Planning, spec: &EnvSpec) -> serde_json::Value {
    let actions = ActionKind::of(&spec.action_space);
    let solvers = SOLVERS.rows.iter().filter(|row| row.actions == actions);
    let solvers = solvers.map(|row| {
        json!({"id": row.id, "summary": row.summary, "family": row.family, "needs": row.needs, "defaults": (row.defaults)()})
    });
    json!({"models": planning.models(spec), "solvers": solvers.collect::<Vec<_>>()})
}

/// What the program knows of models that plan.
pub trait Planning: Send + Sync {
    /// Returns the models that can plan in an environment, [`SIMULATOR`] first. Only these can be chosen.
    fn models(&self, spec: &EnvSpec) -> Vec<Model>;

    /// Returns the positions that a state of the environment holds; none if its frames are no plane of the state.
    fn positions(&self, spec: &EnvSpec) -> &'static [Position];

    /// Returns what makes policies in the thread of a session.
    fn planners(&self) -> Box<dyn Planners + '_>;
}

/// Makes policies that plan; it may keep loaded models.
pub trait Planners {
    /// Makes the policy of these settings, whose model is one of [`Planning::models`]. `observer` reads its searches.
    ///
    /// # Errors
    /// When the settings are invalid or do not fit the model and the environment.
    fn planner(
        &mut self,
        settings: &Settings,
        model: &Model,
        world: &World,
        observer: Box<dyn PlanObserver>,
    ) -> Result<Planner>;

    /// Fits a decoder from the latents of a model, which reads frames of this side and nothing else, to the frames of a dataset.
    ///
    /// # Errors
    /// When the dataset has no frames of this side, or `control` stops the fit.
    fn decoder(
        &mut self,
        model: (&mut dyn Predictor, usize),
        dataset: &dyn Reader,
        control: &mut Control<'_>,
    ) -> Result<FrameDecoder>;
}
