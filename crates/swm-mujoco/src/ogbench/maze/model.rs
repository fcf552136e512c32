//! The model of a maze: OGBench's description of the agent with walls, a floor of the map's size, and markers.

use super::agent::Agent;
use super::map::{Map, TELEPORT_RADIUS, UNIT, center};
use crate::physics::{COMPILATION_BYTES, compile_spec};
use crate::{assets, link};
use mujoco_rs::mujoco_c::_mjtGeomBase::{self, mjGEOM_BOX, mjGEOM_CYLINDER};
use mujoco_rs::wrappers::MjModel;
use mujoco_rs::wrappers::mj_editing::{MjSpec, MjsGeom, SpecItem, SpecObject};
use swm_core::{Error, Result};

/// Half the height of walls, in metres.
const WALL_HALF_HEIGHT: f64 = 1.0;
/// Half the height of markers on the floor, in metres.
const MARKER_HALF_HEIGHT: f64 = 0.05;
/// Radius of the goal's marker, in metres.
const GOAL_RADIUS: f64 = 0.5;
/// The geoms of an ant that are white with `ob_type=pixels`, so that frames show its orientation.
const WHITE_GEOMS: [&str; 3] = ["aux_1_geom", "left_leg_geom", "left_ankle_geom"];

/// Compiles the model, for `ob_type=pixels` or `ob_type=states`.
///
/// # Errors
/// When MuJoCo or the files of OGBench are not installed, or MuJoCo rejects them.
pub fn compile(agent: Agent, map: &Map, pixels: bool) -> Result<MjModel> {
    link::load_to_compile(COMPILATION_BYTES)?;
    let path = assets::path("ogbench")?.join("ogbench/locomaze/assets").join(agent.file());
    let failed =
        |error: &dyn std::fmt::Display| Error::external(format!("building a maze of {}", path.display()), error);
    let missing = |name: &str| failed(&format!("there is no '{name}'"));
    let mut spec = MjSpec::from_xml(&path).map_err(|error| failed(&error))?;
    for cell in map.cells().filter(|&cell| !map.is_free(cell)) {
        let [x, y] = center(cell);
        let block = add(&mut spec, &format!("block_{}_{}", cell.0, cell.1), mjGEOM_BOX, "wall");
        *block.pos_mut() = [x, y, WALL_HALF_HEIGHT];
        *block.size_mut() = [UNIT / 2.0, UNIT / 2.0, WALL_HALF_HEIGHT];
        block.set_contype(1);
        block.set_conaffinity(1);
    }
    let floor = spec.geom_mut("floor").ok_or_else(|| missing("floor"))?;
    let [x, y] = map.camera_center();
    let [width, height] = map.extent();
    (*floor.pos_mut(), *floor.size_mut()) = ([x, y, 0.0], [2.0 * width, 2.0 * height, 0.2]);
    for (kind, cells) in [("teleport_in", map.teleports.0), ("teleport_out", map.teleports.1)] {
        for (i, &cell) in cells.iter().enumerate() {
            marker(&mut spec, &format!("{kind}_{i}"), kind, center(cell), TELEPORT_RADIUS);
        }
    }
    if pixels {
        *spec.material_mut("wall").ok_or_else(|| missing("wall"))?.rgba_mut() = [0.6, 0.6, 0.6, 1.0];
        *spec.light_mut("global").ok_or_else(|| missing("global"))?.ambient_mut() = [0.0; 3];
        spec.material_mut("grid").ok_or_else(|| missing("grid"))?.set_texuniform(false);
        let torso = spec.light_mut("torso_light").ok_or_else(|| missing("torso_light"))?;
        remove(torso).map_err(|error| failed(&error))?;
        for name in if agent == Agent::Ant { &WHITE_GEOMS[..] } else { &[] } {
            spec.geom_mut(name).ok_or_else(|| missing(name))?.set_material("self_white");
        }
    } else {
        marker(&mut spec, "target", "target", [0.0; 2], GOAL_RADIUS);
    }
    compile_spec(&mut spec).map_err(|error| failed(&error))
}

/// Removes an element from its description.
#[allow(unsafe_code, reason = "`mujoco-rs` cannot check that no other element refers to it")]
fn remove(element: &mut impl SpecObject) -> Result<(), impl std::fmt::Display> {
    // SAFETY: the element belongs to a live description, is deleted once, and no other element refers to it.
    unsafe { element.delete() }
}

fn add<'a>(spec: &'a mut MjSpec, name: &str, kind: _mjtGeomBase, material: &str) -> &'a mut MjsGeom {
    let geom = spec.world_body_mut().add_geom().with_name(name);
    geom.set_type(kind);
    geom.set_material(material);
    geom
}

/// Adds a flat cylinder without collisions.
fn marker(spec: &mut MjSpec, name: &str, material: &str, [x, y]: [f64; 2], radius: f64) {
    let geom = add(spec, name, mjGEOM_CYLINDER, material);
    (*geom.pos_mut(), *geom.size_mut()) = ([x, y, MARKER_HALF_HEIGHT], [radius, MARKER_HALF_HEIGHT, 0.0]);
    geom.set_contype(0);
    geom.set_conaffinity(0);
}
