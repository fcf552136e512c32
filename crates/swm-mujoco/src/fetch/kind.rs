//! What tells the four tasks apart. The numbers are those of `gymnasium-robotics` 1.4.2 (Plappert et al. 2018).

use super::era::Era;
use crate::assets;
use crate::physics::{self, Physics, Stages, place};
use mujoco_rs::mujoco_c::mjtDisableBit;
use mujoco_rs::wrappers::MjModel;
use mujoco_rs::wrappers::mj_model::MjtObjBase;
use std::sync::{Arc, Mutex, PoisonError};
use swm_core::Result;

/// Time steps of 2 ms while an action is applied.
pub const SUBSTEPS: usize = 20;

/// Within this distance of the goal, in metres, the goal is reached.
pub const NEAR: f64 = 0.05;

/// A task.
pub struct Kind {
    /// The file of its model.
    file: &'static str,
    /// Where the robot's base stands along `x`, in metres.
    base: f64,
    /// Where the object is put first; it then settles on the table.
    object: Option<[f64; 3]>,
    /// Whether the fingers are held shut.
    pub shut: bool,
    /// How much higher than the object's height the gripper begins, in metres.
    height: f64,
    /// Half the side of the square around the gripper where the object begins.
    pub object_range: f64,
    /// Half the side of the square (the cube, without an object) around the gripper where goals are.
    pub target_range: f64,
    /// By how much goals are further away along `x`.
    pub target_offset: f64,
    /// Whether half of the goals are in the air.
    pub target_in_the_air: bool,
}

/// Reach with the gripper.
pub const REACH: Kind = Kind {
    file: "reach.xml",
    base: 0.4049,
    object: None,
    shut: true,
    height: 0.2,
    object_range: 0.15,
    target_range: 0.15,
    target_offset: 0.0,
    target_in_the_air: true,
};

/// Push a block.
pub const PUSH: Kind = Kind {
    file: "push.xml",
    base: 0.405,
    object: Some([1.25, 0.53, 0.4]),
    height: 0.0,
    target_in_the_air: false,
    ..REACH
};

/// Strike a puck, so that it slides to a goal out of reach.
pub const SLIDE: Kind = Kind {
    file: "slide.xml",
    base: 0.05,
    object: Some([1.7, 1.1, 0.41]),
    height: -0.02,
    object_range: 0.1,
    target_range: 0.3,
    target_offset: 0.4,
    ..PUSH
};

/// Pick a block and hold it at the goal.
pub const PICK_AND_PLACE: Kind =
    Kind { file: "pick_and_place.xml", shut: false, height: 0.2, target_in_the_air: true, ..PUSH };

/// Where episodes begin: the robot has moved its gripper over the table, and the object has settled.
pub struct Setup {
    /// The model, compiled.
    pub model: Arc<MjModel>,
    /// Seconds that passed.
    pub time: f64,
    /// Coordinates.
    pub qpos: Vec<f64>,
    /// Velocities.
    pub qvel: Vec<f64>,
    /// Where the gripper is.
    pub gripper: [f64; 3],
    /// How high the object is, in metres; 0 without one.
    pub height: f64,
    /// The dynamics it has.
    pub era: Arc<dyn Stages>,
}

impl Kind {
    /// Whether there is an object.
    pub fn has_object(&self) -> bool {
        self.object.is_some()
    }

    /// The set-up, made once per process.
    ///
    /// # Errors
    /// When MuJoCo or the models are not installed.
    pub fn setup(&self) -> Result<Arc<Setup>> {
        static MADE: Mutex<Vec<(&str, Arc<Setup>)>> = Mutex::new(vec![]);
        let mut made = MADE.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, setup)) = made.iter().find(|(file, _)| *file == self.file) {
            return Ok(Arc::clone(setup));
        }
        let setup = Arc::new(self.make_setup()?);
        made.push((self.file, Arc::clone(&setup)));
        Ok(setup)
    }

    fn make_setup(&self) -> Result<Setup> {
        let folder = assets::path("gymnasium-robotics")?.join("gymnasium_robotics/envs/assets/fetch");
        let mut model = physics::compile_file(&folder.join(self.file))?;
        // The gripper is welded to where the mocap body is, not to where both are in the model's first pose.
        physics::edit_welds(&mut model, |data| data[..7].copy_from_slice(&[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]));
        // As then, only one point where meshes touch, and one system of all constraints, which tells when the solver stops.
        model.opt_mut().disableflags |= mjtDisableBit::mjDSBL_MULTICCD as i32 | mjtDisableBit::mjDSBL_ISLAND as i32;
        let era: Arc<dyn Stages> = Arc::new(Era::new(&model)?);
        let mut world = Physics::new(Arc::new(model))?;
        world.attend(Arc::clone(&era));
        let (site, object, slides) = {
            let model = world.model();
            let at = |joint: &str| {
                let joint = place(model, MjtObjBase::mjOBJ_JOINT, joint)?;
                Ok(usize::try_from(model.jnt_qposadr()[joint]).unwrap_or(0))
            };
            let object = if self.has_object() { Some(at("object0:joint")?) } else { None };
            let slides = [at("robot0:slide0")?, at("robot0:slide1")?, at("robot0:slide2")?];
            (place(model, MjtObjBase::mjOBJ_SITE, "robot0:grip")?, object, slides)
        };
        let qpos = world.data_mut().qpos_mut();
        for (at, value) in slides.into_iter().zip([self.base, 0.48, 0.0]) {
            qpos[at] = value;
        }
        if let (Some(at), Some([x, y, z])) = (object, self.object) {
            qpos[at..at + 7].copy_from_slice(&[x, y, z, 1.0, 0.0, 0.0, 0.0]);
        }
        world.forward();
        let [x, y, z] = world.data().site_xpos()[site];
        let data = world.data_mut();
        data.mocap_pos_mut()[0] = [x - 0.498, y + 0.005, z - 0.431 + self.height];
        data.mocap_quat_mut()[0] = [1.0, 0.0, 1.0, 0.0];
        world.step(10 * SUBSTEPS);
        let data = world.data();
        let height = match object {
            Some(_) => data.site_xpos()[place(world.model(), MjtObjBase::mjOBJ_SITE, "object0")?][2],
            None => 0.0,
        };
        Ok(Setup {
            model: Arc::clone(world.original()),
            time: data.time(),
            qpos: data.qpos().to_vec(),
            qvel: data.qvel().to_vec(),
            gripper: data.site_xpos()[site],
            height,
            era,
        })
    }
}
