//! Common parts of solvers: the population of candidates, sampling distributions, elites, the gradient loop, and
//! checks.
//!
//! A solver checks its settings with [`Settings`] and its problem with [`continuous`] or [`discrete`]. A sampling
//! solver then repeats [`iterate`]: draw a [`Population`], evaluate it, refit a distribution to its [`Elites`]. A
//! gradient solver runs a [`Descent`].

mod coloured_noise;
mod descent;
mod elites;
mod gaussian;
#[cfg(test)]
pub(crate) mod golden;
mod normal_noise;
mod optimizer;
mod population;
mod problem;
mod settings;

pub use coloured_noise::ColouredNoise;
pub use descent::{Descent, Step};
pub use elites::{Elites, smallest};
pub use gaussian::Gaussian;
pub use optimizer::{Adam, Memory, Optimizer, RmsProp, Sgd, clip_norm};
pub use population::{Population, add_noise, average, iterate};
pub(crate) use problem::count_values;
pub use problem::{
    Bounds, UNWRITTEN, constrained, continuous, differentiable, discrete, evaluate, latent, misfit, offers,
};
pub use settings::Settings;
