//! The functions of MuJoCo that may end in an error while a world runs, declared so that [`crate::link::guard`] can catch it.
//!
//! `mujoco-rs` declares them `extern "C"`, through which nothing may unwind.
#![allow(unsafe_code, reason = "declarations of foreign functions")]

use mujoco_rs::mujoco_c::{mjData, mjModel, mjrContext, mjrRect, mjvCamera, mjvOption, mjvPerturb, mjvScene};
use std::ffi::c_int;

unsafe extern "C-unwind" {
    pub fn mj_step(m: *const mjModel, d: *mut mjData);
    pub fn mj_step1(m: *const mjModel, d: *mut mjData);
    pub fn mj_step2(m: *const mjModel, d: *mut mjData);
    pub fn mj_rnePostConstraint(m: *const mjModel, d: *mut mjData);
    pub fn mj_forward(m: *const mjModel, d: *mut mjData);
    pub fn mj_resetData(m: *const mjModel, d: *mut mjData);
    pub fn mj_setConst(m: *mut mjModel, d: *mut mjData);
    pub fn mj_copyModel(dest: *mut mjModel, src: *const mjModel) -> *mut mjModel;

    pub fn mjv_updateScene(
        m: *const mjModel,
        d: *mut mjData,
        opt: *const mjvOption,
        pert: *const mjvPerturb,
        cam: *mut mjvCamera,
        catmask: c_int,
        scn: *mut mjvScene,
    );

    pub fn mjr_makeContext(m: *const mjModel, con: *mut mjrContext, fontscale: c_int);
    pub fn mjr_freeContext(con: *mut mjrContext);
    pub fn mjr_resizeOffscreen(width: c_int, height: c_int, con: *mut mjrContext);
    pub fn mjr_setBuffer(framebuffer: c_int, con: *mut mjrContext);
    pub fn mjr_uploadTexture(m: *const mjModel, con: *const mjrContext, texid: c_int);
    pub fn mjr_render(viewport: mjrRect, scn: *mut mjvScene, con: *const mjrContext);
    pub fn mjr_readPixels(rgb: *mut u8, depth: *mut f32, viewport: mjrRect, con: *const mjrContext);
}
