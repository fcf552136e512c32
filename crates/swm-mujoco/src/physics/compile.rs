//! Compiling models, sharing them between environments, and finding their named elements.
#![allow(unsafe_code, reason = "the locale of a thread; mutable access to a model's equality constraints")]

use crate::link;
use libc::{LC_NUMERIC_MASK, freelocale, locale_t, newlocale, uselocale};
use mujoco_rs::error::MjEditError;
use mujoco_rs::mujoco_c::{mjNEQDATA, mjtEq};
use mujoco_rs::wrappers::mj_auxiliary::MjVfs;
use mujoco_rs::wrappers::mj_model::MjtObjBase;
use mujoco_rs::wrappers::{MjModel, MjSpec};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use swm_core::{Error, Result};

/// The memory that MuJoCo takes at most to compile a model without meshes.
pub const COMPILATION_BYTES: usize = 96 << 20;

/// The memory that MuJoCo takes at most to compile a model with the meshes of a robot.
const MESHES_BYTES: usize = 192 << 20;

/// Compiles a model from an MJCF file.
///
/// # Errors
/// When MuJoCo is not installed, or rejects the model (the error contains its message).
pub fn compile_file(path: &Path) -> Result<MjModel> {
    link::load_to_compile(MESHES_BYTES)?;
    MjModel::from_xml(path).map_err(|error| Error::external(format!("compiling {}", path.display()), error))
}

/// Compiles a model from MJCF text. `files` are the files that the text includes, by name; `label` names the model in
/// errors.
///
/// # Errors
/// When MuJoCo is not installed, or rejects the model (the error contains its message).
pub fn compile_xml(label: &str, xml: &str, files: &[(&str, &[u8])]) -> Result<MjModel> {
    link::load_to_compile(COMPILATION_BYTES)?;
    let failed = |error: &dyn std::fmt::Display| Error::external(format!("compiling {label}"), error);
    let mut vfs = MjVfs::new();
    for (name, content) in files {
        vfs.add_from_buffer(name, content).map_err(|error| failed(&error))?;
    }
    vfs.add_from_buffer("model.xml", xml.as_bytes()).map_err(|error| failed(&error))?;
    MjModel::from_xml_vfs("model.xml", &vfs).map_err(|error| failed(&error))
}

/// Compiles a description whose meshes may be texts: their numbers have a decimal point, whatever the locale of the process.
///
/// # Errors
/// When MuJoCo rejects the description (the error contains its message).
pub fn compile_spec(spec: &mut MjSpec) -> Result<MjModel, MjEditError> {
    // Threads that MuJoCo starts would have the locale of the process.
    spec.compiler_mut().set_usethread(false);
    let _numbers = CLocale::enter();
    spec.compile()
}

/// The C locale, in this thread until it is dropped.
struct CLocale {
    before: locale_t,
    own: locale_t,
}

impl CLocale {
    /// Enters the locale; `None` without memory for it.
    fn enter() -> Option<Self> {
        // SAFETY: the name ends with a zero, and without a base a new locale is made, the C locale in every category.
        let own = unsafe { newlocale(LC_NUMERIC_MASK, c"C".as_ptr(), std::ptr::null_mut()) };
        if own.is_null() {
            return None;
        }
        // SAFETY: the locale is valid; it is freed only after this thread has left it, or here if it was not entered.
        let before = unsafe { uselocale(own) };
        if before.is_null() {
            // SAFETY: no thread uses the locale, which was made above.
            unsafe { freelocale(own) };
            return None;
        }
        Some(Self { before, own })
    }
}

impl Drop for CLocale {
    fn drop(&mut self) {
        // SAFETY: the thread had the earlier locale, which MuJoCo does not free.
        unsafe { uselocale(self.before) };
        // SAFETY: `enter` made this locale, and no thread uses it any more.
        unsafe { freelocale(self.own) };
    }
}

/// Returns the model with this name; the first call in this process compiles it.
///
/// # Errors
/// Returns the error of `compile`.
pub fn shared_model(name: &str, compile: impl FnOnce() -> Result<MjModel>) -> Result<Arc<MjModel>> {
    static MODELS: Mutex<BTreeMap<String, Arc<MjModel>>> = Mutex::new(BTreeMap::new());
    let mut models = MODELS.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(model) = models.get(name) {
        return Ok(Arc::clone(model));
    }
    let model = Arc::new(compile()?);
    models.insert(name.to_owned(), Arc::clone(&model));
    Ok(model)
}

/// Edits the data of every weld constraint: anchor (m), relative position (m), relative quaternion, torque scale.
pub(crate) fn edit_welds(model: &mut MjModel, edit: impl Fn(&mut [f64; mjNEQDATA as usize])) {
    let is_weld: Vec<bool> = model.eq_type().iter().map(|kind| *kind == mjtEq::mjEQ_WELD).collect();
    // SAFETY: the data of a weld contains no indices into other arrays, so any finite values are valid.
    let data = unsafe { model.eq_data_mut() };
    data.iter_mut().zip(is_weld).filter(|(_, weld)| *weld).for_each(|(data, _)| edit(data));
}

/// The index of a named element of a model.
///
/// # Errors
/// When the model has no element of this kind with this name.
pub fn index_of(model: &MjModel, kind: MjtObjBase, name: &str) -> Result<usize> {
    model.name_to_id(kind, name).ok_or_else(|| {
        let known = (0..).map_while(|i| model.id_to_name(kind, i));
        Error::unknown("MuJoCo model element", name, known, "`swm assets verify` checks the installed model files")
    })
}
