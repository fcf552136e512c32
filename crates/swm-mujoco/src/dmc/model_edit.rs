//! [`ModelEdit`]: edits of a model's description by factors of variation, before it is compiled.

use mujoco_rs::wrappers::MjSpec;
use mujoco_rs::wrappers::mj_editing::MjsGeom;
use mujoco_rs::wrappers::mj_model::MjtGeomBase;
use swm_core::{Error, FactorValues, Result};

/// Edits a model's description. Arguments name elements of the model and keys of factors; values are rounded to single
/// precision where the reference rounds them. Every method fails if the model lacks the element.
pub struct ModelEdit<'a> {
    spec: &'a mut MjSpec,
    factors: &'a FactorValues,
}

/// The expectation of errors about the files of dm_control.
const PINNED: &str = "the pinned files (`swm assets verify dm_control` checks them)";

/// The error for an element that the model lacks.
fn missing(what: &str, name: &str) -> Error {
    Error::mismatch("editing a dm_control suite model", format!("a file without the {what} '{name}'"), PINNED)
}

/// Converts an RGB colour and an opacity to MuJoCo's RGBA.
fn rgba(color: &[f64], alpha: f32) -> [f32; 4] {
    [color[0] as f32, color[1] as f32, color[2] as f32, alpha]
}

/// Rounds a value to single precision.
fn single(value: f64) -> f64 {
    f64::from(value as f32)
}

impl<'a> ModelEdit<'a> {
    /// Edits `spec` with these factors.
    pub fn new(spec: &'a mut MjSpec, factors: &'a FactorValues) -> Self {
        Self { spec, factors }
    }

    /// Shrinks the textures that no factor changes to one pixel, so that generating them takes little time.
    pub fn shrink_sky(&mut self) {
        for name in ["skybox", "background", "ball"] {
            if let Some(texture) = self.spec.texture_mut(name) {
                texture.set_width(1);
                texture.set_height(1);
            }
        }
    }

    /// Applies the factors of all domains: colours of floor and agent, and the intensity of a light.
    pub fn common(&mut self, light: &str) -> Result<()> {
        let floor = self.factors.get("floor.color");
        let grid = self.spec.texture_mut("grid").ok_or_else(|| missing("texture", "grid"))?;
        grid.rgb1_mut().copy_from_slice(&floor[..3]);
        grid.rgb2_mut().copy_from_slice(&floor[3..]);
        self.material_color("self", "agent.color", 1.0)?;
        let light = self.spec.light_mut(light).ok_or_else(|| missing("light", light))?;
        *light.diffuse_mut() = [self.factors.scalar("light.intensity") as f32; 3];
        Ok(())
    }

    /// Sets the colour of a material.
    pub fn material_color(&mut self, material: &str, key: &str, alpha: f32) -> Result<()> {
        let material = self.spec.material_mut(material).ok_or_else(|| missing("material", material))?;
        *material.rgba_mut() = rgba(self.factors.get(key), alpha);
        Ok(())
    }

    /// Sets the colour of the target's material, which is invisible unless `rendering.render_target` is set.
    pub fn target_color(&mut self) -> Result<()> {
        self.material_color("target", "target.color", self.target_alpha())
    }

    fn target_alpha(&self) -> f32 {
        f32::from(u8::from(self.factors.integer("rendering.render_target") != 0))
    }

    /// The shape of the target, and the number of its size parameters.
    fn target_shape(&self) -> (MjtGeomBase, usize) {
        match self.factors.integer("target.shape") {
            0 => (MjtGeomBase::mjGEOM_BOX, 3),
            _ => (MjtGeomBase::mjGEOM_SPHERE, 1),
        }
    }

    /// Sets the shape of the site `target`: a box or a sphere with this half side or radius, in metres.
    pub fn target_site(&mut self, size: f64) -> Result<()> {
        let (shape, sizes) = self.target_shape();
        let site = self.spec.site_mut("target").ok_or_else(|| missing("site", "target"))?;
        site.set_type(shape);
        site.size_mut()[..sizes].fill(single(size));
        Ok(())
    }

    /// Sets the shape of a target that is a geom, with this half side or radius in metres.
    pub fn target_geom(&mut self, geom: &str, size: f64) -> Result<()> {
        let (shape, sizes) = self.target_shape();
        let geom = self.geom(geom)?;
        geom.set_type(shape);
        geom.size_mut()[..sizes].fill(single(size));
        Ok(())
    }

    /// Sets shape and colour of a target that is a region, with its half sizes in metres.
    pub fn target_region(&mut self, site: &str, sizes: [f64; 3]) -> Result<()> {
        let ((shape, _), color) = (self.target_shape(), rgba(self.factors.get("target.color"), self.target_alpha()));
        let site = self.spec.site_mut(site).ok_or_else(|| missing("site", site))?;
        site.set_type(shape);
        *site.size_mut() = sizes.map(single);
        *site.rgba_mut() = color;
        Ok(())
    }

    fn geom(&mut self, geom: &str) -> Result<&mut MjsGeom> {
        self.spec.geom_mut(geom).ok_or_else(|| missing("geom", geom))
    }

    /// Sets the density of a geom, in kg/m³. The mass of a geom with an explicit mass does not change.
    pub fn density(&mut self, geom: &str, key: &str) -> Result<()> {
        let density = self.factors.scalar(key);
        self.geom(geom)?.set_density(density);
        Ok(())
    }

    /// Sets the mass of a geom, in kg.
    pub fn mass(&mut self, geom: &str, key: &str) -> Result<()> {
        let mass = self.factors.scalar(key);
        self.geom(geom)?.set_mass(mass);
        Ok(())
    }

    /// Sets the radius of a sphere, in metres.
    pub fn radius(&mut self, geom: &str, key: &str) -> Result<()> {
        let radius = self.factors.scalar(key);
        self.geom(geom)?.size_mut()[0] = radius;
        Ok(())
    }

    /// Sets the colour of a geom.
    pub fn geom_color(&mut self, geom: &str, key: &str) -> Result<()> {
        let color = rgba(self.factors.get(key), 1.0);
        *self.geom(geom)?.rgba_mut() = color;
        Ok(())
    }

    /// Sets the friction of the floor: the sliding coefficient of the factor, MuJoCo's defaults for torsion and
    /// rolling.
    pub fn floor_friction(&mut self, floor: &str) -> Result<()> {
        let sliding = self.factors.scalar("floor.friction");
        *self.geom(floor)?.friction_mut() = [sliding, single(0.005), single(0.0001)];
        Ok(())
    }

    /// Tilts the floor about the y-axis.
    pub fn floor_tilt(&mut self, floor: &str) -> Result<()> {
        let (sin, cos) = self.factors.scalar("floor.rotation_y").to_radians().sin_cos();
        self.geom(floor)?.alt_mut().set_z_axis(&[single(sin), 0.0, single(cos)]);
        Ok(())
    }

    /// Sets half the side lengths of the floor, in metres.
    pub fn floor_size(&mut self, floor: &str, half: f64) -> Result<()> {
        self.geom(floor)?.size_mut()[..2].fill(half);
        Ok(())
    }

    /// Sets the acceleration of gravity, in m/s².
    pub fn gravity(&mut self) {
        let gravity = ["gravity.x", "gravity.y", "gravity.z"].map(|key| self.factors.scalar(key));
        self.spec.option_mut().gravity = gravity;
    }

    /// Sets the dry friction of a joint, in N m.
    pub fn joint_friction(&mut self, joint: &str, key: &str) -> Result<()> {
        let friction = self.factors.scalar(key);
        let joint = self.spec.joint_mut(joint).ok_or_else(|| missing("joint", joint))?;
        joint.set_frictionloss(friction);
        Ok(())
    }
}
