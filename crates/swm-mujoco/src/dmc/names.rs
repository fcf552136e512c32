//! Where the named parts of a model are in its arrays.

use mujoco_rs::wrappers::MjModel;
use mujoco_rs::wrappers::mj_model::MjtObjBase;
use swm_core::{Error, Result};

/// Places by name. All fail alike: when the model has no part of that name.
pub struct Names<'a>(pub &'a MjModel);

impl Names<'_> {
    fn id(&self, kind: MjtObjBase, what: &str, name: &str) -> Result<usize> {
        self.0.name_to_id(kind, name).ok_or_else(|| {
            Error::mismatch(
                "reading a model of the suite",
                format!("no {what} '{name}'"),
                format!("a {what} '{name}': `swm assets verify dm_control` checks the files"),
            )
        })
    }

    /// The place of a body.
    pub fn body(&self, name: &str) -> Result<usize> {
        self.id(MjtObjBase::mjOBJ_BODY, "body", name)
    }

    /// The place of a geom.
    pub fn geom(&self, name: &str) -> Result<usize> {
        self.id(MjtObjBase::mjOBJ_GEOM, "geom", name)
    }

    /// The place of a site.
    pub fn site(&self, name: &str) -> Result<usize> {
        self.id(MjtObjBase::mjOBJ_SITE, "site", name)
    }

    /// The place of a joint.
    pub fn joint(&self, name: &str) -> Result<usize> {
        self.id(MjtObjBase::mjOBJ_JOINT, "joint", name)
    }

    /// Where a joint's coordinates begin in `qpos`.
    pub fn position(&self, joint: &str) -> Result<usize> {
        Ok(self.0.jnt_qposadr()[self.joint(joint)?] as usize)
    }

    /// Where a joint's velocities begin in `qvel`.
    pub fn velocity(&self, joint: &str) -> Result<usize> {
        Ok(self.0.jnt_dofadr()[self.joint(joint)?] as usize)
    }

    /// Where a sensor's numbers begin in `sensordata`.
    pub fn sensor(&self, name: &str) -> Result<usize> {
        Ok(self.0.sensor_adr()[self.id(MjtObjBase::mjOBJ_SENSOR, "sensor", name)?] as usize)
    }
}
