//! Replaces the values of a compiled model by those of another compilation, except for large textures.
//!
//! MuJoCo computes masses, inertias and other constants when it compiles a model, so other factors of variation require
//! a compilation. The compiler spends nearly all of its time on the sky texture. [`replace_values`] therefore copies
//! the values of a model that was compiled with a sky texture of one pixel, which takes 0.5 ms instead of 100 ms.
#![allow(unsafe_code, reason = "a model's arrays are consecutive in one buffer, which is copied in two parts")]

use mujoco_rs::mujoco_c::mjModel;
use mujoco_rs::wrappers::MjModel;
use std::ops::Range;
use swm_core::{Error, Result};

/// Replaces every value of `model` by that of `other`, except for textures of different size. Both must be compiled
/// from the same description, up to values and texture sizes.
///
/// # Errors
/// When the arrays of the models, except for textures, have different sizes.
pub fn replace_values(model: &mut MjModel, other: &MjModel) -> Result<()> {
    let [(head, tail), from] = [around_textures(model.ffi()), around_textures(other.ffi())];
    if (head.len(), tail.len()) != (from.0.len(), from.1.len()) {
        let sizes = |(head, tail): &(Range<usize>, Range<usize>)| format!("{} and {} bytes", head.len(), tail.len());
        return Err(Error::mismatch("replacing a model's values", sizes(&from), sizes(&(head, tail))));
    }
    for texture in 0..model.tex_adr().len() {
        let (to, from) = (pixels(model, texture), pixels(other, texture));
        if to.len() == from.len() {
            model.tex_data_mut()[to].copy_from_slice(&other.tex_data()[from]);
        }
    }
    // SAFETY: the ranges lie in the buffers of two models, and `model` is borrowed exclusively. The arrays in them have
    // equal lengths, so every index of one model is valid in the other model; the texture sizes lie between the ranges
    // and are not copied.
    unsafe {
        let (to, source) = (model.ffi_mut(), other.ffi());
        for (to_range, range) in [(head, from.0), (tail, from.1)] {
            let to = to.buffer.cast::<u8>().add(to_range.start);
            std::ptr::copy_nonoverlapping(source.buffer.cast::<u8>().add(range.start), to, range.len());
        }
        to.opt = source.opt.clone();
        to.vis = source.vis.clone();
        to.stat = source.stat.clone();
    }
    Ok(())
}

/// The byte ranges of a model's buffer before and after the texture arrays.
fn around_textures(model: &mjModel) -> (Range<usize>, Range<usize>) {
    let begin = model.buffer as usize;
    let end = usize::try_from(model.nbuffer).unwrap_or(0);
    (0..model.tex_type as usize - begin, model.tex_pathadr as usize - begin..end)
}

/// The range of a texture's pixels in `tex_data`.
fn pixels(model: &MjModel, texture: usize) -> Range<usize> {
    let size = |n: i32| usize::try_from(n).unwrap_or(0);
    let begin = usize::try_from(model.tex_adr()[texture]).unwrap_or(0);
    let [width, height, channels] =
        [model.tex_width()[texture], model.tex_height()[texture], model.tex_nchannel()[texture]].map(size);
    begin..begin + width * height * channels
}

#[cfg(test)]
mod tests {
    use super::super::domain::Domain;
    use super::super::suite_env::env_arguments;
    use super::super::{ENTRIES, acrobot, ball_in_cup, cartpole, cheetah, finger, hopper};
    use super::super::{humanoid, manipulator, pendulum, quadruped, reacher, walker};
    use super::*;
    use crate::Physics;
    use swm_core::{Key, Registry, VariationRequest};

    /// Every byte of a model's arrays, and the structures outside the buffer.
    fn contents(model: &MjModel) -> (&[u8], String) {
        let model = model.ffi();
        let n = usize::try_from(model.nbuffer).expect("converting the buffer size");
        // SAFETY: a model's buffer has `nbuffer` bytes.
        let buffer = unsafe { std::slice::from_raw_parts(model.buffer.cast::<u8>(), n) };
        (buffer, format!("{:?} {:?} {:?}", model.opt, model.vis, model.stat))
    }

    fn values_equal_full_compilation<D: Domain>() {
        for task in D::TASKS.names {
            let registry = Registry { kind: "environment", hint: "", rows: &ENTRIES };
            let choice = registry.choose(&format!("{},task={task}", D::ID)).expect("choosing the environment");
            let (spec, model, suite_task) = env_arguments::<D>(&choice).expect("preparing the environment");
            let mut physics = Physics::new(model).expect("allocating the state");
            let all = VariationRequest { variation: Some(vec!["all".to_owned()]), ..VariationRequest::default() };
            let factors = spec.variation_space.resolve(&all, Key::new(1)).expect("sampling the factors");
            let [full_sky, small_sky] =
                [true, false].map(|sky| suite_task.compile(&factors, sky).expect("compiling the model"));
            replace_values(physics.model_mut(), &small_sky).expect("replacing the values");
            let (replaced, expected) = (contents(physics.model()), contents(&full_sky));
            assert!(replaced.0 == expected.0, "{}, {task}: arrays differ", D::ID);
            assert_eq!(replaced.1, expected.1, "{}, {task}", D::ID);
        }
    }

    #[test]
    fn replaced_values_equal_a_full_compilation() {
        values_equal_full_compilation::<acrobot::Acrobot>();
        values_equal_full_compilation::<ball_in_cup::BallInCup>();
        values_equal_full_compilation::<cartpole::Cartpole>();
        values_equal_full_compilation::<cheetah::Cheetah>();
        values_equal_full_compilation::<finger::Finger>();
        values_equal_full_compilation::<hopper::Hopper>();
        values_equal_full_compilation::<humanoid::Humanoid>();
        values_equal_full_compilation::<manipulator::Manipulator>();
        values_equal_full_compilation::<pendulum::Pendulum>();
        values_equal_full_compilation::<quadruped::Quadruped>();
        values_equal_full_compilation::<reacher::Reacher>();
        values_equal_full_compilation::<walker::Walker>();
    }

    #[test]
    fn rejects_models_of_different_sizes() {
        let compile = |xml: &str| crate::physics::compile_xml("a test", xml, &[]).expect("compiling the model");
        let mut one = compile("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>");
        let two = compile("<mujoco><worldbody><geom size='1'/><geom size='1'/></worldbody></mujoco>");
        assert!(replace_values(&mut one, &two).is_err());
    }
}
