//! [`Objects`]: indices of cubes, buttons, drawer and window in a model, and functions that read and move them.

use super::config::{FixtureState, TableConfig};
use crate::Physics;
use crate::ogbench::arm::find;
use crate::ogbench::arm::pose::{IDENTITY, Pose, Quat, Vec3};
use mujoco_rs::mujoco_c::_mjtObjBase::{mjOBJ_BODY, mjOBJ_GEOM, mjOBJ_JOINT, mjOBJ_MATERIAL, mjOBJ_SITE};
use mujoco_rs::wrappers::MjModel;
use swm_core::{Error, Result};

/// The indices of a cube and the marker of its goal.
#[derive(Clone, Copy, Debug)]
pub struct Cube {
    /// The first index of the cube's free joint in `qpos`: position, then quaternion.
    pub qpos: usize,
    /// The first index of the cube's free joint in `qvel`.
    pub qvel: usize,
    /// Bodies of cube and marker.
    pub bodies: [usize; 2],
    /// Geoms of cube and marker.
    pub geoms: [usize; 2],
    /// The index of the marker among the mocap bodies.
    pub mocap: usize,
}

/// The indices of a slide joint.
#[derive(Clone, Copy, Debug)]
pub struct Slide {
    /// The index of the joint in `qpos`.
    pub qpos: usize,
    /// The index of the joint in `qvel`.
    pub qvel: usize,
}

/// The indices of a drawer or a window.
#[derive(Clone, Copy, Debug)]
pub struct Sliding {
    /// The joint; its position is the opening.
    pub slide: Slide,
    /// The sites of the handle and of the handle at the goal.
    pub handles: [usize; 2],
    /// The axis along which the goal site moves with the opening.
    pub axis: usize,
    /// The material of the handle.
    pub material: usize,
}

/// The indices of a button, which toggles a lock when pressed.
#[derive(Clone, Copy, Debug)]
pub struct Button {
    /// The joint; its position is negative when pressed.
    pub slide: Slide,
    /// The geom of the button's top, whose colour shows the lock.
    pub geom: usize,
    /// The site at the centre of the button's top.
    pub top: usize,
}

/// The indices of buttons, drawer and window.
#[derive(Clone, Copy, Debug)]
pub struct Fixtures {
    /// The button of the drawer's lock, then the button of the window's lock.
    pub buttons: [Button; 2],
    /// The drawer.
    pub drawer: Sliding,
    /// The window.
    pub window: Sliding,
}

/// The indices of all objects on a table.
#[derive(Clone, Debug)]
pub struct Objects {
    /// The cubes.
    pub cubes: Vec<Cube>,
    /// Buttons, drawer and window, in the scene only.
    pub fixtures: Option<Fixtures>,
}

/// The button position at which the lock toggles, in metres.
const PRESSED: f64 = -0.02;
/// Damping of drawer and window when locked and when unlocked, in N s/m.
const DAMPING: [f64; 2] = [1e6, 2.0];
/// The colour of unlocked fixtures.
const UNLOCKED_COLOR: [f32; 3] = [0.9; 3];

impl Objects {
    /// Finds the objects of a table in a model.
    ///
    /// # Errors
    /// When the model lacks an element.
    pub fn new(model: &MjModel, config: &TableConfig) -> Result<Self> {
        let id = |kind, name: &str| find(model, kind, name);
        let slide = |name: &str| {
            let joint = id(mjOBJ_JOINT, name)?;
            Ok(Slide { qpos: index(model.jnt_qposadr()[joint])?, qvel: index(model.jnt_dofadr()[joint])? })
        };
        let cube = |i: usize| {
            let Slide { qpos, qvel } = slide(&format!("object_joint_{i}"))?;
            let [body, marker] = [format!("object_{i}"), format!("object_target_{i}")];
            let bodies = [id(mjOBJ_BODY, &body)?, id(mjOBJ_BODY, &marker)?];
            let geoms = [id(mjOBJ_GEOM, &body)?, id(mjOBJ_GEOM, &format!("target_object_{i}"))?];
            Ok(Cube { qpos, qvel, bodies, geoms, mocap: index(model.body_mocapid()[bodies[1]])? })
        };
        let button = |i: usize| {
            Ok(Button {
                slide: slide(&format!("buttonbox_joint_{i}"))?,
                geom: id(mjOBJ_GEOM, &format!("btngeom_{i}"))?,
                top: id(mjOBJ_SITE, &format!("btntop_{i}"))?,
            })
        };
        let sliding = |name: &str, axis| {
            let site = |suffix| id(mjOBJ_SITE, &format!("{name}_handle_center{suffix}"));
            Ok(Sliding {
                slide: slide(&format!("{name}_slide"))?,
                handles: [site("")?, site("_target")?],
                axis,
                material: id(mjOBJ_MATERIAL, &format!("{name}_handle"))?,
            })
        };
        let fixtures = || -> Result<Fixtures> {
            Ok(Fixtures {
                buttons: [button(0)?, button(1)?],
                drawer: sliding("drawer", 1)?,
                window: sliding("window", 0)?,
            })
        };
        Ok(Self {
            cubes: (0..config.cubes).map(cube).collect::<Result<_>>()?,
            fixtures: if config.fixtures { Some(fixtures()?) } else { None },
        })
    }
}

/// Converts an index that MuJoCo stores as a signed integer.
fn index(value: i32) -> Result<usize> {
    usize::try_from(value).map_err(|error| Error::external("searching OGBench's model", error))
}

impl Cube {
    /// The position in a configuration, in metres.
    pub fn position(&self, qpos: &[f64]) -> Vec3 {
        [qpos[self.qpos], qpos[self.qpos + 1], qpos[self.qpos + 2]]
    }

    /// The orientation in a configuration.
    pub fn rotation(&self, qpos: &[f64]) -> Quat {
        std::array::from_fn(|i| qpos[self.qpos + 3 + i])
    }

    /// Sets the pose; the caller updates derived quantities.
    pub fn set_pose(&self, physics: &mut Physics, position: Vec3, rotation: Quat) {
        let qpos = &mut physics.data_mut().qpos_mut()[self.qpos..];
        qpos[..3].copy_from_slice(&position);
        qpos[3..7].copy_from_slice(&rotation);
    }

    /// Moves the marker's geom to the goal, relative to its mocap body at `body`. The body itself is part of the state,
    /// which must not depend on the goal.
    pub fn place_marker(&self, physics: &mut Physics, body: Pose, goal: Pose) {
        let identity = Pose { position: [0.0; 3], rotation: IDENTITY };
        let relative = if body == goal { identity } else { body.inverse().then(goal) };
        let model = physics.model_mut();
        model.geom_pos_mut()[self.geoms[1]] = relative.position;
        model.geom_quat_mut()[self.geoms[1]] = relative.rotation;
    }

    /// Shows or hides the marker.
    pub fn set_marker_visible(&self, physics: &mut Physics, visible: bool) {
        physics.model_mut().geom_rgba_mut()[self.geoms[1]][3] = if visible { 0.2 } else { 0.0 };
    }
}

impl Fixtures {
    /// The state of the fixtures in a configuration with these lock states.
    pub fn state(&self, qpos: &[f64], buttons: [u8; 2]) -> FixtureState {
        FixtureState { buttons, drawer: qpos[self.drawer.slide.qpos], window: qpos[self.window.slide.qpos] }
    }

    /// Sets the openings of drawer and window; the caller updates derived quantities.
    pub fn set_openings(&self, physics: &mut Physics, state: FixtureState) {
        let qpos = physics.data_mut().qpos_mut();
        qpos[self.drawer.slide.qpos] = state.drawer;
        qpos[self.window.slide.qpos] = state.window;
    }

    /// Sets damping and colours for these locks. A locked drawer or window hardly moves and has the colour of its lock.
    pub fn apply_locks(&self, physics: &mut Physics, buttons: [u8; 2], colors: &[[f32; 3]; 2]) {
        let model = physics.model_mut();
        for (i, sliding) in [self.drawer, self.window].into_iter().enumerate() {
            let color = if buttons[i] == 0 { colors[i] } else { UNLOCKED_COLOR };
            model.geom_rgba_mut()[self.buttons[i].geom][..3].copy_from_slice(&color);
            model.mat_rgba_mut()[sliding.material][..3].copy_from_slice(&color);
            model.dof_damping_mut()[sliding.slide.qvel] = DAMPING[usize::from(buttons[i])];
        }
    }

    /// Moves the goal sites of the handles.
    pub fn place_markers(&self, physics: &mut Physics, goal: FixtureState) {
        for (sliding, opening) in [(self.drawer, goal.drawer), (self.window, goal.window)] {
            physics.model_mut().site_pos_mut()[sliding.handles[1]][sliding.axis] = opening;
        }
    }

    /// The lock states after a step from configuration `before` to `qpos`: each button that was pressed toggles its
    /// lock.
    pub fn toggled(&self, buttons: [u8; 2], before: &[f64], qpos: &[f64]) -> [u8; 2] {
        std::array::from_fn(|i| {
            let at = self.buttons[i].slide.qpos;
            let pressed = before[at] > PRESSED && qpos[at] <= PRESSED;
            buttons[i] ^ u8::from(pressed)
        })
    }
}
