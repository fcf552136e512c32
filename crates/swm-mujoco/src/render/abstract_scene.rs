//! [`AbstractScene`]: the state of an environment as MuJoCo's abstract scene, which renderers draw.
#![allow(unsafe_code, reason = "a scene that MuJoCo allocates, fills and frees")]

use super::renderer::Camera;
use crate::{Physics, ffi, link};
use mujoco_rs::mujoco_c::{
    mjtCamera, mjtCatBit, mjtRndFlag, mjv_defaultCamera, mjv_defaultFreeCamera, mjv_defaultOption, mjv_defaultPerturb,
    mjv_defaultScene, mjv_freeScene, mjv_makeScene, mjvCamera, mjvOption, mjvPerturb, mjvScene,
};
use mujoco_rs::wrappers::MjModel;
use std::mem::MaybeUninit;
use swm_core::Result;

/// The number of geoms that a scene has room for in addition to the geoms and sites of the model.
const EXTRA_GEOMS: usize = 1000;

/// A scene with camera and options, reused from frame to frame.
pub(crate) struct AbstractScene {
    scene: Box<mjvScene>,
    option: mjvOption,
    perturb: mjvPerturb,
    camera: mjvCamera,
}

// SAFETY: the pointers in a scene refer to memory that this scene owns exclusively.
unsafe impl Send for AbstractScene {}

impl AbstractScene {
    /// An empty scene for models of these sizes, with MuJoCo's default visual options.
    pub fn new(model: &MjModel) -> Self {
        let geoms = model.ffi().ngeom + model.ffi().nsite;
        let max_geoms = usize::try_from(geoms).unwrap_or(0) + EXTRA_GEOMS;
        let mut scene = Box::new_uninit();
        let (mut option, mut perturb, mut camera) =
            (MaybeUninit::uninit(), MaybeUninit::uninit(), MaybeUninit::uninit());
        // SAFETY: each function initialises its argument; the scene is set to defaults before it is allocated.
        unsafe {
            mjv_defaultScene(scene.as_mut_ptr());
            mjv_makeScene(model.ffi(), scene.as_mut_ptr(), i32::try_from(max_geoms).unwrap_or(i32::MAX));
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

    /// Fills the scene from the present state, for a camera. `by_geom` colours each geom by its index.
    ///
    /// # Errors
    /// When MuJoCo fails.
    pub fn update(&mut self, physics: &mut Physics, camera: Camera, by_geom: bool) -> Result<()> {
        match camera {
            Camera::Fixed(index) => {
                self.camera.type_ = mjtCamera::mjCAMERA_FIXED as i32;
                self.camera.fixedcamid = i32::try_from(index).unwrap_or(-1);
            }
            Camera::Free => {
                // SAFETY: model and camera are valid.
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
        let (model, data) = physics.pointers();
        // SAFETY: model and data belong together; the scene was allocated for models of these sizes.
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

    /// The scene of the last [`AbstractScene::update`].
    pub fn scene(&mut self) -> &mut mjvScene {
        &mut self.scene
    }
}

impl Drop for AbstractScene {
    fn drop(&mut self) {
        // SAFETY: `new` allocated the scene, and no other owner exists.
        unsafe { mjv_freeScene(&raw mut *self.scene) };
    }
}
