//! [`ModelIndex`]: indices of the named elements of a model.

use mujoco_rs::wrappers::MjModel;
use mujoco_rs::wrappers::mj_model::MjtObjBase;
use swm_core::{Error, Result};

/// Looks up elements of a model by name. Every method fails if the model has no element with this name.
pub struct ModelIndex<'a>(pub &'a MjModel);

impl ModelIndex<'_> {
    fn id(&self, kind: MjtObjBase, kind_name: &str, name: &str) -> Result<usize> {
        self.0.name_to_id(kind, name).ok_or_else(|| {
            Error::mismatch(
                "loading a dm_control suite model",
                format!("a file without the {kind_name} '{name}'"),
                "the pinned files (`swm assets verify dm_control` checks them)",
            )
        })
    }

    /// The index of a body.
    pub fn body(&self, name: &str) -> Result<usize> {
        self.id(MjtObjBase::mjOBJ_BODY, "body", name)
    }

    /// The index of a geom.
    pub fn geom(&self, name: &str) -> Result<usize> {
        self.id(MjtObjBase::mjOBJ_GEOM, "geom", name)
    }

    /// The index of a site.
    pub fn site(&self, name: &str) -> Result<usize> {
        self.id(MjtObjBase::mjOBJ_SITE, "site", name)
    }

    /// The index of a joint.
    pub fn joint(&self, name: &str) -> Result<usize> {
        self.id(MjtObjBase::mjOBJ_JOINT, "joint", name)
    }

    /// The first index of a joint's coordinates in `qpos`.
    pub fn qpos(&self, joint: &str) -> Result<usize> {
        Ok(self.0.jnt_qposadr()[self.joint(joint)?] as usize)
    }

    /// The first index of a joint's velocities in `qvel`.
    pub fn qvel(&self, joint: &str) -> Result<usize> {
        Ok(self.0.jnt_dofadr()[self.joint(joint)?] as usize)
    }

    /// The first index of a sensor's values in `sensordata`.
    pub fn sensor(&self, name: &str) -> Result<usize> {
        Ok(self.0.sensor_adr()[self.id(MjtObjBase::mjOBJ_SENSOR, "sensor", name)?] as usize)
    }
}
