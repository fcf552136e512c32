//! The functions of MuJoCo that may end in an error while a world runs, declared so that [`crate::link::guard`] can catch it.
//!
//! `mujoco-rs` declares them `extern "C"`, through which nothing may unwind.
#![allow(unsafe_code, reason = "declarations of foreign functions")]

use mujoco_rs::mujoco_c::{mjData, mjModel};

unsafe extern "C-unwind" {
    pub fn mj_step(m: *const mjModel, d: *mut mjData);
    pub fn mj_step1(m: *const mjModel, d: *mut mjData);
    pub fn mj_step2(m: *const mjModel, d: *mut mjData);
    pub fn mj_forward(m: *const mjModel, d: *mut mjData);
    pub fn mj_resetData(m: *const mjModel, d: *mut mjData);
    pub fn mj_setConst(m: *mut mjModel, d: *mut mjData);
    pub fn mj_copyModel(dest: *mut mjModel, src: *const mjModel) -> *mut mjModel;
}
