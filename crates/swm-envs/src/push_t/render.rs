//! What the world looks like.

use super::physics::{AGENT, BLOCK, Pose, World};
use swm_core::{FactorValues, FrameMut};

/// What a picture needs to know.
#[derive(Clone)]
pub struct Scene {
    agent: Pose,
    block: Pose,
}

impl Scene {
    /// The world as it is.
    pub fn of(world: &World) -> Self {
        Self { agent: world.bodies[AGENT].pose, block: world.bodies[BLOCK].pose }
    }
}

/// Draws scenes of one episode.
pub struct Renderer;

impl Renderer {
    /// A renderer for an episode with these factors.
    pub fn new(_factors: &FactorValues) -> Self {
        Self
    }

    /// Draws a scene.
    pub fn draw(&mut self, _scene: &Scene, frame: FrameMut<'_>) {
        frame.rgb.fill(255);
    }
}
