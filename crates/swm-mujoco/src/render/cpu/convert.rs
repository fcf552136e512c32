//! Converts MuJoCo's abstract scene to a scene of `swm-raster`.
//!
//! Constants and mappings reproduce MuJoCo's OpenGL renderer: its tessellation of planes, its texture coordinates.
#![allow(unsafe_code, reason = "MuJoCo stores the geoms of a scene in an array that it allocates")]

use mujoco_rs::mujoco_c::{
    mjtCatBit, mjtGeom, mjtLightType, mjtObj, mjtRndFlag, mjtTexture, mjtTextureRole, mjvGLCamera, mjvGeom, mjvLight,
    mjvScene,
};
use mujoco_rs::wrappers::MjModel;
use swm_raster::{Axis, Camera, Geom, Haze, Light, Mapping, Paint, Scene, Shape, V3};

/// The maximal number of cells along each axis of a model's plane.
const MAX_CELLS: usize = 200;

/// The number of cells along each axis of a plane that is not a geom of the model.
const DECOR_CELLS: usize = 4;

/// Fills a scene from MuJoCo's abstract scene.
pub(super) fn fill(scene: &mut Scene, from: &mjvScene, model: &MjModel, (width, height): (usize, usize)) {
    let flag = |flag: mjtRndFlag| from.flags[flag as usize] != 0;
    let (vis, extent) = (model.vis(), model.stat().extent as f32);
    scene.camera = camera(&from.camera, width, height);
    scene.shadows = flag(mjtRndFlag::mjRND_SHADOW) && vis.quality.shadowsize > 0;
    scene.reflections = flag(mjtRndFlag::mjRND_REFLECTION);
    scene.shadow_reach = extent * vis.map.shadowclip;
    scene.shadow_angle = vis.map.shadowscale;
    let sky = model.tex_type().iter().position(|kind| *kind == mjtTexture::mjTEXTURE_SKYBOX);
    scene.sky = sky.filter(|_| flag(mjtRndFlag::mjRND_SKYBOX));
    let [r, g, b, _] = vis.rgba.haze;
    scene.haze = flag(mjtRndFlag::mjRND_HAZE).then_some(Haze { rgb: [r, g, b], depth: vis.map.haze });
    scene.lights.clear();
    let lights = usize::try_from(from.nlight).unwrap_or(0);
    scene.lights.extend(from.lights.iter().take(lights).filter_map(light));
    scene.geoms.clear();
    let count = usize::try_from(from.ngeom).unwrap_or(0);
    // SAFETY: `geoms` points to `ngeom` geoms.
    let geoms = if count == 0 { &[] } else { unsafe { std::slice::from_raw_parts(from.geoms, count) } };
    scene.geoms.extend(geoms.iter().filter_map(|from| geom(from, model)));
}

/// The camera midway between MuJoCo's stereo pair, with the aspect ratio of the frame.
fn camera(pair: &[mjvGLCamera; 2], width: usize, height: usize) -> Camera {
    let mean = |of: fn(&mjvGLCamera) -> V3| -> V3 {
        let [a, b] = [of(&pair[0]), of(&pair[1])];
        std::array::from_fn(|k| 0.5 * (a[k] + b[k]))
    };
    let middle = |of: fn(&mjvGLCamera) -> f32| 0.5 * (of(&pair[0]) + of(&pair[1]));
    let unit = |a: V3| {
        let length = a.iter().map(|x| x * x).sum::<f32>().sqrt();
        a.map(|x| x / length)
    };
    let forward = unit(mean(|eye| eye.forward));
    // Makes `up` orthogonal to the viewing direction.
    let up = mean(|eye| eye.up);
    let along: f32 = up.iter().zip(forward).map(|(a, b)| a * b).sum();
    let up = unit(std::array::from_fn(|k| up[k] - along * forward[k]));
    let (bottom, top) = (middle(|eye| eye.frustum_bottom), middle(|eye| eye.frustum_top));
    let (centre, half) = (middle(|eye| eye.frustum_center), middle(|eye| eye.frustum_width));
    let half = if half > 0.0 { half } else { 0.5 * (top - bottom) * width as f32 / height as f32 };
    Camera {
        position: mean(|eye| eye.pos),
        forward,
        up,
        frustum: [centre - half, centre + half, bottom, top],
        near: middle(|eye| eye.frustum_near),
        far: middle(|eye| eye.frustum_far),
        orthographic: pair[0].orthographic != 0,
    }
}

/// Converts a light; MuJoCo's renderer supports directional lights and spotlights only.
fn light(from: &mjvLight) -> Option<Light> {
    let directional = from.type_ == mjtLightType::mjLIGHT_DIRECTIONAL as i32;
    (directional || from.type_ == mjtLightType::mjLIGHT_SPOT as i32).then_some(Light {
        position: from.pos,
        direction: from.dir,
        directional,
        attenuation: from.attenuation,
        cutoff: from.cutoff,
        exponent: from.exponent,
        ambient: from.ambient,
        diffuse: from.diffuse,
        specular: from.specular,
        shadows: from.castshadow != 0,
    })
}

/// Converts a geom; `None` for lines, labels and visualisations of forces and frames, which no environment enables.
fn geom(from: &mjvGeom, model: &MjModel) -> Option<Geom> {
    let of_model = from.objtype == mjtObj::mjOBJ_GEOM as i32;
    Some(Geom {
        shape: shape(from, model, of_model)?,
        position: from.pos,
        rotation: from.mat,
        rgba: from.rgba,
        emission: from.emission,
        specular: from.specular,
        shininess: from.shininess,
        reflectance: from.reflectance,
        paint: paint(from, model),
        label: (from.segid >= 0).then_some(if of_model { from.objid } else { -1 }),
        casts: from.category != mjtCatBit::mjCAT_DECOR as i32,
    })
}

fn shape(from: &mjvGeom, model: &MjModel, of_model: bool) -> Option<Shape> {
    let is = |kind: mjtGeom| from.type_ == kind as i32;
    let [x, y, z] = from.size;
    Some(if is(mjtGeom::mjGEOM_PLANE) {
        let known = usize::try_from(from.objid).ok().filter(|_| of_model && from.dataid >= 0);
        match known.and_then(|geom| Some((geom, model.geom_size().get(geom)?))) {
            Some((geom, size)) => {
                let material = usize::try_from(model.geom_matid()[geom]).ok();
                let repeat = material.map_or([0.0; 2], |material| model.mat_texrepeat()[material]);
                Shape::Plane(axis(size[0], size[2], repeat[0], model), axis(size[1], size[2], repeat[1], model))
            }
            None => Shape::Plane(Axis::even(x, DECOR_CELLS), Axis::even(y, DECOR_CELLS)),
        }
    } else if is(mjtGeom::mjGEOM_SPHERE) || is(mjtGeom::mjGEOM_ELLIPSOID) {
        Shape::Ellipsoid([x, y, z])
    } else if is(mjtGeom::mjGEOM_CAPSULE) {
        Shape::Capsule(x, z)
    } else if is(mjtGeom::mjGEOM_CYLINDER) {
        Shape::Cylinder(x, z)
    } else if is(mjtGeom::mjGEOM_BOX) {
        Shape::Box([x, y, z])
    } else if is(mjtGeom::mjGEOM_MESH) || is(mjtGeom::mjGEOM_SDF) {
        // MuJoCo has two display lists per mesh: the mesh and its convex hull.
        Shape::Mesh(usize::try_from(from.dataid).ok()? / 2)
    } else if is(mjtGeom::mjGEOM_HFIELD) {
        // Height fields follow the meshes in the assets.
        Shape::Mesh(model.mesh_vertadr().len() + usize::try_from(from.dataid).ok()?)
    } else {
        return None;
    })
}

/// Tessellates a plane along an axis as MuJoCo does. `size` is half the extent in metres (0: infinite), `spacing` half
/// the distance between grid lines in metres.
fn axis(size: f64, spacing: f64, repeat: f32, model: &MjModel) -> Axis {
    if size > 0.0 {
        let spacing = spacing.max(size / (MAX_CELLS - 2) as f64);
        let lines = (size / spacing).floor() as usize & !1;
        let pad = size - lines as f64 * spacing;
        // Lines are counted over half the plane and are two spacings apart.
        return Axis {
            half: size as f32,
            pad: pad as f32,
            step: 2.0 * spacing as f32,
            cells: lines + 2,
            infinite: false,
        };
    }
    let far = f64::from(model.vis().map.zfar) * model.stat().extent;
    let cell = if repeat > 0.0 { 2.0 / f64::from(repeat) } else { 2.1 * far / (MAX_CELLS - 2) as f64 };
    let step = (2.1 * far + 2.0 * cell) / MAX_CELLS as f64;
    Axis {
        half: (step * (MAX_CELLS / 2) as f64) as f32,
        pad: step as f32,
        step: step as f32,
        cells: MAX_CELLS,
        infinite: true,
    }
}

/// The texture of a geom. OpenGL generates texture coordinates from unit shapes, except for planes and meshes of the
/// model, whose vertices are in metres.
fn paint(from: &mjvGeom, model: &MjModel) -> Option<Paint> {
    let material = usize::try_from(from.matid).ok()?;
    let (texture, uniform, repeat) = match usize::try_from(from.texid) {
        Ok(texture) => (texture, from.texuniform != 0, from.texrepeat),
        Err(_) => {
            let texture = model.mat_texid().get(material)?[mjtTextureRole::mjTEXROLE_RGB as usize];
            (usize::try_from(texture).ok()?, model.mat_texuniform()[material], model.mat_texrepeat()[material])
        }
    };
    let metres = from.dataid >= 0;
    let flat = *model.tex_type().get(texture)? == mjtTexture::mjTEXTURE_2D;
    let mapping = if from.texcoord != 0 {
        Mapping::Own
    } else if flat {
        // The texture starts at the upper left corner of a finite shape and repeats per shape, or per metre if uniform.
        let repeat = [0, 1].map(|k| repeat[k] * if uniform && from.size[k] > 0.0 { from.size[k] } else { 1.0 });
        if from.type_ == mjtGeom::mjGEOM_BOX as i32 {
            return Some(Paint { texture, mapping: Mapping::Sides(repeat) });
        }
        let to_unit = |size: f32| if size > 0.0 { 1.0 / size } else { 1.0 };
        let begin = |size: f32| if size > 0.0 { 0.5 } else { 0.0 };
        let [s, t] = [0, 1].map(|k| 0.5 * repeat[k] * to_unit(from.size[k]));
        let offset = [0, 1].map(|k| begin(from.size[k]) * repeat[k]);
        Mapping::Flat { scale: [s, -t], offset }
    } else {
        Mapping::Cube([0, 1, 2].map(|k| match (uniform, metres) {
            (true, true) => from.size[k],
            (false, false) => 1.0 / from.size[k].max(1e-6),
            _ => 1.0,
        }))
    };
    Some(Paint { texture, mapping })
}
