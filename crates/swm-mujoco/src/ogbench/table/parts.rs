//! Where cubes, buttons, drawer and window are in a model, and how they are read and moved.

use super::setup::{Fixed, Setup};
use crate::Physics;
use crate::ogbench::arm::find;
use crate::ogbench::arm::pose::{IDENTITY, Pose, Quat, Vec3};
use mujoco_rs::mujoco_c::_mjtObjBase::{mjOBJ_BODY, mjOBJ_GEOM, mjOBJ_JOINT, mjOBJ_MATERIAL, mjOBJ_SITE};
use mujoco_rs::wrappers::MjModel;
use swm_core::{Error, Result};

/// A cube and the marker of its goal.
#[derive(Clone, Copy, Debug)]
pub struct Cube {
    /// Its place in `qpos`: where it is, how it is turned.
    pub qpos: usize,
    /// Its place in `qvel`.
    pub qvel: usize,
    /// Bodies of cube and marker.
    pub bodies: [usize; 2],
    /// Geoms of cube and marker.
    pub geoms: [usize; 2],
    /// The marker among the bodies that are moved by hand.
    pub mocap: usize,
}

/// One coordinate that slides.
#[derive(Clone, Copy, Debug)]
pub struct Slide {
    /// Its place in `qpos`.
    pub qpos: usize,
    /// Its place in `qvel`.
    pub qvel: usize,
}

/// A drawer or a window: it slides, has a handle, and a button locks it.
#[derive(Clone, Copy, Debug)]
pub struct Sliding {
    /// How far it is open.
    pub slide: Slide,
    /// Its handle, and where the handle is at the goal.
    pub handles: [usize; 2],
    /// The axis along which the handle's goal moves with the opening.
    pub axis: usize,
    /// What its handle is painted with.
    pub paint: usize,
}

/// A button: pressed down, it toggles a lock.
#[derive(Clone, Copy, Debug)]
pub struct Button {
    /// How far it is pressed.
    pub slide: Slide,
    /// Its top geom, which shows the lock's state.
    pub geom: usize,
    /// The middle of its top.
    pub top: usize,
}

/// What a scene has beside cubes.
#[derive(Clone, Copy, Debug)]
pub struct Fixtures {
    /// The first locks the drawer, the second the window.
    pub buttons: [Button; 2],
    /// The drawer.
    pub drawer: Sliding,
    /// The window.
    pub window: Sliding,
}

/// Everything on a table.
#[derive(Clone, Debug)]
pub struct Parts {
    /// The cubes, in their order.
    pub cubes: Vec<Cube>,
    /// Buttons, drawer and window, where there are any.
    pub fixtures: Option<Fixtures>,
}

/// Where a button's joint must come to toggle its lock, in metres.
const PRESSED: f64 = -0.02;
/// How drawer and window resist when locked and when not, in newtons a metre per second.
const DAMPING: [f64; 2] = [1e6, 2.0];
/// The paint of what is not locked.
const UNLOCKED: [f32; 3] = [0.9; 3];

impl Parts {
    /// Finds everything in a model.
    ///
    /// # Errors
    /// When something is not there.
    pub fn new(model: &MjModel, setup: &Setup) -> Result<Self> {
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
                paint: id(mjOBJ_MATERIAL, &format!("{name}_handle"))?,
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
            cubes: (0..setup.cubes).map(cube).collect::<Result<_>>()?,
            fixtures: if setup.fixtures { Some(fixtures()?) } else { None },
        })
    }
}

/// A place in one of MuJoCo's arrays.
fn index(place: i32) -> Result<usize> {
    usize::try_from(place).map_err(|error| Error::external("looking into OGBench's model", error))
}

impl Cube {
    /// Where it is.
    pub fn place(&self, qpos: &[f64]) -> Vec3 {
        [qpos[self.qpos], qpos[self.qpos + 1], qpos[self.qpos + 2]]
    }

    /// How it is turned.
    pub fn turn(&self, qpos: &[f64]) -> Quat {
        std::array::from_fn(|i| qpos[self.qpos + 3 + i])
    }

    /// Puts it somewhere.
    pub fn put(&self, physics: &mut Physics, place: Vec3, turn: Quat) {
        let qpos = &mut physics.data_mut().qpos_mut()[self.qpos..];
        qpos[..3].copy_from_slice(&place);
        qpos[3..7].copy_from_slice(&turn);
    }

    /// Makes the marker appear at its goal while the body it belongs to is elsewhere: that body is a part of the state, which is
    /// the same wherever cubes should go.
    pub fn mark(&self, physics: &mut Physics, body: Pose, goal: Pose) {
        let inner = if body == goal { Pose { place: [0.0; 3], turn: IDENTITY } } else { body.inverse().then(goal) };
        let model = physics.model_mut();
        model.geom_pos_mut()[self.geoms[1]] = inner.place;
        model.geom_quat_mut()[self.geoms[1]] = inner.turn;
    }

    /// Makes the marker visible or not.
    pub fn show_mark(&self, physics: &mut Physics, visible: bool) {
        physics.model_mut().geom_rgba_mut()[self.geoms[1]][3] = if visible { 0.2 } else { 0.0 };
    }
}

impl Fixtures {
    /// How drawer and window stand in `qpos`, with these buttons.
    pub fn read(&self, qpos: &[f64], buttons: [u8; 2]) -> Fixed {
        Fixed { buttons, drawer: qpos[self.drawer.slide.qpos], window: qpos[self.window.slide.qpos] }
    }

    /// Opens drawer and window that far.
    pub fn put(&self, physics: &mut Physics, fixed: Fixed) {
        let qpos = physics.data_mut().qpos_mut();
        qpos[self.drawer.slide.qpos] = fixed.drawer;
        qpos[self.window.slide.qpos] = fixed.window;
    }

    /// Makes the model that of these locks: what is locked hardly moves, and is painted in the colour of its lock.
    pub fn lock(&self, physics: &mut Physics, buttons: [u8; 2], colors: &[[f32; 3]; 2]) {
        let model = physics.model_mut();
        for (i, sliding) in [self.drawer, self.window].into_iter().enumerate() {
            let paint = if buttons[i] == 0 { colors[i] } else { UNLOCKED };
            model.geom_rgba_mut()[self.buttons[i].geom][..3].copy_from_slice(&paint);
            model.mat_rgba_mut()[sliding.paint][..3].copy_from_slice(&paint);
            model.dof_damping_mut()[sliding.slide.qvel] = DAMPING[usize::from(buttons[i])];
        }
    }

    /// Marks where the handles should be.
    pub fn mark(&self, physics: &mut Physics, goal: Fixed) {
        for (sliding, open) in [(self.drawer, goal.drawer), (self.window, goal.window)] {
            physics.model_mut().site_pos_mut()[sliding.handles[1]][sliding.axis] = open;
        }
    }

    /// The buttons after a step: each that came down since `before` toggles.
    pub fn toggled(&self, buttons: [u8; 2], before: &[f64], qpos: &[f64]) -> [u8; 2] {
        std::array::from_fn(|i| {
            let at = self.buttons[i].slide.qpos;
            let pressed = before[at] > PRESSED && qpos[at] <= PRESSED;
            buttons[i] ^ u8::from(pressed)
        })
    }
}
