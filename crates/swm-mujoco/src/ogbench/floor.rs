//! The checkered floor of tables and mazes, whose two colours are a factor of variation.

use super::arm::find;
use crate::Physics;
use mujoco_rs::mujoco_c::_mjtObjBase::mjOBJ_TEXTURE;
use std::ops::Range;
use std::sync::Arc;
use swm_core::Result;

/// The colours of the floor in OGBench's files.
pub const COLORS: [[f64; 3]; 2] = [[0.08, 0.11, 0.16], [0.15, 0.18, 0.25]];

/// The bytes of a colour in a texture, rounded down as MuJoCo does.
fn bytes(color: &[f64]) -> [u8; 3] {
    [color[0], color[1], color[2]].map(|channel| (255.0 * channel) as u8)
}

/// The range of a texture in `tex_data`, its width and its height.
fn texture_range(model: &mujoco_rs::wrappers::MjModel, texture: usize) -> (Range<usize>, usize, usize) {
    let sizes = [model.tex_adr()[texture], model.tex_width()[texture].into(), model.tex_height()[texture].into()];
    let [from, width, height] = sizes.map(|size| usize::try_from(size).unwrap_or(0));
    (from..from + 3 * width * height, width, height)
}

/// Sets the two colours of the floor. Texels of other colours, such as a cross, do not change.
///
/// # Shapes
/// `colors`: `[2, 3]`, from 0 to 1.
///
/// # Errors
/// When the model has no texture `grid`.
pub fn set_colors(physics: &mut Physics, colors: &[f64]) -> Result<()> {
    let texture = find(physics.model(), mjOBJ_TEXTURE, "grid")?;
    let swaps = [(bytes(&COLORS[0]), bytes(&colors[..3])), (bytes(&COLORS[1]), bytes(&colors[3..]))];
    let original = Arc::clone(physics.original());
    let (texels, ..) = texture_range(&original, texture);
    let old = original.tex_data()[texels.clone()].as_chunks::<3>().0;
    let now = physics.model_mut().tex_data_mut()[texels].as_chunks_mut::<3>().0;
    for (now, old) in now.iter_mut().zip(old) {
        *now = swaps.iter().find(|(known, _)| known == old).map_or(*old, |(_, color)| *color);
    }
    physics.mark_textures_edited();
    Ok(())
}

/// Encodes each position on the floor in its colour: red increases with the row of the texel, green with the column.
pub fn encode_position(physics: &mut Physics, texture: usize) {
    const BRIGHTEST: usize = 192;
    let model = physics.model_mut();
    let (range, width, height) = texture_range(model, texture);
    let texels = model.tex_data_mut()[range].as_chunks_mut::<3>().0;
    for (i, texel) in texels.iter_mut().enumerate() {
        *texel = [(i / width * BRIGHTEST / height) as u8, (i % width * BRIGHTEST / width) as u8, 128];
    }
    physics.mark_textures_edited();
}
