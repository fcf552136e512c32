//! The model of a table: floor and walls, the arm with its gripper, cubes, and in the scene buttons, a drawer and a
//! window.
//!
//! OGBench composes its MJCF files with `dm_control.mjcf`. This module composes the same files with MuJoCo's model
//! editing, in the order that gives every body, geom and material the same index. The compiled models are equal, with
//! the exceptions that OGBench's README in this crate lists.
#![allow(unsafe_code, reason = "`mjs_attach`, which `mujoco-rs` does not wrap")]

use super::config::{Bounds, TableConfig};
use crate::physics::compile_spec;
use crate::{assets, link};
use mujoco_rs::mujoco_c::{_mjtGeomBase, mjs_attach, mjtCone, mjtIntegrator};
use mujoco_rs::wrappers::MjModel;
use mujoco_rs::wrappers::mj_editing::{MjSpec, MjsBody, SpecElement, SpecItem, SpecObject};
use mujoco_rs::wrappers::mj_model::MjtObjBase;
use std::ffi::CStr;
use std::path::PathBuf;
use swm_core::{Error, Result};

/// Half the distance of two adjacent cubes in the model, in metres; every episode sets new positions.
const SPACING: f64 = 0.05;

/// Stiffness (N m/rad) and damping (N m s/rad) of the arm's position actuators.
const GAINS: [(f64, f64); 6] =
    [(4500.0, 450.0), (4500.0, 450.0), (4500.0, 450.0), (2000.0, 200.0), (2000.0, 200.0), (500.0, 50.0)];

/// The time step, in seconds.
const TIMESTEP: f64 = 0.002;

/// The memory that MuJoCo takes at most to compile the table with the arm's meshes.
const COMPILATION_BYTES: usize = 400 << 20;

/// The materials that are transparent with `ob_type=pixels`, and their alpha.
const TRANSPARENT_MATERIALS: [(&str, f32); 9] = [
    ("ur5e/robotiq/metal", 0.1),
    ("ur5e/robotiq/silicone", 0.1),
    ("ur5e/robotiq/gray", 0.1),
    ("ur5e/robotiq/black", 0.1),
    ("ur5e/robotiq/pad_gray", 0.5),
    ("ur5e/black", 0.1),
    ("ur5e/jointgray", 0.1),
    ("ur5e/linkgray", 0.1),
    ("ur5e/lightblue", 0.1),
];

/// The rendering of the arm.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ArmRendering {
    /// Opaque, for `ob_type=states`.
    Opaque,
    /// Transparent, for `ob_type=pixels`: the arm does not hide the cubes.
    Transparent,
}

/// Compiles the model.
///
/// # Errors
/// When MuJoCo or the files of OGBench are not installed, or MuJoCo rejects them.
pub fn compile(config: &TableConfig, arm_rendering: ArmRendering) -> Result<MjModel> {
    link::load_to_compile(COMPILATION_BYTES)?;
    let files = Files(assets::path("ogbench")?.join("ogbench/manipspace/descriptions"));
    let mut arena = files.read("floor_wall.xml")?;
    set_options(&mut arena);
    // The arm's body must precede the objects' bodies, but the arm's meshes and materials must follow those of the
    // objects. The body is therefore added here, and its content is attached at the end.
    arena.world_body_mut().add_body().with_name("ur5e/");
    for cube in 0..config.cubes {
        let mut spec = files.read("cube.xml")?;
        number_cube(&mut spec, cube, config.cubes)?;
        attach(arena.world_body_mut(), spec, c"")?;
    }
    for file in if config.fixtures { &["buttons.xml", "drawer.xml", "window.xml"][..] } else { &[] } {
        attach(arena.world_body_mut(), files.read(file)?, c"")?;
    }
    let arm = files.arm()?;
    attach(body(&mut arena, "ur5e/")?, arm, c"ur5e/")?;
    let world = arena.world_body_mut();
    for camera in config.cameras {
        let added = world.add_camera().with_name(camera.name).with_pos(camera.position);
        added.alt_mut().set_xy_axis(&camera.axes);
    }
    bounding_box(world, "object_bounds", &at_cube_height(config.object_bounds), [0.6, 0.3, 0.3, 0.2]);
    bounding_box(world, "arm_bounds", &config.arm_bounds, [0.3, 0.6, 0.3, 0.2]);
    let mut model = compile_spec(&mut arena).map_err(|error| Error::external("compiling OGBench's table", error))?;
    configure_arm(&mut model, arm_rendering);
    Ok(model)
}

/// OGBench's description files.
struct Files(PathBuf);

impl Files {
    fn read(&self, file: &str) -> Result<MjSpec> {
        let path = self.0.join(file);
        MjSpec::from_xml(&path).map_err(|error| Error::external(format!("reading {}", path.display()), error))
    }

    /// The arm with the gripper attached to its flange.
    fn arm(&self) -> Result<MjSpec> {
        let mut arm = self.read("universal_robots_ur5e/ur5e.xml")?;
        let failed = |error| Error::external("preparing OGBench's arm", error);
        if let Some(light) = arm.light_mut("spotlight") {
            // SAFETY: the light belongs to this description, and no other element refers to it.
            unsafe { light.delete() }.map_err(failed)?;
        }
        if let Some(key) = arm.key_mut("home") {
            // SAFETY: as for the light.
            unsafe { key.delete() }.map_err(failed)?;
        }
        let Some(flange) = arm.site("attachment_site") else { return Err(missing("attachment_site")) };
        let (position, quat) = (*flange.pos(), *flange.quat());
        body(&mut arm, "wrist_3_link")?.add_body().with_name("robotiq/").with_pos(position).with_quat(quat);
        attach(body(&mut arm, "robotiq/")?, self.read("robotiq_2f85/2f85.xml")?, c"robotiq/")?;
        Ok(arm)
    }
}

fn missing(name: &str) -> Error {
    Error::external(
        "reading OGBench's descriptions",
        format!("there is no element '{name}'; `swm assets verify` checks the installed files"),
    )
}

fn body<'a>(spec: &'a mut MjSpec, name: &str) -> Result<&'a mut MjsBody> {
    spec.body_mut(name).ok_or_else(|| missing(name))
}

/// Adds the content of `child` to `parent`; `prefix` is prepended to the names.
fn attach(parent: &mut MjsBody, mut child: MjSpec, prefix: &CStr) -> Result<()> {
    let frame = parent.add_frame().element_mut_pointer();
    // SAFETY: frame and child are elements of live descriptions; MuJoCo counts references to the child, which may be
    // dropped afterwards.
    let attached = unsafe { mjs_attach(frame, child.ffi_mut().element, prefix.as_ptr(), c"".as_ptr()) };
    match attached.is_null() {
        false => Ok(()),
        true => Err(Error::external("composing OGBench's table", "MuJoCo could not attach an element")),
    }
}

/// Sets the options that `dm_control` collects from all files, and the options that the environment sets.
fn set_options(arena: &mut MjSpec) {
    let option = arena.option_mut();
    option.timestep = TIMESTEP;
    option.cone = mjtCone::mjCONE_ELLIPTIC as i32;
    option.impratio = 10.0;
    option.integrator = mjtIntegrator::mjINT_IMPLICITFAST as i32;
    let stat = arena.stat_mut();
    (stat.center, stat.extent, stat.meansize) = ([0.3, 0.0, 0.15], 0.7, 0.04);
    let visual = arena.visual_mut();
    (visual.global.elevation, visual.global.azimuth) = (-20.0, 180.0);
    (visual.map.znear, visual.map.zfar) = (0.1, 10.0);
}

/// Numbers the elements of `cube.xml` and moves the cube to its position among `cubes`.
fn number_cube(spec: &mut MjSpec, cube: usize, cubes: usize) -> Result<()> {
    let offset = 2.0 * SPACING * cube as f64 - SPACING * (cubes as f64 - 1.0);
    let named = |stem: &str| format!("{stem}_{cube}");
    let failed = |error| Error::external("numbering OGBench's cubes", error);
    for stem in ["object", "object_target"] {
        let body = body(spec, &format!("{stem}_0"))?;
        body.pos_mut()[1] = offset;
        body.set_name(&named(stem)).map_err(failed)?;
    }
    for stem in ["object", "target_object"] {
        let geom = spec.geom_mut(&format!("{stem}_0")).ok_or_else(|| missing(stem))?;
        geom.set_name(&named(stem)).map_err(failed)?;
    }
    let joint = spec.joint_mut("object_joint_0").ok_or_else(|| missing("object_joint_0"))?;
    joint.set_name(&named("object_joint")).map_err(failed)?;
    let site = spec.site_mut("com_0").ok_or_else(|| missing("com_0"))?;
    site.set_name(&named("com")).map_err(failed)
}

/// Extends bounds in the plane to the height of a cube's centre.
fn at_cube_height([low, high]: Bounds<2>) -> Bounds<3> {
    [[low[0], low[1], 0.02], [high[0], high[1], 0.02]]
}

/// Adds a site that displays bounds, in a group that is not rendered by default.
fn bounding_box(world: &mut MjsBody, name: &str, [low, high]: &Bounds<3>, color: [f32; 4]) {
    let each = |f: fn(f64, f64) -> f64| std::array::from_fn(|i| f(low[i], high[i]));
    let site = world.add_site().with_name(name);
    *site.pos_mut() = each(|low, high| (low + high) / 2.0);
    *site.size_mut() = each(|low, high| (high - low) / 2.0 + 1e-7);
    *site.rgba_mut() = color;
    site.set_type(_mjtGeomBase::mjGEOM_BOX);
    site.set_group(4);
}

/// Sets the gains of the arm's actuators and the transparency of its materials.
fn configure_arm(model: &mut MjModel, arm_rendering: ArmRendering) {
    for (i, (stiffness, damping)) in GAINS.into_iter().enumerate() {
        // The bias keeps the damping of the file: the reference writes the damping to the gains, which has no effect.
        // SAFETY: any finite gain is valid.
        let gain = unsafe { &mut model.actuator_gainprm_mut()[i] };
        (gain[0], gain[2]) = (stiffness, -damping);
        model.actuator_biasprm_mut()[i][1] = -stiffness;
    }
    if arm_rendering == ArmRendering::Transparent {
        for (name, alpha) in TRANSPARENT_MATERIALS {
            let Some(id) = model.name_to_id(MjtObjBase::mjOBJ_MATERIAL, name) else { continue };
            model.mat_rgba_mut()[id][3] = alpha;
        }
    }
}
