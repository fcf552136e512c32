//! Rendering of environments: RGB, depth and segmentation, through any camera, at any size, into the caller's buffer.
//!
//! An [`AbstractScene`] converts the state of an environment to MuJoCo's abstract scene (geoms, lights, cameras) on the
//! thread that owns the environment. A [`Renderer`](renderer::Renderer) draws this scene: MuJoCo's OpenGL renderer
//! through EGL (`egl`), or this project's CPU renderer (`cpu`). [`choose`] selects the renderer.

mod abstract_scene;
mod choice;
mod cpu;
mod draw;
mod egl;
mod renderer;
#[cfg(test)]
pub(crate) mod similarity;

pub(crate) use abstract_scene::AbstractScene;
pub use choice::{Choice, choose, name, with};
pub(crate) use draw::draw;
pub use renderer::{Camera, FrameBuffer};
