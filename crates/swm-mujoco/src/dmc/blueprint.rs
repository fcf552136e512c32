//! The description of a world, edited by factors of variation before it is compiled.

use crate::{assets, link};
use mujoco_rs::wrappers::mj_auxiliary::MjVfs;
use mujoco_rs::wrappers::mj_model::MjtGeomBase;
use mujoco_rs::wrappers::{MjModel, MjSpec};
use std::path::Path;
use swm_core::{Error, FactorValues, Result};

/// What every model of the suite includes.
const COMMON: [&str; 3] = ["./common/materials.xml", "./common/skybox.xml", "./common/visual.xml"];

/// The text of a model, and of what it includes.
pub struct Blueprint {
    name: &'static str,
    text: String,
    common: Vec<Vec<u8>>,
}

impl Blueprint {
    /// The description in a file of the suite, drafted for a task.
    ///
    /// # Errors
    /// When the suite's models are not installed, or not those that were pinned.
    pub fn read(name: &'static str, draft: impl FnOnce(String) -> Result<String>) -> Result<Self> {
        let suite = assets::path("dm_control")?.join("dm_control/suite");
        let read = |path: &Path| std::fs::read(path).map_err(|error| Error::io(path, "reading a model", error));
        let text = String::from_utf8_lossy(&read(&suite.join(name))?).into_owned();
        let common = COMMON.iter().map(|file| read(&suite.join(file))).collect::<Result<_>>()?;
        Ok(Self { name, text: draft(text)?, common })
    }

    /// Compiles the model with factors of variation.
    ///
    /// # Errors
    /// When MuJoCo is not installed or refuses the model, or an edit misses a part of it.
    pub fn compile(&self, factors: &FactorValues, edit: impl FnOnce(&mut Edit<'_>) -> Result<()>) -> Result<MjModel> {
        link::load()?;
        let failed = |error: &dyn std::fmt::Display| Error::external(format!("compiling {}", self.name), error);
        let mut disk = MjVfs::new();
        for (name, content) in COMMON.iter().zip(&self.common) {
            disk.add_from_buffer(name, content).map_err(|error| failed(&error))?;
        }
        disk.add_from_buffer(self.name, self.text.as_bytes()).map_err(|error| failed(&error))?;
        let mut spec = MjSpec::from_xml_vfs(self.name, &disk).map_err(|error| failed(&error))?;
        edit(&mut Edit { spec: &mut spec, factors })?;
        spec.compile().map_err(|error| failed(&error))
    }
}

/// The text without the element of that name, and without what is inside it.
///
/// # Errors
/// When there is none.
pub fn without(text: &str, tag: &str, name: &str) -> Result<String> {
    let missing = || Error::mismatch("drafting a model of the suite", format!("no {tag} '{name}'"), "the pinned files");
    let begin = text.find(&format!("<{tag} name=\"{name}\"")).ok_or_else(missing)?;
    let (open, close) = (format!("<{tag} "), format!("</{tag}>"));
    let head = begin + text[begin..].find('>').ok_or_else(missing)?;
    let mut end = head + 1;
    // Elements of the same kind may stand inside.
    let mut depth = usize::from(!text[..head].ends_with('/'));
    while depth > 0 {
        let closing = end + text[end..].find(&close).ok_or_else(missing)?;
        let opened = text[end..closing].match_indices(&open).filter(|(at, _)| {
            let inner = &text[end + at..closing];
            inner.find('>').is_some_and(|bracket| !inner[..bracket].ends_with('/'))
        });
        depth = depth - 1 + opened.count();
        end = closing + close.len();
    }
    Ok(format!("{}{}", &text[..begin], &text[end..]))
}

/// A model's description under edit. Names are those of its parts, keys those of factors; values go through single
/// precision where the reference's do.
pub struct Edit<'a> {
    spec: &'a mut MjSpec,
    factors: &'a FactorValues,
}

/// An edit of a part that is not there.
fn missing(what: &str, name: &str) -> Error {
    Error::mismatch("editing a model of the suite", format!("no {what} '{name}'"), "the pinned files")
}

/// A colour as MuJoCo keeps it.
fn rgba(color: &[f64], alpha: f32) -> [f32; 4] {
    [color[0] as f32, color[1] as f32, color[2] as f32, alpha]
}

/// A number on its way through single precision.
fn single(number: f64) -> f64 {
    f64::from(number as f32)
}

impl Edit<'_> {
    /// Makes the textures that no factor changes so small that painting them takes no time.
    pub fn shrink_sky(&mut self) {
        for name in ["skybox", "background", "ball"] {
            if let Some(texture) = self.spec.texture_mut(name) {
                texture.set_width(1);
                texture.set_height(1);
            }
        }
    }

    /// What all worlds have: the colours of floor and agent, and a lamp.
    pub fn scene(&mut self, lamp: &str) -> Result<()> {
        let floor = self.factors.get("floor.color");
        let grid = self.spec.texture_mut("grid").ok_or_else(|| missing("texture", "grid"))?;
        grid.rgb1_mut().copy_from_slice(&floor[..3]);
        grid.rgb2_mut().copy_from_slice(&floor[3..]);
        self.paint("self", "agent.color", 1.0)?;
        let light = self.spec.light_mut(lamp).ok_or_else(|| missing("light", lamp))?;
        *light.diffuse_mut() = [self.factors.scalar("light.intensity") as f32; 3];
        Ok(())
    }

    /// The colour of a material.
    pub fn paint(&mut self, material: &str, key: &str, alpha: f32) -> Result<()> {
        let part = self.spec.material_mut(material).ok_or_else(|| missing("material", material))?;
        *part.rgba_mut() = rgba(self.factors.get(key), alpha);
        Ok(())
    }

    /// The colour of the material of targets, invisible unless they are to be seen.
    pub fn target_color(&mut self) -> Result<()> {
        self.paint("target", "target.color", self.target_alpha())
    }

    fn target_alpha(&self) -> f32 {
        f32::from(u8::from(self.factors.integer("rendering.render_target") != 0))
    }

    /// The shape of targets, and how many sizes it has.
    fn target_shape(&self) -> (MjtGeomBase, usize) {
        match self.factors.integer("target.shape") {
            0 => (MjtGeomBase::mjGEOM_BOX, 3),
            _ => (MjtGeomBase::mjGEOM_SPHERE, 1),
        }
    }

    /// The shape of the site `target`: a box with sides, or a sphere with a radius, of that size in metres.
    pub fn target_site(&mut self, size: f64) -> Result<()> {
        let (shape, sizes) = self.target_shape();
        let part = self.spec.site_mut("target").ok_or_else(|| missing("site", "target"))?;
        part.set_type(shape);
        part.size_mut()[..sizes].fill(single(size));
        Ok(())
    }

    /// The shape of a geom that is a target.
    pub fn target_geom(&mut self, geom: &str, size: f64) -> Result<()> {
        let (shape, sizes) = self.target_shape();
        let part = self.spec.geom_mut(geom).ok_or_else(|| missing("geom", geom))?;
        part.set_type(shape);
        part.size_mut()[..sizes].fill(single(size));
        Ok(())
    }

    /// The shape and colour of a site that is a target and a room, with its half sizes in metres.
    pub fn target_room(&mut self, site: &str, sizes: [f64; 3]) -> Result<()> {
        let ((shape, _), color) = (self.target_shape(), rgba(self.factors.get("target.color"), self.target_alpha()));
        let part = self.spec.site_mut(site).ok_or_else(|| missing("site", site))?;
        part.set_type(shape);
        *part.size_mut() = sizes.map(single);
        *part.rgba_mut() = color;
        Ok(())
    }

    fn geom(&mut self, geom: &str) -> Result<&mut mujoco_rs::wrappers::mj_editing::MjsGeom> {
        self.spec.geom_mut(geom).ok_or_else(|| missing("geom", geom))
    }

    /// A geom's density. One whose mass is given keeps it.
    pub fn density(&mut self, geom: &str, key: &str) -> Result<()> {
        let density = self.factors.scalar(key);
        self.geom(geom)?.set_density(density);
        Ok(())
    }

    /// A geom's mass.
    pub fn mass(&mut self, geom: &str, key: &str) -> Result<()> {
        let mass = self.factors.scalar(key);
        self.geom(geom)?.set_mass(mass);
        Ok(())
    }

    /// A sphere's radius.
    pub fn radius(&mut self, geom: &str, key: &str) -> Result<()> {
        let radius = self.factors.scalar(key);
        self.geom(geom)?.size_mut()[0] = radius;
        Ok(())
    }

    /// A geom's own colour.
    pub fn geom_color(&mut self, geom: &str, key: &str) -> Result<()> {
        let color = rgba(self.factors.get(key), 1.0);
        *self.geom(geom)?.rgba_mut() = color;
        Ok(())
    }

    /// The floor's friction: sliding as the factor says, turning and rolling as MuJoCo has them by default.
    pub fn friction(&mut self, floor: &str) -> Result<()> {
        let sliding = self.factors.scalar("floor.friction");
        *self.geom(floor)?.friction_mut() = [sliding, single(0.005), single(0.0001)];
        Ok(())
    }

    /// The floor's tilt about the y-axis.
    pub fn tilt(&mut self, floor: &str) -> Result<()> {
        let (sin, cos) = self.factors.scalar("floor.rotation_y").to_radians().sin_cos();
        self.geom(floor)?.alt_mut().set_z_axis(&[single(sin), 0.0, single(cos)]);
        Ok(())
    }

    /// Half the sides of the floor, in metres.
    pub fn floor_size(&mut self, floor: &str, half: f64) -> Result<()> {
        self.geom(floor)?.size_mut()[..2].fill(half);
        Ok(())
    }

    /// The pull of gravity.
    pub fn gravity(&mut self) {
        let pull = ["gravity.x", "gravity.y", "gravity.z"].map(|key| self.factors.scalar(key));
        self.spec.option_mut().gravity = pull;
    }

    /// How much a joint resists being moved at all.
    pub fn joint_friction(&mut self, joint: &str, key: &str) -> Result<()> {
        let friction = self.factors.scalar(key);
        let part = self.spec.joint_mut(joint).ok_or_else(|| missing("joint", joint))?;
        part.set_frictionloss(friction);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn elements_are_taken_out_with_what_is_inside() {
        let text = r#"<w><body name="a"><body name="b"><geom/></body><body name="c"/><body name="d"></body></body><body name="e"/></w>"#;
        let left = |tag, name| without(text, tag, name).expect("there is one");
        assert_eq!(left("body", "a"), r#"<w><body name="e"/></w>"#);
        assert_eq!(left("body", "e"), text.replace(r#"<body name="e"/>"#, ""));
        assert_eq!(left("body", "b"), text.replace(r#"<body name="b"><geom/></body>"#, ""));
        assert!(without(text, "body", "z").expect_err("there is none").to_string().contains("body 'z'"));
    }
}
