//! Renders the state of an environment with the chosen renderer.

use super::abstract_scene::AbstractScene;
use super::choice::renderer;
use super::renderer::{Camera, FrameBuffer, ModelScene};
use crate::Physics;
use swm_core::{Error, Result};

/// Renders the present state. `scene` is created at the first call and reused afterwards.
///
/// # Shapes
/// `buffer`: row-major `[height, width, 3]` for RGB, `[height, width]` otherwise.
///
/// # Errors
/// When no renderer is available, the buffer has the wrong length, or the graphics library fails.
pub(crate) fn draw(
    scene: &mut Option<Box<AbstractScene>>,
    physics: &mut Physics,
    camera: Camera,
    (width, height): (usize, usize),
    buffer: FrameBuffer<'_>,
) -> Result<()> {
    let expected = width * height * buffer.channels();
    if buffer.len() != expected {
        let given = format!("a buffer of {} elements", buffer.len());
        return Err(Error::mismatch(format!("rendering {width} x {height} pixels"), given, expected.to_string()));
    }
    if expected == 0 {
        return Ok(());
    }
    let renderer = renderer()?;
    let scene = scene.get_or_insert_with(|| Box::new(AbstractScene::new(physics.model())));
    scene.update(physics, camera, matches!(buffer, FrameBuffer::Segmentation(_)))?;
    physics.refresh_appearance();
    let scene = ModelScene { scene: scene.scene(), model: physics.model(), appearance: physics.appearance() };
    renderer.draw(scene, width, height, buffer)
}
