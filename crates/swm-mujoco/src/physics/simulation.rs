//! [`Physics`]: an editable copy of a compiled model, and its simulation state.
#![allow(unsafe_code, reason = "calls of MuJoCo's functions on the model and data that `Physics` owns")]

use super::appearance::Appearance;
use super::hooks::StepHooks;
use super::state_layout::STATE_FIELDS;
use crate::{ffi, link};
use mujoco_rs::mujoco_c::{mj_jacSite, mjContact, mjData, mjModel, mjtWarning};
use mujoco_rs::wrappers::{MjData, MjModel};
use std::sync::Arc;
use swm_core::{Error, Result};

/// The warnings of MuJoCo that report a diverged simulation.
const UNSTABLE: [mjtWarning; 4] =
    [mjtWarning::mjWARN_BADQPOS, mjtWarning::mjWARN_BADQVEL, mjtWarning::mjWARN_BADQACC, mjtWarning::mjWARN_BADCTRL];

/// Memory of a state beside that in its buffers, at most.
const STATE_BYTES: usize = 32 << 20;

/// The call that computed the derived quantities (poses, velocities, sensors) from `Physics::source_state`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Derivation {
    /// `mj_forward` on the state.
    Forward,
    /// `mj_forward` with actuators disabled, as DeepMind Control does after a reset.
    ForwardPassive,
    /// `mj_step` from the previous state: derived quantities lag the state by one step, as in Gymnasium.
    Step,
    /// `mj_step` from the previous state, then `mj_step1`: poses and velocities belong to the state, as in DeepMind
    /// Control.
    ControlStep,
}

/// An editable copy of a compiled model, and its simulation state.
pub struct Physics {
    pub(super) data: MjData<Box<MjModel>>,
    original: Arc<MjModel>,
    /// The state from which `derivation` computed the present state and derived quantities.
    pub(super) source_state: Vec<f64>,
    pub(super) derivation: Derivation,
    pub(super) unstable: bool,
    pub(super) hooks: Option<Arc<dyn StepHooks>>,
    /// Scratch memory for the contacts that the hooks return.
    pub(super) contacts: Vec<mjContact>,
    /// Whether the model may differ from `original`.
    edited: bool,
    appearance: Appearance,
    /// Whether the texture hashes of `appearance` may be out of date.
    textures_edited: bool,
}

impl Physics {
    /// Copies a compiled model and creates its initial state.
    ///
    /// # Errors
    /// When memory cannot be allocated.
    pub fn new(original: Arc<MjModel>) -> Result<Self> {
        let sizes = original.ffi();
        // The copy, the state, which is smaller than a model, and the state's scratch memory.
        let bytes = 2 * sizes.nbuffer + sizes.narena;
        link::check_memory("allocating a MuJoCo state", usize::try_from(bytes).unwrap_or(0) + STATE_BYTES)?;
        let copy = Box::new(MjModel::clone(&original));
        let data = MjData::try_new(copy).map_err(|error| Error::external("allocating a MuJoCo state", error))?;
        let mut physics = Self {
            source_state: vec![0.0; original.state_size(STATE_FIELDS)],
            data,
            derivation: Derivation::Forward,
            unstable: false,
            hooks: None,
            contacts: vec![],
            edited: false,
            appearance: Appearance::of_original(&original),
            textures_edited: false,
            original,
        };
        physics.forward();
        Ok(physics)
    }

    /// The compiled model, without edits.
    pub fn original(&self) -> &Arc<MjModel> {
        &self.original
    }

    /// The model with its edits.
    pub fn model(&self) -> &MjModel {
        self.data.model()
    }

    /// The model, for edits of values such as sizes, colours and masses. Callers must not change counts
    /// and addresses or replace the model.
    pub(crate) fn model_mut(&mut self) -> &mut MjModel {
        self.edited = true;
        // SAFETY: callers of this crate edit values, keep counts and addresses, and never replace the model.
        unsafe { self.data.model_mut() }
    }

    /// The state and the quantities derived from it.
    pub fn data(&self) -> &MjData<Box<MjModel>> {
        &self.data
    }

    /// The state, for edits; [`Physics::forward`] updates the derived quantities.
    pub fn data_mut(&mut self) -> &mut MjData<Box<MjModel>> {
        &mut self.data
    }

    /// Undoes every edit of the model.
    pub fn restore_model(&mut self) {
        if !std::mem::take(&mut self.edited) {
            return;
        }
        let original = std::ptr::from_ref(self.original.ffi());
        let (model, _) = self.pointers();
        // SAFETY: original and copy are valid models of equal sizes, and this `Physics` owns the copy.
        let copied = self.guarded("copying a model", || unsafe { ffi::mj_copyModel(model, original) });
        debug_assert!(copied.is_some(), "models of equal sizes");
    }

    /// Marks textures as edited. Required after every edit of texture data: renderers cache textures by content.
    pub(crate) fn mark_textures_edited(&mut self) {
        self.textures_edited = true;
    }

    /// Brings [`Physics::appearance`] up to date.
    pub(crate) fn refresh_appearance(&mut self) {
        if std::mem::take(&mut self.textures_edited) {
            self.appearance.update_textures(self.data.model(), &self.original);
        }
    }

    /// The identity of the model's meshes and textures, as of the last [`Physics::refresh_appearance`].
    pub(crate) fn appearance(&self) -> &Appearance {
        &self.appearance
    }

    /// Sets the colour of a geom and removes its material.
    pub(crate) fn set_geom_color(&mut self, geom: usize, rgb: [f32; 3]) {
        let model = self.model_mut();
        model.geom_rgba_mut()[geom][..3].copy_from_slice(&rgb);
        // SAFETY: -1 is MuJoCo's value for "no material".
        unsafe { model.geom_matid_mut()[geom] = -1 };
    }

    /// Recomputes the constants that MuJoCo derives from the reference pose. Required after edits of masses or sizes.
    pub fn set_const(&mut self) {
        let (model, data) = self.pointers();
        // SAFETY: model and data are valid, belong together, and are borrowed by this call alone.
        self.guarded("computing a model's constants", || unsafe { ffi::mj_setConst(model, data) });
    }

    /// Installs hooks for all following time steps.
    pub(crate) fn set_hooks(&mut self, hooks: Arc<dyn StepHooks>) {
        self.hooks = Some(hooks);
    }

    /// Linear (m/s) and angular (rad/s) velocity of a site: its Jacobian at the derived poses times the present `qvel`.
    ///
    /// # Panics
    /// When the model has no site with this index.
    pub fn site_velocity(&self, site: usize) -> ([f64; 3], [f64; 3]) {
        let sites = self.data.site_xpos().len();
        assert!(site < sites, "site {site} of {sites}: take the index from `index_of` on the same model");
        let velocities = self.data.qvel();
        // Models of up to 32 degrees of freedom need no allocation.
        let mut on_stack = [0.0; 6 * 32];
        let mut on_heap = vec![];
        let jacobian = match on_stack.get_mut(..6 * velocities.len()) {
            Some(on_stack) => on_stack,
            None => {
                on_heap.resize(6 * velocities.len(), 0.0);
                &mut on_heap[..]
            }
        };
        let (linear, angular) = jacobian.split_at_mut(3 * velocities.len());
        let site = site as i32;
        // SAFETY: both matrices have three rows of `nv` values, and the index was compared with the number of sites.
        unsafe { mj_jacSite(self.model().ffi(), self.data.ffi(), linear.as_mut_ptr(), angular.as_mut_ptr(), site) };
        let times_qvel = |matrix: &[f64]| {
            std::array::from_fn(|i| {
                let row = &matrix[i * velocities.len()..(i + 1) * velocities.len()];
                row.iter().zip(velocities).map(|(a, b)| a * b).sum()
            })
        };
        (times_qvel(linear), times_qvel(angular))
    }

    /// Whether the simulation diverged or failed since the last reset.
    pub fn is_unstable(&self) -> bool {
        self.unstable
    }

    /// Sets the instability flag if MuJoCo reported a diverged simulation.
    pub(super) fn check_stability(&mut self) {
        let warnings = self.data.warning();
        if !self.unstable && UNSTABLE.iter().any(|&kind| warnings[kind as usize].number > 0) {
            tracing::debug!("unstable physics at {} s", self.data.time());
            self.unstable = true;
        }
    }

    /// The pointers that MuJoCo's functions take. Later borrows of the model or the data end their validity for writing.
    pub(crate) fn pointers(&mut self) -> (*mut mjModel, *mut mjData) {
        // SAFETY: MuJoCo's functions, and the code of this crate that writes through the pointers, keep sizes and addresses.
        unsafe { (std::ptr::from_mut(self.data.model_mut().ffi_mut()), std::ptr::from_mut(self.data.ffi_mut())) }
    }

    /// Calls MuJoCo. After an error, the state is the initial one and the simulation counts as unstable.
    pub(super) fn guarded<T>(&mut self, doing: &str, call: impl FnOnce() -> T) -> Option<T> {
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
}
