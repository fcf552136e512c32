//! The constants of the four tasks, and the initial state of their episodes. Values are those of `gymnasium-robotics`
//! 1.4.2 (`envs/fetch/`; Plappert et al. 2018, arXiv:1802.09464).

use super::compat_332::Compat332;
use crate::assets;
use crate::physics::{self, Physics, StepHooks, index_of};
use mujoco_rs::mujoco_c::mjtDisableBit;
use mujoco_rs::wrappers::MjModel;
use mujoco_rs::wrappers::mj_model::MjtObjBase;
use std::sync::{Arc, Mutex, PoisonError};
use swm_core::Result;

/// Time steps of 2 ms per action.
pub const SUBSTEPS: usize = 20;

/// Distance within which the goal is reached, in metres (`distance_threshold`).
pub const GOAL_TOLERANCE: f64 = 0.05;

/// The constants of a task.
pub struct TaskConfig {
    /// The file of the model.
    file: &'static str,
    /// Position of the robot's base along `x`, in metres.
    base: f64,
    /// Initial position of the object before it settles on the table, in metres.
    object: Option<[f64; 3]>,
    /// Whether the fingers stay closed (`block_gripper`).
    pub fingers_closed: bool,
    /// Offset added to the initial height of the gripper, in metres (`gripper_extra_height`).
    gripper_height: f64,
    /// Half the side of the square around the gripper in which the object starts, in metres (`obj_range`).
    pub object_range: f64,
    /// Half the side of the square around the gripper in which goals are drawn, in metres (`target_range`). Without an
    /// object, the goals are drawn in a cube.
    pub target_range: f64,
    /// Offset of goals along `x`, in metres (`target_offset`).
    pub target_offset: f64,
    /// Whether half of the goals are above the table (`target_in_the_air`).
    pub target_in_the_air: bool,
}

/// Reach: move the gripper to a point.
pub const REACH: TaskConfig = TaskConfig {
    file: "reach.xml",
    base: 0.4049,
    object: None,
    fingers_closed: true,
    gripper_height: 0.2,
    object_range: 0.15,
    target_range: 0.15,
    target_offset: 0.0,
    target_in_the_air: true,
};

/// Push: push a block to a point on the table.
pub const PUSH: TaskConfig = TaskConfig {
    file: "push.xml",
    base: 0.405,
    object: Some([1.25, 0.53, 0.4]),
    gripper_height: 0.0,
    target_in_the_air: false,
    ..REACH
};

/// Slide: hit a puck so that it slides to a point out of reach.
pub const SLIDE: TaskConfig = TaskConfig {
    file: "slide.xml",
    base: 0.05,
    object: Some([1.7, 1.1, 0.41]),
    gripper_height: -0.02,
    object_range: 0.1,
    target_range: 0.3,
    target_offset: 0.4,
    ..PUSH
};

/// PickAndPlace: lift a block and hold it at a point.
pub const PICK_AND_PLACE: TaskConfig = TaskConfig {
    file: "pick_and_place.xml",
    fingers_closed: false,
    gripper_height: 0.2,
    target_in_the_air: true,
    ..PUSH
};

/// The state in which episodes start: the gripper has moved over the table, and the object has settled.
pub struct Setup {
    /// The compiled model.
    pub model: Arc<MjModel>,
    /// Simulated time, in seconds.
    pub time: f64,
    /// Positions of all joints.
    pub qpos: Vec<f64>,
    /// Velocities of all joints.
    pub qvel: Vec<f64>,
    /// Position of the gripper, in metres.
    pub gripper: [f64; 3],
    /// Height of the object's centre, in metres; 0 without an object.
    pub object_height: f64,
    /// The compatibility mode with MuJoCo 3.3.2.
    pub hooks: Arc<dyn StepHooks>,
}

impl TaskConfig {
    /// Whether there is an object.
    pub fn has_object(&self) -> bool {
        self.object.is_some()
    }

    /// Returns the setup, which is simulated once per process.
    ///
    /// # Errors
    /// When MuJoCo or the models are not installed.
    pub fn setup(&self) -> Result<Arc<Setup>> {
        static SETUPS: Mutex<Vec<(&str, Arc<Setup>)>> = Mutex::new(vec![]);
        let mut setups = SETUPS.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, setup)) = setups.iter().find(|(file, _)| *file == self.file) {
            return Ok(Arc::clone(setup));
        }
        let setup = Arc::new(self.simulate_setup()?);
        setups.push((self.file, Arc::clone(&setup)));
        Ok(setup)
    }

    /// Compiles the model and simulates the initial state.
    fn simulate_setup(&self) -> Result<Setup> {
        let folder = assets::path("gymnasium-robotics")?.join("gymnasium_robotics/envs/assets/fetch");
        let mut model = physics::compile_file(&folder.join(self.file))?;
        // The weld holds the gripper at the pose of the mocap body. The compiled model has the relative pose of its
        // reference configuration.
        physics::edit_welds(&mut model, |data| data[..7].copy_from_slice(&[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]));
        // As in MuJoCo 3.3.2: one contact point per pair of meshes, and one constraint system, which decides when the
        // solver stops.
        model.opt_mut().disableflags |= mjtDisableBit::mjDSBL_MULTICCD as i32 | mjtDisableBit::mjDSBL_ISLAND as i32;
        let hooks: Arc<dyn StepHooks> = Arc::new(Compat332::new(&model)?);
        let mut physics = Physics::new(Arc::new(model))?;
        physics.set_hooks(Arc::clone(&hooks));
        let (site, object, slides) = {
            let model = physics.model();
            let at = |joint: &str| {
                let joint = index_of(model, MjtObjBase::mjOBJ_JOINT, joint)?;
                Ok(usize::try_from(model.jnt_qposadr()[joint]).unwrap_or(0))
            };
            let object = if self.has_object() { Some(at("object0:joint")?) } else { None };
            let slides = [at("robot0:slide0")?, at("robot0:slide1")?, at("robot0:slide2")?];
            (index_of(model, MjtObjBase::mjOBJ_SITE, "robot0:grip")?, object, slides)
        };
        let qpos = physics.data_mut().qpos_mut();
        for (at, value) in slides.into_iter().zip([self.base, 0.48, 0.0]) {
            qpos[at] = value;
        }
        if let (Some(at), Some([x, y, z])) = (object, self.object) {
            qpos[at..at + 7].copy_from_slice(&[x, y, z, 1.0, 0.0, 0.0, 0.0]);
        }
        physics.forward();
        let [x, y, z] = physics.data().site_xpos()[site];
        let data = physics.data_mut();
        data.mocap_pos_mut()[0] = [x - 0.498, y + 0.005, z - 0.431 + self.gripper_height];
        data.mocap_quat_mut()[0] = [1.0, 0.0, 1.0, 0.0];
        physics.step(10 * SUBSTEPS);
        let data = physics.data();
        let object_height = match object {
            Some(_) => data.site_xpos()[index_of(physics.model(), MjtObjBase::mjOBJ_SITE, "object0")?][2],
            None => 0.0,
        };
        Ok(Setup {
            model: Arc::clone(physics.original()),
            time: data.time(),
            qpos: data.qpos().to_vec(),
            qvel: data.qvel().to_vec(),
            gripper: data.site_xpos()[site],
            object_height,
            hooks,
        })
    }
}
