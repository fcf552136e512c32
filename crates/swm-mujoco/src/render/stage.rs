//! [`Stage`]: a world as MuJoCo's abstract scene.
#![allow(unsafe_code, reason = "a scene that MuJoCo allocates, fills and frees")]

use super::Camera;
use crate::{Physics, ffi, link};
use mujoco_rs::mujoco_c::{
    mjtCamera, mjtCatBit, mjtRndFlag, mjv_defaultCamera, mjv_defaultFreeCamera, mjv_defaultOption, mjv_defaultPerturb,
    mjv_defaultScene, mjv_freeScene, mjv_makeScene, mjvCamera, mjvOption, mjvPerturb, mjvScene,
};
use mujoco_rs::wrappers::MjModel;
use std::mem::MaybeUninit;
use swm_core::Result;

/// Geoms a scene has room for, beside the model's own.
const MORE_GEOMS: usize = 1000;

/// A scene, reused from picture to picture.
pub(crate) struct Stage {
    scene: Box<mjvScene>,
    option: mjvOption,
    perturb: mjvPerturb,
    camera: mjvCamera,
}

// SAFETY: a scene is memory that belongs to it alone.
unsafe impl Send for Stage {}

impl Stage {
    /// An empty scene for models of these sizes, with the visual options MuJoCo begins with.
    pub fn new(model: &MjModel) -> Self {
        let geoms = model.ffi().ngeom + model.ffi().nsite;
        let room = usize::try_from(geoms).unwrap_or(0) + MORE_GEOMS;
        let mut scene = Box::new_uninit();
        let (mut option, mut perturb, mut camera) =
            (MaybeUninit::uninit(), MaybeUninit::uninit(), MaybeUninit::uninit());
        // SAFETY: each function fills what it is given; the scene is emptied before it is made.
        unsafe {
            mjv_defaultScene(scene.as_mut_ptr());
            mjv_makeScene(model.ffi(), scene.as_mut_ptr(), i32::try_from(room).unwrap_or(i32::MAX));
            mjv_defaultOption(option.as_mut_ptr());
            mjv_defaultPerturb(perturb.as_mut_ptr());
            mjv_defaultCamera(camera.as_mut_ptr());
            Self {
                scene: scene.assume_init(),
                option: option.assume_init(),
                perturb: perturb.assume_init(),
                camera: camera.assume_init(),
            }
        }
    }

    /// Fills the scene: the world as it is now, seen through a camera, in its colours or coloured by geom.
    pub fn set(&mut self, physics: &mut Physics, camera: Camera, by_geom: bool) -> Result<()> {
        match camera {
            Camera::Fixed(place) => {
                self.camera.type_ = mjtCamera::mjCAMERA_FIXED as i32;
                self.camera.fixedcamid = i32::try_from(place).unwrap_or(-1);
            }
            Camera::Free => {
                // SAFETY: both are valid.
                unsafe { mjv_defaultFreeCamera(physics.model().ffi(), &raw mut self.camera) };
                self.camera.type_ = mjtCamera::mjCAMERA_FREE as i32;
                self.camera.fixedcamid = -1;
            }
            Camera::Orbit { lookat, distance, azimuth, elevation } => {
                self.camera.type_ = mjtCamera::mjCAMERA_FREE as i32;
                self.camera.fixedcamid = -1;
                self.camera.lookat = lookat;
                (self.camera.distance, self.camera.azimuth, self.camera.elevation) = (distance, azimuth, elevation);
            }
        }
        let (model, data) = physics.raw();
        // SAFETY: model and data belong to each other; the scene was made for models of these sizes.
        link::guard("filling a scene", || unsafe {
            ffi::mjv_updateScene(
                model,
                data,
                &raw const self.option,
                &raw const self.perturb,
                &raw mut self.camera,
                mjtCatBit::mjCAT_ALL as i32,
                &raw mut *self.scene,
            );
        })?;
        for flag in [mjtRndFlag::mjRND_SEGMENT, mjtRndFlag::mjRND_IDCOLOR] {
            self.scene.flags[flag as usize] = u8::from(by_geom);
        }
        Ok(())
    }

    /// The scene as it was filled last.
    pub fn scene(&mut self) -> &mut mjvScene {
        &mut self.scene
    }
}

impl Drop for Stage {
    fn drop(&mut self) {
        // SAFETY: `new` made it, and nobody else knows it.
        unsafe { mjv_freeScene(&raw mut *self.scene) };
    }
}
