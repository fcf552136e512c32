//! A model's numbers exchanged for those of another compilation, textures aside.
//!
//! Masses, inertias and much else are computed when a model is compiled, so a world with other factors of variation is
//! compiled again. Nearly all of that time goes into painting the sky. Here the new model is compiled with a sky of a few
//! pixels, and its numbers are taken over: half a millisecond in place of a hundred.
#![allow(unsafe_code, reason = "the arrays of a model lie one after another in a buffer, which is copied in two parts")]

use mujoco_rs::mujoco_c::mjModel;
use mujoco_rs::wrappers::MjModel;
use std::ops::Range;
use swm_core::{Error, Result};

/// Takes every number of `other`, except for textures whose sizes differ. Both are compiled from the same description, up to
/// values and the sizes of textures.
///
/// # Errors
/// When the models differ in more than that.
pub fn adopt(model: &mut MjModel, other: &MjModel) -> Result<()> {
    let [(head, tail), from] = [parts(model.ffi()), parts(other.ffi())];
    if (head.len(), tail.len()) != (from.0.len(), from.1.len()) {
        let sizes = |(head, tail): &(Range<usize>, Range<usize>)| format!("{} and {} bytes", head.len(), tail.len());
        return Err(Error::mismatch("exchanging a model's numbers", sizes(&from), sizes(&(head, tail))));
    }
    for texture in 0..model.tex_adr().len() {
        let (to, from) = (pixels(model, texture), pixels(other, texture));
        if to.len() == from.len() {
            model.tex_data_mut()[to].copy_from_slice(&other.tex_data()[from]);
        }
    }
    // SAFETY: the ranges lie in the buffers of two models, one of which is ours alone. The arrays in them have equal sizes, so
    // that every index in one fits the other; what says how large textures are lies between the ranges.
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

/// Where the arrays before and behind those of textures are in a model's buffer.
fn parts(model: &mjModel) -> (Range<usize>, Range<usize>) {
    let begin = model.buffer as usize;
    let end = usize::try_from(model.nbuffer).unwrap_or(0);
    (0..model.tex_type as usize - begin, model.tex_pathadr as usize - begin..end)
}

/// Where a texture's pixels are.
fn pixels(model: &MjModel, texture: usize) -> Range<usize> {
    let size = |n: i32| usize::try_from(n).unwrap_or(0);
    let begin = usize::try_from(model.tex_adr()[texture]).unwrap_or(0);
    let [width, height, channels] =
        [model.tex_width()[texture], model.tex_height()[texture], model.tex_nchannel()[texture]].map(size);
    begin..begin + width * height * channels
}

#[cfg(test)]
mod tests {
    use super::super::env::parts;
    use super::super::{Domain, ENTRIES, acrobot, ball_in_cup, cartpole, cheetah, finger, hopper};
    use super::super::{humanoid, manipulator, pendulum, quadruped, reacher, walker};
    use super::*;
    use crate::Physics;
    use swm_core::{Key, Registry, VariationRequest};

    /// Every byte of a model's arrays, and what stands beside them.
    fn everything(model: &MjModel) -> (&[u8], String) {
        let model = model.ffi();
        let n = usize::try_from(model.nbuffer).expect("a size");
        // SAFETY: a model's buffer has as many bytes as it says.
        let buffer = unsafe { std::slice::from_raw_parts(model.buffer.cast::<u8>(), n) };
        (buffer, format!("{:?} {:?} {:?}", model.opt, model.vis, model.stat))
    }

    fn same_as_compiled<D: Domain>() {
        for (task, _) in D::TASKS {
            let registry = Registry { kind: "environment", hint: "", rows: &ENTRIES };
            let choice = registry.choose(&format!("{},task={task}", D::ID)).expect("a world");
            let (spec, model, control) = parts::<D>(&choice).expect("a world");
            let mut physics = Physics::new(model).expect("a state");
            let all = VariationRequest { variation: Some(vec!["all".to_owned()]), ..VariationRequest::default() };
            let factors = spec.variation_space.resolve(&all, Key::new(1)).expect("factors");
            let [whole, bare] = [true, false].map(|sky| control.compile(&factors, sky).expect("a model"));
            adopt(physics.model_mut(), &bare).expect("models of the same parts");
            let (now, wanted) = (everything(physics.model()), everything(&whole));
            assert!(now.0 == wanted.0, "{}, {task}: arrays differ", D::ID);
            assert_eq!(now.1, wanted.1, "{}, {task}", D::ID);
        }
    }

    #[test]
    fn numbers_are_those_of_a_whole_compilation() {
        same_as_compiled::<acrobot::Acrobot>();
        same_as_compiled::<ball_in_cup::BallInCup>();
        same_as_compiled::<cartpole::Cartpole>();
        same_as_compiled::<cheetah::Cheetah>();
        same_as_compiled::<finger::Finger>();
        same_as_compiled::<hopper::Hopper>();
        same_as_compiled::<humanoid::Humanoid>();
        same_as_compiled::<manipulator::Manipulator>();
        same_as_compiled::<pendulum::Pendulum>();
        same_as_compiled::<quadruped::Quadruped>();
        same_as_compiled::<reacher::Reacher>();
        same_as_compiled::<walker::Walker>();
    }

    #[test]
    fn models_of_other_parts_are_refused() {
        let compile = |xml: &str| crate::physics::compile_xml("a test", xml, &[]).expect("a model");
        let mut one = compile("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>");
        let two = compile("<mujoco><worldbody><geom size='1'/><geom size='1'/></worldbody></mujoco>");
        assert!(adopt(&mut one, &two).is_err());
    }
}
