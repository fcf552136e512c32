//! The factors of variation of a table, and their edits of the compiled model. Names, bounds, defaults and order are
//! those of the reference.

use super::config::{CUBE_COLORS, Camera, FRONT, SIDE, TableConfig};
use super::objects::Objects;
use crate::Physics;
use crate::ogbench::arm::find;
use crate::ogbench::arm::pose::{Quat, Vec3, cross, norm, normalized, scale, sub};
use crate::ogbench::floor;
use mujoco_rs::mujoco_c::_mjtObjBase::{mjOBJ_CAMERA, mjOBJ_LIGHT, mjOBJ_MATERIAL};
use mujoco_rs::mujoco_c::mjtSameFrame;
use std::f64::consts::TAU;
use swm_core::{DType, Factor, FactorValues, Result, Space, VariationSpace};

/// The density of a cube, in kg/m³.
const DENSITY: f64 = 1240.0;
/// Half the edge of a cube, in metres; in single precision, as in the reference.
const HALF_EDGE: f64 = 0.02_f32 as f64;
/// The default colour of the gripper.
const PURPLE: [f64; 3] = [0.61, 0.28, 0.82];
/// The materials of the gripper that have the agent's colour.
const GRIPPER_MATERIALS: [&str; 2] = ["ur5e/robotiq/black", "ur5e/robotiq/pad_gray"];
/// The default colour of a closed lock.
const LOCK_COLOR: [f64; 3] = CUBE_COLORS[0];

/// The factors of a table; `camera.angle_delta` rotates `cameras` cameras (1 or 2).
pub fn space(config: &TableConfig, cameras: usize) -> VariationSpace {
    let n = config.cubes;
    let bounded = |shape: &[usize], low: &[f64], high: &[f64]| Space::Box {
        shape: shape.to_vec(),
        dtype: DType::Float64,
        low: low.to_vec(),
        high: high.to_vec(),
    };
    let uniform = |shape: &[usize], low, high| Space::uniform_box(shape, DType::Float64, low, high);
    let [low, high] = config.object_bounds;
    let positions = || bounded(&[n, 2], &low.repeat(n), &high.repeat(n));
    let [arm_low, arm_high] = config.arm_bounds;
    let middle: Vec<f64> = (0..3).map(|i| (arm_low[i] + arm_high[i]) / 2.0).collect();
    let (color, max_angle) = (|shape: &[usize]| uniform(shape, 0.0, 1.0), config.factors.camera_angle);
    let mut factors = vec![
        Factor::new("agent.color", color(&[3]), PURPLE),
        Factor::new("agent.ee_start_position", bounded(&[3], &arm_low, &arm_high), middle),
        Factor::new("camera.angle_delta", uniform(&[cameras, 2], -max_angle, max_angle), vec![0.0; 2 * cameras]),
        Factor::new("cube.color", color(&[n, 3]), CUBE_COLORS[..n].concat()),
        Factor::new("cube.goal_position", positions(), config.factors.cube.repeat(n)),
        Factor::new("cube.goal_yaw", uniform(&[n], 0.0, TAU), vec![0.0; n]),
        Factor::new("cube.size", uniform(&[n], 0.01, 0.03), vec![HALF_EDGE; n]),
        Factor::new("cube.start_position", positions(), config.factors.cube.repeat(n)),
        Factor::new("cube.start_yaw", uniform(&[n], 0.0, TAU), vec![0.0; n]),
        Factor::new("floor.color", color(&[2, 3]), floor::COLORS.concat()),
        Factor::new("light.intensity", color(&[1]), [config.factors.light]),
    ];
    if config.fixtures {
        factors.push(Factor::new("lock_color", color(&[2, 3]), [LOCK_COLOR, LOCK_COLOR].concat()));
    }
    VariationSpace::new(factors, config.factors.sampled_by_default)
}

/// The colours of the two locks.
pub fn lock_colors(factors: &FactorValues) -> [[f32; 3]; 2] {
    let value = factors.get("lock_color");
    [color(&value[..3]), color(&value[3..])]
}

fn color(value: &[f64]) -> [f32; 3] {
    [value[0] as f32, value[1] as f32, value[2] as f32]
}

/// Edits the model for these factors.
///
/// # Errors
/// When the model lacks an element.
pub fn apply(physics: &mut Physics, config: &TableConfig, objects: &Objects, factors: &FactorValues) -> Result<()> {
    let find = |physics: &Physics, kind, name: &str| find(physics.model(), kind, name);
    for name in GRIPPER_MATERIALS {
        let material = find(physics, mjOBJ_MATERIAL, name)?;
        physics.model_mut().mat_rgba_mut()[material][..3].copy_from_slice(&color(factors.get("agent.color")));
    }
    let light = find(physics, mjOBJ_LIGHT, "global")?;
    let intensity = factors.scalar("light.intensity") as f32;
    physics.model_mut().light_diffuse_mut()[light] = [intensity; 3];
    let angles = factors.get("camera.angle_delta");
    for (name, angle) in [FRONT, SIDE].into_iter().zip(angles.chunks_exact(2)) {
        let at = find(physics, mjOBJ_CAMERA, name)?;
        let Some(camera) = config.cameras.iter().find(|camera| camera.name == name) else { continue };
        physics.model_mut().cam_quat_mut()[at] = rotated_camera(camera, [angle[0], angle[1]]);
    }
    for (i, cube) in objects.cubes.iter().enumerate() {
        let color = color(&factors.get("cube.color")[3 * i..][..3]);
        let half = factors.get("cube.size")[i];
        for (body, geom) in cube.bodies.into_iter().zip(cube.geoms) {
            physics.model_mut().geom_rgba_mut()[geom][..3].copy_from_slice(&color);
            resize_cube(physics, body, geom, half);
        }
    }
    physics.set_const();
    // Markers are moved relative to their bodies. MuJoCo would skip the transform of geoms that coincide with their
    // bodies.
    for cube in &objects.cubes {
        physics.model_mut().geom_sameframe_mut()[cube.geoms[1]] = mjtSameFrame::mjSAMEFRAME_NONE;
    }
    set_mean_inertia(physics);
    floor::set_colors(physics, factors.get("floor.color"))
}

/// Updates the mean mass and the mean inertia, which MuJoCo computes only when it compiles a model. The solver's
/// tolerance is relative to the mean inertia.
fn set_mean_inertia(physics: &mut Physics) {
    let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
    let (inertia, mass) = (mean(physics.model().dof_m0()), mean(&physics.model().body_mass()[1..]));
    let means = physics.data_mut().model_stat_mut();
    (means.meaninertia, means.meanmass) = (inertia, mass);
}

/// Sets half the edge of a cube (m): size, collision bounds, mass and inertia.
fn resize_cube(physics: &mut Physics, body: usize, geom: usize, half: f64) {
    let model = physics.model_mut();
    let bounds = [0.0, 0.0, 0.0, half, half, half];
    model.geom_size_mut()[geom] = [half; 3];
    model.geom_rbound_mut()[geom] = norm(&[half; 3]);
    model.geom_aabb_mut()[geom] = bounds;
    let tree = model.body_bvhadr()[body];
    if let Ok(node) = usize::try_from(tree) {
        model.bvh_aabb_mut()[node] = bounds;
    }
    let mass = DENSITY * 8.0 * half.powi(3);
    model.body_mass_mut()[body] = mass;
    model.body_inertia_mut()[body] = [mass / 12.0 * (8.0 * half * half); 3];
}

/// The orientation of a camera whose axes are rotated by yaw and then by pitch, in degrees.
fn rotated_camera(camera: &Camera, [yaw, pitch]: [f64; 2]) -> Quat {
    let ((sy, cy), (sp, cp)) = (yaw.to_radians().sin_cos(), pitch.to_radians().sin_cos());
    let rotate = |[x, y, z]: Vec3| {
        let [x, y] = [cy * x - sy * y, sy * x + cy * y];
        [x, cp * y - sp * z, sp * y + cp * z]
    };
    let [ax, ay, az, bx, by, bz] = camera.axes;
    let (right, up) = (rotate([ax, ay, az]), rotate([bx, by, bz]));
    frame(right, up)
}

/// The rotation whose first axis is parallel to `right`, and whose second axis is as close as possible to `up`.
fn frame(right: Vec3, up: Vec3) -> Quat {
    let unit = |v: Vec3| scale(v, 1.0 / norm(&v));
    let right = unit(right);
    let along: f64 = right.iter().zip(&up).map(|(a, b)| a * b).sum();
    let up = unit(sub(up, scale(right, along)));
    let back = cross(right, up);
    matrix_to_quat([right, up, back])
}

/// The quaternion of a rotation matrix given by its columns, computed from its largest element as MuJoCo does.
fn matrix_to_quat([x, y, z]: [Vec3; 3]) -> Quat {
    let q = if x[0] + y[1] + z[2] > 0.0 {
        let w = 0.5 * (1.0 + x[0] + y[1] + z[2]).sqrt();
        [w, 0.25 * (y[2] - z[1]) / w, 0.25 * (z[0] - x[2]) / w, 0.25 * (x[1] - y[0]) / w]
    } else if x[0] > y[1] && x[0] > z[2] {
        let a = 0.5 * (1.0 + x[0] - y[1] - z[2]).sqrt();
        [0.25 * (y[2] - z[1]) / a, a, 0.25 * (y[0] + x[1]) / a, 0.25 * (z[0] + x[2]) / a]
    } else if y[1] > z[2] {
        let b = 0.5 * (1.0 - x[0] + y[1] - z[2]).sqrt();
        [0.25 * (z[0] - x[2]) / b, 0.25 * (y[0] + x[1]) / b, b, 0.25 * (z[1] + y[2]) / b]
    } else {
        let c = 0.5 * (1.0 - x[0] - y[1] + z[2]).sqrt();
        [0.25 * (x[1] - y[0]) / c, 0.25 * (z[0] + x[2]) / c, 0.25 * (z[1] + y[2]) / c, c]
    };
    normalized(q)
}

#[cfg(test)]
mod tests {
    use super::super::arena::{self, ArmRendering};
    use super::super::config::CUBES;
    use super::*;
    use std::sync::Arc;
    use swm_core::{Key, VariationRequest};

    #[test]
    fn applying_factors_overwrites_all_earlier_edits() -> Result<()> {
        let config = &CUBES[0];
        let model = Arc::new(arena::compile(config, ArmRendering::Opaque)?);
        let space = space(config, 1);
        let all = VariationRequest { variation: Some(vec!["all".to_owned()]), ..VariationRequest::default() };
        let bytes = |seeds: &[u64]| -> Result<Vec<u8>> {
            let mut physics = Physics::new(Arc::clone(&model))?;
            let objects = Objects::new(physics.model(), config)?;
            for &seed in seeds {
                apply(&mut physics, config, &objects, &space.resolve(&all, Key::new(seed))?)?;
                physics.reset();
                physics.forward();
            }
            let mut bytes = vec![0; physics.model().size()];
            physics.model().save_to_buffer(&mut bytes).expect("saving the model to a buffer");
            Ok(bytes)
        };
        let (fresh, used) = (bytes(&[1])?, bytes(&[90, 1])?);
        let differing: Vec<usize> =
            fresh.iter().zip(&used).enumerate().filter(|(_, (a, b))| a != b).map(|(i, _)| i).collect();
        assert!(differing.is_empty(), "bytes {:?} of {}", &differing[..differing.len().min(20)], fresh.len());
        Ok(())
    }
}
