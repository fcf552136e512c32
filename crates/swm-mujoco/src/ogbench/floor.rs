//! The checkered floor, whose two colours vary.

use super::arm::find;
use crate::Physics;
use mujoco_rs::mujoco_c::_mjtObjBase::mjOBJ_TEXTURE;
use swm_core::Result;

/// The colours of the floor as its files have them.
pub const COLORS: [[f64; 3]; 2] = [[0.08, 0.11, 0.16], [0.15, 0.18, 0.25]];

/// A colour in a texture, as MuJoCo makes it.
fn bytes(color: &[f64]) -> [u8; 3] {
    [color[0], color[1], color[2]].map(|share| (255.0 * share) as u8)
}

/// Paints the floor with two colours, six numbers. What has neither colour in the files, such as a cross, stays.
///
/// # Errors
/// When the model has no such floor.
pub fn paint(physics: &mut Physics, colors: &[f64]) -> Result<()> {
    let texture = find(physics.model(), mjOBJ_TEXTURE, "grid")?;
    let swaps = [(bytes(&COLORS[0]), bytes(&colors[..3])), (bytes(&COLORS[1]), bytes(&colors[3..]))];
    let original = std::sync::Arc::clone(physics.original());
    let sizes =
        [original.tex_adr()[texture], original.tex_width()[texture].into(), original.tex_height()[texture].into()];
    let [from, width, height] = sizes.map(|size| usize::try_from(size).unwrap_or(0));
    let texels = from..from + 3 * width * height;
    let old = original.tex_data()[texels.clone()].as_chunks::<3>().0;
    let now = physics.model_mut().tex_data_mut()[texels].as_chunks_mut::<3>().0;
    for (now, old) in now.iter_mut().zip(old) {
        *now = swaps.iter().find(|(known, _)| known == old).map_or(*old, |(_, color)| *color);
    }
    physics.mark_textures_edited();
    Ok(())
}

/// Paints the floor so that its colour says where one is: red grows with the rows, green with the columns.
pub fn encode(physics: &mut Physics, texture: usize) {
    const BRIGHTEST: usize = 192;
    let model = physics.model_mut();
    let sizes = [model.tex_adr()[texture], model.tex_width()[texture].into(), model.tex_height()[texture].into()];
    let [from, width, height] = sizes.map(|size| usize::try_from(size).unwrap_or(0));
    let texels = model.tex_data_mut()[from..from + 3 * width * height].as_chunks_mut::<3>().0;
    for (place, texel) in texels.iter_mut().enumerate() {
        *texel = [(place / width * BRIGHTEST / height) as u8, (place % width * BRIGHTEST / width) as u8, 128];
    }
    physics.mark_textures_edited();
}
