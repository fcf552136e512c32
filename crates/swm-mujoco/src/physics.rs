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
use mujoco_rs::mujoco_c::{
    mj_jacSite, mjContact, mjData, mjModel, mjNEQDATA, mjtConstraint, mjtDisableBit, mjtEq, mjtIntegrator, mjtState,
    mjtWarning,
};
use mujoco_rs::wrappers::mj_auxiliary::MjVfs;
use mujoco_rs::wrappers::mj_model::MjtObjBase;
use mujoco_rs::wrappers::{MjData, MjModel};
use std::collections::BTreeMap;
use std::hash::{DefaultHasher, Hasher};
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
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

/// Numbers of a state of this model ([`Physics::state`]).
pub fn state_len(model: &MjModel) -> usize {
    model.state_size(STATE)
}

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

/// Edits the numbers of every weld of a model: anchor, relative place, relative turn, torque scale.
pub(crate) fn edit_welds(model: &mut MjModel, edit: impl Fn(&mut [f64; mjNEQDATA as usize])) {
    let welds: Vec<bool> = model.eq_type().iter().map(|kind| *kind == mjtEq::mjEQ_WELD).collect();
    // SAFETY: the data of welds holds no places of anything else.
    let data = unsafe { model.eq_data_mut() };
    data.iter_mut().zip(welds).filter(|(_, weld)| *weld).for_each(|(data, _)| edit(data));
}

/// An array that MuJoCo keeps.
///
/// # Safety
/// There must be `count` values, and they must not change while they are borrowed.
unsafe fn array<'a, T>(first: *const T, count: i32) -> &'a [T] {
    let count = usize::try_from(count).unwrap_or(0);
    // SAFETY: the caller's promise; where there is none, there is nothing to point to.
    if first.is_null() || count == 0 { &[] } else { unsafe { std::slice::from_raw_parts(first, count) } }
}

/// A state of a model, at its beginning.
fn make_data(model: Box<MjModel>) -> Result<MjData<Box<MjModel>>> {
    MjData::try_new(model).map_err(|error| Error::external("making a MuJoCo state", error))
}

/// Copies what [`STATE`] names, in its order. MuJoCo's own function for it goes through all that a state may hold: in a small
/// world that is a fiftieth of a step.
fn copy_state(data: &MjData<Box<MjModel>>, into: &mut [f64]) {
    let mut rest = into;
    let mut put = |numbers: &[f64]| {
        let (here, after) = std::mem::take(&mut rest).split_at_mut(numbers.len());
        here.copy_from_slice(numbers);
        rest = after;
    };
    put(&[data.time()]);
    put(data.qpos());
    put(data.qvel());
    put(data.act());
    put(data.qacc_warmstart());
    put(data.ctrl());
    data.eq_active().iter().for_each(|&active| put(&[f64::from(u8::from(active))]));
    put(data.mocap_pos().as_flattened());
    put(data.mocap_quat().as_flattened());
}

/// Refuses numbers that are not finite.
fn finite(state: &[f64]) -> Result<()> {
    match state.iter().position(|value| !value.is_finite()) {
        None => Ok(()),
        Some(place) => Err(Error::NotFinite {
            what: "a MuJoCo state".to_owned(),
            given: format!("{} at place {place}", state[place]),
            fix: "take it from the `state` column of a row that was recorded".to_owned(),
        }),
    }
}

/// A number for an original model, never given to another one while the process lives.
fn group_of(original: &Arc<MjModel>) -> u64 {
    /// The models that have numbers, by number. A weak pointer keeps its address from being used again.
    static GROUPS: Mutex<BTreeMap<u64, Weak<MjModel>>> = Mutex::new(BTreeMap::new());
    static NEXT: AtomicU64 = AtomicU64::new(0);
    let mut groups = GROUPS.lock().unwrap_or_else(PoisonError::into_inner);
    groups.retain(|_, model| model.strong_count() > 0);
    let known = groups.iter().find(|(_, model)| model.as_ptr() == Arc::as_ptr(original)).map(|(number, _)| *number);
    known.unwrap_or_else(|| {
        let number = NEXT.fetch_add(1, Ordering::Relaxed);
        groups.insert(number, Arc::downgrade(original));
        number
    })
}

/// The bytes of a texture.
fn texture(model: &MjModel, place: usize) -> &[u8] {
    let begin = usize::try_from(model.tex_adr()[place]).unwrap_or(0);
    let end = model.tex_adr().get(place + 1).map_or(model.tex_data().len(), |&next| usize::try_from(next).unwrap_or(0));
    &model.tex_data()[begin..end]
}

/// The place of a named thing in a model.
///
/// # Errors
/// When the model has none of that name.
pub fn place(model: &MjModel, kind: MjtObjBase, name: &str) -> Result<usize> {
    model.name_to_id(kind, name).ok_or_else(|| {
        let known = (0..).map_while(|i| model.id_to_name(kind, i));
        Error::unknown("part of a MuJoCo model", name, known, "the model is not the one this program was written for")
    })
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

/// Places and orientations (row after row) of all geoms.
pub(crate) type Poses<'a> = (&'a [[f64; 3]], &'a [[f64; 9]]);

/// An equality constraint's row, as it is when its reference acceleration is due.
pub(crate) struct Row {
    /// Stiffness, damping, impedance, and the impedance's slope.
    pub kbip: [f64; 4],
    /// How far it is violated.
    pub position: f64,
    /// From where on it acts.
    pub margin: f64,
    /// How fast.
    pub velocity: f64,
}

/// Takes part in every time step, between the stages MuJoCo goes through. For worlds without activations, flexes and tendons,
/// integrated by Euler's method.
pub(crate) trait Stages: Send + Sync {
    /// Given the contacts that were found, those of a pair of geoms in a row, appends the contacts there should be.
    fn collided(&self, model: &MjModel, poses: Poses<'_>, found: &[mjContact], contacts: &mut Vec<mjContact>);

    /// The reference acceleration of an equality constraint.
    fn referred(&self, row: &Row) -> f64;
}

/// A model and its state.
pub struct Physics {
    data: MjData<Box<MjModel>>,
    original: Arc<MjModel>,
    /// The state from which `settled` leads to the present one.
    before: Vec<f64>,
    settled: Settled,
    unstable: bool,
    stages: Option<Arc<dyn Stages>>,
    /// Reused for contacts between stages.
    contacts: Vec<mjContact>,
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
            stages: None,
            contacts: vec![],
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
            self.whole_step();
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
        copy_state(&self.data, &mut self.before);
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
            Settled::Step => self.whole_step(),
            Settled::Control => self.guarded("stepping", || unsafe {
                ffi::mj_step(model, data);
                ffi::mj_step1(model, data);
            }),
        };
    }

    /// One time step.
    fn whole_step(&mut self) -> Option<()> {
        let (model, data) = self.raw();
        let Some(stages) = self.stages.clone() else {
            // SAFETY: both are valid and belong to each other.
            return self.guarded("stepping", || unsafe { ffi::mj_step(model, data) });
        };
        // SAFETY: as above; the stages are those of `mj_step`, in their order.
        self.guarded("stepping", || unsafe {
            ffi::mj_checkPos(model, data);
            ffi::mj_checkVel(model, data);
        })?;
        self.staged(&*stages)?;
        // SAFETY: as above.
        self.guarded("stepping", || unsafe {
            ffi::mj_checkAcc(model, data);
            ffi::mj_Euler(model, data);
        })
    }

    /// What `mj_forward` does, with somebody taking part between the stages.
    fn staged(&mut self, stages: &dyn Stages) -> Option<()> {
        let (model, data) = self.raw();
        // SAFETY, here and below: model and data are valid and belong to each other; stages come in the order of `mj_forward`.
        self.guarded("computing poses", || unsafe {
            ffi::mj_kinematics(model, data);
            ffi::mj_comPos(model, data);
            ffi::mj_camlight(model, data);
            ffi::mj_flex(model, data);
            ffi::mj_tendon(model, data);
            ffi::mj_makeM(model, data);
            ffi::mj_factorM(model, data);
            ffi::mj_collision(model, data);
        })?;
        self.contacts.clear();
        let poses = (self.data.geom_xpos(), self.data.geom_xmat());
        // SAFETY: there are as many contacts as it says.
        let found = unsafe { array((*data).contact, (*data).ncon) };
        stages.collided(self.data.model(), poses, found, &mut self.contacts);
        let contacts = std::mem::take(&mut self.contacts);
        let done = self.guarded("computing constraints", || unsafe {
            // Those that fit take the places of those that were found; MuJoCo makes room for others.
            let found = usize::try_from((*data).ncon).unwrap_or(0);
            let (fitting, more) = contacts.split_at(contacts.len().min(found));
            for (place, contact) in fitting.iter().enumerate() {
                (*data).contact.add(place).write(contact.clone());
            }
            (*data).ncon = i32::try_from(fitting.len()).unwrap_or(0);
            for contact in more {
                ffi::mj_addContact(model, data, contact);
            }
            ffi::mj_makeConstraint(model, data);
            ffi::mj_island(model, data);
            ffi::mj_projectConstraint(model, data);
            ffi::mj_transmission(model, data);
            ffi::mj_sensorPos(model, data);
            ffi::mj_fwdVelocity(model, data);
            ffi::mj_sensorVel(model, data);
            for (row, kind) in array((*data).efc_type, (*data).nefc).iter().enumerate() {
                if *kind == mjtConstraint::mjCNSTR_EQUALITY as i32 {
                    let at = |numbers: *mut f64| *numbers.add(row);
                    let row_now = Row {
                        kbip: *(*data).efc_KBIP.add(4 * row).cast(),
                        position: at((*data).efc_pos),
                        margin: at((*data).efc_margin),
                        velocity: at((*data).efc_vel),
                    };
                    *(*data).efc_aref.add(row) = stages.referred(&row_now);
                }
            }
            ffi::mj_fwdActuation(model, data);
            ffi::mj_fwdAcceleration(model, data);
            ffi::mj_fwdConstraint(model, data);
            ffi::mj_sensorAcc(model, data);
        });
        self.contacts = contacts;
        done
    }

    /// Lets somebody take part in every time step from now on.
    pub(crate) fn attend(&mut self, stages: Arc<dyn Stages>) {
        self.stages = Some(stages);
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

    /// Draws a geom in a colour of its own from now on, not in that of its material.
    pub(crate) fn paint(&mut self, geom: usize, rgb: [f32; 3]) {
        let model = self.model_mut();
        model.geom_rgba_mut()[geom][..3].copy_from_slice(&rgb);
        // SAFETY: -1 says that there is no material.
        unsafe { model.geom_matid_mut()[geom] = -1 };
    }

    /// Linear and angular velocity of a site, in metres and radians a second: its Jacobian, at the poses as they were
    /// derived, times the present `qvel`.
    pub fn site_velocity(&self, site: usize) -> ([f64; 3], [f64; 3]) {
        let velocities = self.data.qvel();
        let mut here = [0.0; 6 * 32];
        let mut there = vec![];
        let jacobian = match here.get_mut(..6 * velocities.len()) {
            Some(here) => here,
            None => {
                there.resize(6 * velocities.len(), 0.0);
                &mut there[..]
            }
        };
        let (linear, angular) = jacobian.split_at_mut(3 * velocities.len());
        // SAFETY: there is room for two matrices of three rows, and the model knows the site.
        unsafe {
            let site = i32::try_from(site).unwrap_or(0);
            mj_jacSite(self.model().ffi(), self.data.ffi(), linear.as_mut_ptr(), angular.as_mut_ptr(), site);
        }
        let times = |matrix: &[f64]| {
            std::array::from_fn(|i| {
                let row = &matrix[i * velocities.len()..(i + 1) * velocities.len()];
                row.iter().zip(velocities).map(|(a, b)| a * b).sum()
            })
        };
        (times(linear), times(angular))
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
        copy_state(&self.data, into);
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
        finite(state)?;
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
        if pose.len() != self.pose_len() {
            let (given, expected) = (format!("{} numbers", pose.len()), self.pose_len().to_string());
            return Err(Error::mismatch("putting qpos and qvel", given, expected));
        }
        finite(pose)?;
        copy_state(&self.data, &mut self.before);
        self.before[1..=pose.len()].copy_from_slice(pose);
        self.reset();
        let put = self.data.set_state(&self.before, STATE);
        put.map_err(|error| Error::external("putting qpos and qvel", error))?;
        self.forward();
        Ok(())
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
    pub(crate) fn saved_state(saved: &[f64]) -> &[f64] {
        saved.get(2..).unwrap_or_default()
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

#[cfg(test)]
mod tests {
    use super::*;

    /// Something of every kind that a state holds.
    const MODEL: &str = r#"<mujoco><worldbody>
        <body name="led" mocap="true" pos="1 2 3" quat="0 1 0 0"/>
        <body name="free"><freejoint/><geom size="0.1"/></body>
        <body name="arm" pos="0 0 1"><joint name="hinge"/><geom size="0.1" pos="1 0 0"/></body>
    </worldbody>
    <equality><weld body1="led" body2="free" active="false"/><joint joint1="hinge"/></equality>
    <actuator><general joint="hinge" dyntype="integrator"/><motor joint="hinge"/></actuator></mujoco>"#;

    #[test]
    fn states_are_those_of_mujoco() {
        let model = compile("a test's model", MODEL, &[]).expect("a model");
        let mut physics = Physics::new(Arc::new(model)).expect("a state");
        physics.data_mut().ctrl_mut().copy_from_slice(&[0.5, -0.25]);
        physics.step(3);
        let (mut ours, mut theirs) = (vec![f64::NAN; physics.state_len()], vec![0.0; physics.state_len()]);
        physics.state(&mut ours);
        assert_eq!(physics.data().read_state_into(STATE, &mut theirs), ours.len());
        assert_eq!(ours, theirs);
        assert!([1, 2].map(|from_end| ours[ours.len() - 7 - from_end]) == [1.0, 0.0], "the welds: {ours:?}");
    }
}
