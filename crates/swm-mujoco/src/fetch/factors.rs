//! The factors of variation and their edits of the model. Names, bounds and defaults are those of the reference.

use crate::physics::{Physics, index_of};
use mujoco_rs::mujoco_c::mjtTexture;
use mujoco_rs::wrappers::MjModel;
use mujoco_rs::wrappers::mj_model::MjtObjBase;
use std::f64::consts::PI;
use swm_core::{DType, Factor, FactorValues, Result, Space, VariationSpace};

/// The factors of a task, with the factors of the block if `block` is true.
pub fn variation_space(block: bool) -> VariationSpace {
    let within = |shape: &[usize], low: &[f64], high: &[f64]| Space::Box {
        shape: shape.to_vec(),
        dtype: DType::Float64,
        low: low.to_vec(),
        high: high.to_vec(),
    };
    let color = |key, default: [f64; 3]| Factor::new(key, within(&[3], &[0.0; 3], &[1.0; 3]), default);
    let scalar = |key, low, high, default: f64| Factor::new(key, within(&[1], &[low], &[high]), [default]);
    let mut all = vec![
        Factor::new("agent.start_position", within(&[2], &[1.25, 0.6], &[1.45, 0.9]), [1.3418, 0.7491]),
        color("background.color", [0.1; 3]),
    ];
    if block {
        all.push(scalar("block.angle", -PI, PI, 0.0));
        all.push(scalar("block.mass", 0.01, 50.0, 2.0));
        all.push(Factor::new("block.start_position", within(&[2], &[1.15, 0.6], &[1.45, 0.9]), [1.3, 0.74]));
    }
    // Goals on the table: the height is that of a block's centre.
    let goal = within(&[3], &[1.15, 0.6, 0.4247], &[1.45, 0.9, 0.4247]);
    all.extend([
        Factor::new("camera.angle_delta", within(&[1, 2], &[-10.0; 2], &[10.0; 2]), [0.0; 2]),
        Factor::new("goal.start_position", goal, [1.3, 0.74, 0.4247]),
        scalar("light.intensity", 0.0, 1.0, 0.7),
        color("object.color", [0.8, 0.1, 0.1]),
        Factor::new("rendering.transparent_arm", Space::Discrete { n: 2, start: 0 }, [0.0]),
        color("table.color", [0.3; 3]),
    ]);
    let sampled_by_default =
        ["table.color", "object.color", "light.intensity", "background.color", "camera.angle_delta"];
    VariationSpace::new(all, &sampled_by_default)
}

/// The elements of the model that factors edit, by index.
pub struct FactorTargets {
    tables: Vec<usize>,
    floors: Vec<usize>,
    objects: Vec<usize>,
    arm: Vec<usize>,
    block: Option<usize>,
    light: usize,
    skybox: Option<usize>,
}

impl FactorTargets {
    /// Finds the elements in a model.
    ///
    /// # Errors
    /// When the model is not a model of Fetch.
    pub fn new(model: &MjModel, block: bool) -> Result<Self> {
        let of_material = |name: &str| -> Result<Vec<usize>> {
            let material = i32::try_from(index_of(model, MjtObjBase::mjOBJ_MATERIAL, name)?).unwrap_or(-1);
            Ok((0..model.geom_matid().len()).filter(|&geom| model.geom_matid()[geom] == material).collect())
        };
        let is_arm =
            |&geom: &usize| model.id_to_name(MjtObjBase::mjOBJ_GEOM, geom).is_some_and(|name| name.contains("robot0:"));
        let mut objects = of_material("block_mat")?;
        if objects.is_empty() {
            objects = of_material("puck_mat")?;
        }
        Ok(Self {
            tables: of_material("table_mat")?,
            floors: of_material("floor_mat")?,
            objects,
            arm: (0..model.geom_matid().len()).filter(is_arm).collect(),
            block: if block { Some(index_of(model, MjtObjBase::mjOBJ_BODY, "object0")?) } else { None },
            light: index_of(model, MjtObjBase::mjOBJ_LIGHT, "light0")?,
            skybox: model.tex_type().iter().position(|kind| *kind == mjtTexture::mjTEXTURE_SKYBOX),
        })
    }

    /// Applies factors to the compiled model. A factor at its default leaves the model unchanged: the reference's
    /// default colours are not those of the models.
    pub fn apply(&self, physics: &mut Physics, factors: &FactorValues) {
        let changed = |key: &str| {
            let factor = factors.factors().iter().find(|factor| factor.key == key);
            Some(factors.get(key)).filter(|value| factor.is_some_and(|factor| factor.init_value != *value))
        };
        let rgb = |color: &[f64]| [color[0] as f32, color[1] as f32, color[2] as f32];
        for (key, geoms) in
            [("table.color", &self.tables), ("background.color", &self.floors), ("object.color", &self.objects)]
        {
            if let Some(color) = changed(key) {
                geoms.iter().for_each(|&geom| physics.set_geom_color(geom, rgb(color)));
            }
        }
        if let (Some(color), Some(skybox)) = (changed("background.color"), self.skybox) {
            let model = physics.model_mut();
            let begin = usize::try_from(model.tex_adr()[skybox]).unwrap_or(0);
            let pixels = model.tex_width()[skybox] * model.tex_height()[skybox];
            let channels = usize::try_from(model.tex_nchannel()[skybox]).unwrap_or(3);
            let bytes = begin..begin + usize::try_from(pixels).unwrap_or(0) * channels;
            for pixel in model.tex_data_mut()[bytes].chunks_exact_mut(channels) {
                pixel.iter_mut().zip(color).for_each(|(byte, channel)| *byte = (channel * 255.0) as u8);
            }
            physics.mark_textures_edited();
        }
        if let Some(intensity) = changed("light.intensity") {
            physics.model_mut().light_diffuse_mut()[self.light] = [intensity[0] as f32; 3];
        }
        if factors.integer("rendering.transparent_arm") == 1 {
            let colors = physics.model_mut().geom_rgba_mut();
            self.arm.iter().for_each(|&geom| colors[geom][3] = 0.3);
        }
        if let Some(&[azimuth, elevation]) = changed("camera.angle_delta") {
            for position in physics.model_mut().cam_pos_mut() {
                *position = rotate_camera(*position, azimuth.to_radians(), elevation.to_radians());
            }
        }
        if let Some(block) = self.block {
            physics.model_mut().body_mass_mut()[block] = factors.scalar("block.mass");
        }
    }
}

/// Rotates the position of a camera around the vertical axis and raises it, with the reference's formula. Angles are in
/// radians.
fn rotate_camera([x, y, z]: [f64; 3], azimuth: f64, elevation: f64) -> [f64; 3] {
    let (x, y) = (x * azimuth.cos() - y * azimuth.sin(), x * azimuth.sin() + y * azimuth.cos());
    [x, y, z * elevation.cos() + x.hypot(y) * elevation.sin()]
}
