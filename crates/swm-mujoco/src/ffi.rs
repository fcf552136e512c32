//! Declarations of the MuJoCo functions that may fail while an environment runs, so that [`crate::link::guard`] can
//! catch the error.
//!
//! MuJoCo calls the log handler on an error; the handler of this crate unwinds. `mujoco-rs` declares the same functions
//! `extern "C"`, through which unwinding aborts the process. Names, arguments and requirements are those of MuJoCo's
//! API reference: model and data must be valid and belong together.
#![allow(unsafe_code, reason = "declarations of foreign functions")]

use mujoco_rs::mujoco_c::{
    mjContact, mjData, mjModel, mjrContext, mjrRect, mjvCamera, mjvOption, mjvPerturb, mjvScene,
};
use std::ffi::c_int;

unsafe extern "C-unwind" {
    pub fn mj_step(m: *const mjModel, d: *mut mjData);
    pub fn mj_step1(m: *const mjModel, d: *mut mjData);
    pub fn mj_step2(m: *const mjModel, d: *mut mjData);
    pub fn mj_rnePostConstraint(m: *const mjModel, d: *mut mjData);
    pub fn mj_forward(m: *const mjModel, d: *mut mjData);
    pub fn mj_resetData(m: *const mjModel, d: *mut mjData);
    pub fn mj_setConst(m: *mut mjModel, d: *mut mjData);
    pub fn mj_checkPos(m: *const mjModel, d: *mut mjData);
    pub fn mj_checkVel(m: *const mjModel, d: *mut mjData);
    pub fn mj_checkAcc(m: *const mjModel, d: *mut mjData);
    pub fn mj_kinematics(m: *const mjModel, d: *mut mjData);
    pub fn mj_comPos(m: *const mjModel, d: *mut mjData);
    pub fn mj_camlight(m: *const mjModel, d: *mut mjData);
    pub fn mj_flex(m: *const mjModel, d: *mut mjData);
    pub fn mj_tendon(m: *const mjModel, d: *mut mjData);
    pub fn mj_makeM(m: *const mjModel, d: *mut mjData);
    pub fn mj_factorM(m: *const mjModel, d: *mut mjData);
    pub fn mj_collision(m: *const mjModel, d: *mut mjData);
    pub fn mj_addContact(m: *const mjModel, d: *mut mjData, con: *const mjContact) -> c_int;
    pub fn mj_makeConstraint(m: *const mjModel, d: *mut mjData);
    pub fn mj_island(m: *const mjModel, d: *mut mjData);
    pub fn mj_projectConstraint(m: *const mjModel, d: *mut mjData);
    pub fn mj_transmission(m: *const mjModel, d: *mut mjData);
    pub fn mj_sensorPos(m: *const mjModel, d: *mut mjData);
    pub fn mj_fwdVelocity(m: *const mjModel, d: *mut mjData);
    pub fn mj_sensorVel(m: *const mjModel, d: *mut mjData);
    pub fn mj_fwdActuation(m: *const mjModel, d: *mut mjData);
    pub fn mj_fwdAcceleration(m: *const mjModel, d: *mut mjData);
    pub fn mj_fwdConstraint(m: *const mjModel, d: *mut mjData);
    pub fn mj_sensorAcc(m: *const mjModel, d: *mut mjData);
    pub fn mj_Euler(m: *const mjModel, d: *mut mjData);
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
