//! [`Physics`]: one compiled model, edited for the episode, and the state that moves on it.
//!
//! A model is compiled once per process ([`shared`]) and copied for every world. A world edits its copy to apply factors of
//! variation; [`Physics::restore_model`] undoes all edits.
//!
//! **Instability.** Where the numbers run away, MuJoCo resets the state by itself and goes on; where it meets an error it would
//! exit. Both set [`Physics::is_unstable`], which stays set until the next reset, and a world ends its episode.
#![allow(unsafe_code, reason = "calls of MuJoCo's functions on the model and data that `Physics` owns")]

use crate::render::Look;
use crate::{ffi, link};
use mujoco_rs::mujoco_c::{mjData, mjModel, mjtDisableBit, mjtIntegrator, mjtState, mjtWarning};
use mujoco_rs::wrappers::mj_auxiliary::MjVfs;
use mujoco_rs::wrappers::{MjData, MjModel};
use std::collections::BTreeMap;
use std::hash::{DefaultHasher, Hasher};
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError, Weak};
use swm_core::{Error, Result};

/// What decides how a world goes on, in this order: time, `qpos`, `qvel`, `act`, `qacc_warmstart`, `ctrl`, `eq_active`,
/// `mocap_pos`, `mocap_quat`. MuJoCo's integration state, less the applied forces that no world uses.
const STATE: u32 = mjtState::mjSTATE_TIME as u32
    | mjtState::mjSTATE_QPOS as u32
    | mjtState::mjSTATE_QVEL as u32
    | mjtState::mjSTATE_ACT as u32
    | mjtState::mjSTATE_WARMSTART as u32
    | mjtState::mjSTATE_CTRL as u32
    | mjtState::mjSTATE_EQ_ACTIVE as u32
    | mjtState::mjSTATE_MOCAP_POS as u32
    | mjtState::mjSTATE_MOCAP_QUAT as u32;

/// The warnings that say that the numbers ran away.
const UNSTABLE: [mjtWarning; 4] =
    [mjtWarning::mjWARN_BADQPOS, mjtWarning::mjWARN_BADQVEL, mjtWarning::mjWARN_BADQACC, mjtWarning::mjWARN_BADCTRL];

/// Compiles a model from a file.
///
/// # Errors
/// When MuJoCo is not installed, or refuses the model (in its words).
pub fn compile_file(path: &Path) -> Result<MjModel> {
    link::load()?;
    MjModel::from_xml(path).map_err(|error| Error::external(format!("compiling {}", path.display()), error))
}

/// Compiles a model from XML text; `files` are what it refers to, by the names it uses.
///
/// # Errors
/// When MuJoCo is not installed, or refuses the model (in its words).
pub fn compile(what: &str, xml: &str, files: &[(&str, &[u8])]) -> Result<MjModel> {
    link::load()?;
    let failed = |error: &dyn std::fmt::Display| Error::external(format!("compiling {what}"), error);
    let mut disk = MjVfs::new();
    for (name, content) in files {
        disk.add_from_buffer(name, content).map_err(|error| failed(&error))?;
    }
    disk.add_from_buffer("model.xml", xml.as_bytes()).map_err(|error| failed(&error))?;
    MjModel::from_xml_vfs("model.xml", &disk).map_err(|error| failed(&error))
}

/// The model of that name, compiled by the first who asks for it in this process.
///
/// # Errors
/// Those of `compile`.
pub fn shared(name: &str, compile: impl FnOnce() -> Result<MjModel>) -> Result<Arc<MjModel>> {
    static MODELS: Mutex<BTreeMap<String, Arc<MjModel>>> = Mutex::new(BTreeMap::new());
    let mut models = MODELS.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(model) = models.get(name) {
        return Ok(Arc::clone(model));
    }
    let model = Arc::new(compile()?);
    models.insert(name.to_owned(), Arc::clone(&model));
    Ok(model)
}

/// A state of a model, at its beginning.
fn make_data(model: Box<MjModel>) -> Result<MjData<Box<MjModel>>> {
    MjData::try_new(model).map_err(|error| Error::external("making a MuJoCo state", error))
}

/// A number for an original model, never given to another one while the process lives.
fn group_of(original: &Arc<MjModel>) -> u64 {
    /// The models that have numbers, and the next number. A weak pointer keeps its address from being used again.
    static GROUPS: Mutex<(Vec<(Weak<MjModel>, u64)>, u64)> = Mutex::new((Vec::new(), 0));
    let mut groups = GROUPS.lock().unwrap_or_else(PoisonError::into_inner);
    let (known, next) = &mut *groups;
    known.retain(|(model, _)| model.strong_count() > 0);
    match known.iter().find(|(model, _)| model.as_ptr() == Arc::as_ptr(original)) {
        Some((_, number)) => *number,
        None => {
            known.push((Arc::downgrade(original), *next));
            *next += 1;
            *next - 1
        }
    }
}

/// The bytes of a texture.
fn texture(model: &MjModel, place: usize) -> &[u8] {
    let begin = usize::try_from(model.tex_adr()[place]).unwrap_or(0);
    let end = model.tex_adr().get(place + 1).map_or(model.tex_data().len(), |&next| usize::try_from(next).unwrap_or(0));
    &model.tex_data()[begin..end]
}

/// How the quantities derived from the state (poses, velocities, sensors) came about: what [`Physics::load`] repeats.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Settled {
    /// `mj_forward` on the state.
    Forward,
    /// The same with actuators switched off, as DeepMind Control does after a reset.
    Passive,
    /// `mj_step` from the state before: they lag the state by one step, as in Gymnasium.
    Step,
    /// `mj_step` from the state before, then `mj_step1`: poses and velocities are those of the state, as in
    /// DeepMind Control.
    Control,
}

/// A model and its state.
pub struct Physics {
    data: MjData<Box<MjModel>>,
    original: Arc<MjModel>,
    /// The state from which `settled` leads to the present one.
    before: Vec<f64>,
    settled: Settled,
    unstable: bool,
    /// Whether the model differs from the original.
    edited: bool,
    look: Look,
    /// Whether `look` may be out of date.
    repainted: bool,
    /// The model whose textures are the usual ones of the group: these have the number 0.
    usual: Arc<MjModel>,
}

impl Physics {
    /// A copy of a compiled model at its initial state.
    ///
    /// # Errors
    /// When there is no memory for it.
    pub fn new(original: Arc<MjModel>) -> Result<Self> {
        let copy = Box::new(MjModel::clone(&original));
        let mut physics = Self {
            before: vec![0.0; original.state_size(STATE)],
            data: make_data(copy)?,
            settled: Settled::Forward,
            unstable: false,
            edited: false,
            look: Look { group: group_of(&original), textures: vec![0; original.tex_adr().len()].into() },
            repainted: false,
            usual: Arc::clone(&original),
            original,
        };
        physics.forward();
        Ok(physics)
    }

    /// The model as compiled, before any edit.
    pub fn original(&self) -> &Arc<MjModel> {
        &self.original
    }

    /// The model.
    pub fn model(&self) -> &MjModel {
        self.data.model()
    }

    /// The model, to edit: sizes, colours, masses, never the number of anything, and never the model as a whole.
    pub(crate) fn model_mut(&mut self) -> &mut MjModel {
        self.edited = true;
        // SAFETY: this crate edits numbers in the model's arrays, and exchanges models in `replace_model` alone.
        unsafe { self.data.model_mut() }
    }

    /// The state and what is derived from it.
    pub fn data(&self) -> &MjData<Box<MjModel>> {
        &self.data
    }

    /// The state, to edit; [`Physics::forward`] makes the derived quantities follow.
    pub fn data_mut(&mut self) -> &mut MjData<Box<MjModel>> {
        &mut self.data
    }

    /// Undoes every edit of the model.
    pub fn restore_model(&mut self) {
        if !std::mem::take(&mut self.edited) {
            return;
        }
        let original = std::ptr::from_ref(self.original.ffi());
        let (model, _) = self.raw();
        // SAFETY: both are valid models of equal sizes, of which the first is ours alone.
        let copied = self.guarded("copying a model", || unsafe { ffi::mj_copyModel(model, original) });
        debug_assert!(copied.is_some(), "models of equal sizes");
    }

    /// Takes another compiled model in place of the original one: the same world from an edited description, with the same
    /// meshes and textures of the same sizes. Whoever changes densities or shapes needs one, because masses, inertias and
    /// textures are computed when a model is compiled. The state is the model's initial one.
    ///
    /// # Errors
    /// When there is no memory for its state.
    pub fn replace_model(&mut self, original: Arc<MjModel>) -> Result<()> {
        self.data = make_data(Box::new(MjModel::clone(&original)))?;
        self.before.resize(original.state_size(STATE), 0.0);
        self.original = original;
        (self.unstable, self.edited, self.repainted) = (false, false, true);
        self.forward();
        Ok(())
    }

    /// To be called after an edit of texture data, so that pictures follow.
    pub(crate) fn repaint(&mut self) {
        self.repainted = true;
    }

    /// Brings [`Physics::look`] up to date.
    pub(crate) fn refresh_look(&mut self) {
        if std::mem::take(&mut self.repainted) {
            let (model, usual) = (self.data.model(), &self.usual);
            let textures = (0..model.tex_adr().len()).map(|i| match (texture(model, i), texture(usual, i)) {
                (now, usual) if now == usual => 0,
                (now, _) => {
                    let mut hasher = DefaultHasher::new();
                    hasher.write(now);
                    hasher.finish().max(1)
                }
            });
            self.look.textures = textures.collect();
        }
    }

    /// What a renderer needs to know of the model.
    pub(crate) fn look(&self) -> &Look {
        &self.look
    }

    /// Recomputes what the model derives from its reference pose, after edits of masses or sizes.
    pub fn set_const(&mut self) {
        let (model, data) = self.raw();
        // SAFETY: both are valid, belong to each other, and are ours alone.
        self.guarded("computing a model's constants", || unsafe { ffi::mj_setConst(model, data) });
    }

    /// Puts the state to the model's initial one and forgets instability. Derived quantities are zero until
    /// [`Physics::forward`].
    pub fn reset(&mut self) {
        self.unstable = false;
        let (model, data) = self.raw();
        // SAFETY: both are valid and belong to each other.
        self.guarded("resetting", || unsafe { ffi::mj_resetData(model, data) });
    }

    /// Computes everything derived from the state, without time passing.
    pub fn forward(&mut self) {
        self.note(Settled::Forward);
        self.settle();
    }

    /// As [`Physics::forward`], with actuators switched off.
    pub fn forward_passive(&mut self) {
        self.note(Settled::Passive);
        self.settle();
    }

    /// Lets `steps` time steps pass, at least one, each `mj_step`: derived quantities lag the state by one step, as in Gymnasium.
    pub fn step(&mut self, steps: usize) {
        for _ in 1..steps {
            let (model, data) = self.raw();
            // SAFETY: both are valid and belong to each other.
            self.guarded("stepping", || unsafe { ffi::mj_step(model, data) });
        }
        self.note(Settled::Step);
        self.settle();
        self.notice();
    }

    /// Computes the forces on bodies (`cfrc_ext`) as they were in the last step. They are not kept by [`Physics::save`].
    pub fn contact_forces(&mut self) {
        let (model, data) = self.raw();
        // SAFETY: both are valid and belong to each other.
        self.guarded("computing contact forces", || unsafe { ffi::mj_rnePostConstraint(model, data) });
    }

    /// Lets `steps` time steps pass, at least one, as DeepMind Control does: the first half of the first step, up to where
    /// controls enter, was computed by the call before, and poses and velocities are up to date afterwards.
    pub fn step_control(&mut self, steps: usize) {
        let whole = self.model().opt().integrator == mjtIntegrator::mjINT_RK4 as i32;
        for i in 0..steps {
            if i + 1 == steps {
                self.note(Settled::Control);
            }
            let (model, data) = self.raw();
            // SAFETY: both are valid and belong to each other.
            self.guarded("stepping", || unsafe {
                if i == 0 && !whole {
                    ffi::mj_step2(model, data);
                } else {
                    ffi::mj_step(model, data);
                }
            });
        }
        let (model, data) = self.raw();
        // SAFETY: as above.
        self.guarded("stepping", || unsafe { ffi::mj_step1(model, data) });
        self.notice();
    }

    /// Remembers the state as the one from which `settled` leads on.
    fn note(&mut self, settled: Settled) {
        self.data.read_state_into(STATE, &mut self.before);
        self.settled = settled;
    }

    /// Does what `settled` says.
    fn settle(&mut self) {
        let (model, data) = self.raw();
        // SAFETY: both are valid and belong to each other; the flag is put back.
        match self.settled {
            Settled::Forward => {
                self.guarded("computing derived quantities", || unsafe { ffi::mj_forward(model, data) })
            }
            Settled::Passive => self.guarded("computing derived quantities", || unsafe {
                let flags = (*model).opt.disableflags;
                (*model).opt.disableflags |= mjtDisableBit::mjDSBL_ACTUATION as i32;
                ffi::mj_forward(model, data);
                (*model).opt.disableflags = flags;
            }),
            Settled::Step => self.guarded("stepping", || unsafe { ffi::mj_step(model, data) }),
            Settled::Control => self.guarded("stepping", || unsafe {
                ffi::mj_step(model, data);
                ffi::mj_step1(model, data);
            }),
        };
    }

    /// The pointers MuJoCo wants.
    pub(crate) fn raw(&mut self) -> (*mut mjModel, *mut mjData) {
        // SAFETY: the pointers are used for calls of MuJoCo alone, one after the other.
        unsafe { (std::ptr::from_mut(self.data.model_mut().ffi_mut()), std::ptr::from_mut(self.data.ffi_mut())) }
    }

    /// Calls MuJoCo; an error leaves the world unstable, at its initial state.
    fn guarded<T>(&mut self, doing: &str, call: impl FnOnce() -> T) -> Option<T> {
        match link::guard(doing, call) {
            Ok(value) => Some(value),
            Err(error) => {
                tracing::warn!("{error}");
                self.data.reset();
                self.unstable = true;
                None
            }
        }
    }

    /// Looks whether the numbers ran away.
    fn notice(&mut self) {
        let warnings = self.data.warning();
        if !self.unstable && UNSTABLE.iter().any(|&kind| warnings[kind as usize].number > 0) {
            tracing::debug!("unstable physics at {} s", self.data.time());
            self.unstable = true;
        }
    }

    /// Whether the numbers ran away since the last reset.
    pub fn is_unstable(&self) -> bool {
        self.unstable
    }

    /// Numbers of [`Physics::state`].
    pub fn state_len(&self) -> usize {
        self.before.len()
    }

    /// Writes the state: time, `qpos`, `qvel`, `act`, `qacc_warmstart`, `ctrl`, `eq_active`, `mocap_pos`, `mocap_quat`.
    ///
    /// # Panics
    /// When there is less place than [`Physics::state_len`].
    pub fn state(&self, into: &mut [f64]) {
        self.data.read_state_into(STATE, into);
    }

    /// Puts a state of [`Physics::state`], and computes what is derived from it.
    ///
    /// # Errors
    /// When it has another length, or a number is not finite.
    pub fn set_state(&mut self, state: &[f64]) -> Result<()> {
        self.put(state)?;
        self.forward();
        Ok(())
    }

    fn put(&mut self, state: &[f64]) -> Result<()> {
        if state.len() != self.state_len() {
            let (given, expected) = (state.len().to_string(), format!("{} numbers", self.state_len()));
            return Err(Error::mismatch("restoring a MuJoCo state", given, expected));
        }
        if let Some(place) = state.iter().position(|value| !value.is_finite()) {
            return Err(Error::NotFinite {
                what: "a MuJoCo state".to_owned(),
                given: format!("{} at place {place}", state[place]),
                fix: "take it from the `state` column of a row that was recorded".to_owned(),
            });
        }
        self.reset();
        self.data.set_state(state, STATE).map_err(|error| Error::external("restoring a MuJoCo state", error))
    }

    /// Numbers of `qpos` and `qvel`.
    pub fn pose_len(&self) -> usize {
        self.data.qpos().len() + self.data.qvel().len()
    }

    /// Puts `qpos` and `qvel`, leaves the rest of the state, and computes what is derived from it.
    ///
    /// # Errors
    /// When it has another length, or a number is not finite.
    pub fn set_pose(&mut self, pose: &[f64]) -> Result<()> {
        let mut state = vec![0.0; self.state_len()];
        self.state(&mut state);
        match state.get_mut(1..=self.pose_len()).filter(|place| place.len() == pose.len()) {
            Some(place) => place.copy_from_slice(pose),
            None => {
                let (given, expected) = (format!("{} numbers", pose.len()), self.pose_len().to_string());
                return Err(Error::mismatch("putting qpos and qvel", given, expected));
            }
        }
        self.set_state(&state)
    }

    /// Numbers of [`Physics::save`].
    pub fn saved_len(&self) -> usize {
        self.before.len() + 2
    }

    /// Appends the state and how the derived quantities came about, so that [`Physics::load`] brings both back bit for bit.
    pub fn save(&self, into: &mut Vec<f64>) {
        into.push(f64::from(u8::from(self.unstable)));
        into.push(f64::from(self.settled as u8));
        into.extend(&self.before);
    }

    /// The state in what [`Physics::save`] wrote: the one from which the derived quantities came about.
    pub(crate) fn saved_state(saved: &mut [f64]) -> &mut [f64] {
        saved.get_mut(2..).unwrap_or_default()
    }

    /// Puts back what [`Physics::save`] wrote, on the same model with the same edits.
    ///
    /// # Errors
    /// When these are not such numbers.
    pub fn load(&mut self, saved: &[f64]) -> Result<()> {
        let kinds = [Settled::Forward, Settled::Passive, Settled::Step, Settled::Control];
        let parts = saved.split_first_chunk::<2>();
        let known = parts.and_then(|(&[unstable, kind], state)| {
            let kind = kinds.into_iter().find(|&known| f64::from(known as u8) == kind)?;
            Some((unstable != 0.0, kind, state))
        });
        let Some((unstable, settled, state)) = known else {
            return Err(Error::mismatch("restoring a MuJoCo state", format!("{saved:?}"), "what `save` wrote"));
        };
        self.put(state)?;
        self.note(settled);
        self.settle();
        self.notice();
        self.unstable |= unstable;
        Ok(())
    }
}
