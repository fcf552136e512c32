//! The model of a maze: OGBench's description of the agent, with walls, a floor that fits, and what marks the goal.

use super::Agent;
use super::map::{Map, UNIT, middle};
use crate::{assets, link};
use mujoco_rs::mujoco_c::_mjtGeomBase::{self, mjGEOM_BOX, mjGEOM_CYLINDER};
use mujoco_rs::wrappers::MjModel;
use mujoco_rs::wrappers::mj_editing::{MjSpec, MjsGeom, SpecItem, SpecObject};
use swm_core::{Error, Result};

/// Half the height of walls, in metres.
const WALL: f64 = 1.0;
/// Half the height of markers on the floor, and their radius.
const MARKER: (f64, f64) = (0.05, 0.5);
/// The radius of teleports.
pub const TELEPORT: f64 = 1.0;
/// The parts of an ant that are white where an agent sees, so that it can tell its legs apart.
const WHITE: [&str; 3] = ["aux_1_geom", "left_leg_geom", "left_ankle_geom"];

/// Compiles the model; `seen` for an agent that sees pictures.
///
/// # Errors
/// When MuJoCo or the files of OGBench are not installed, or MuJoCo refuses them.
pub fn compile(agent: Agent, map: &Map, seen: bool) -> Result<MjModel> {
    link::load()?;
    let path = assets::path("ogbench")?.join("ogbench/locomaze/assets").join(agent.file());
    let failed =
        |error: &dyn std::fmt::Display| Error::external(format!("building a maze of {}", path.display()), error);
    let missing = |name: &str| failed(&format!("there is no '{name}'"));
    let mut spec = MjSpec::from_xml(&path).map_err(|error| failed(&error))?;
    for cell in map.cells().filter(|&cell| !map.is_free(cell)) {
        let [x, y] = middle(cell);
        let block = add(&mut spec, &format!("block_{}_{}", cell.0, cell.1), mjGEOM_BOX, "wall");
        (*block.pos_mut(), *block.size_mut()) = ([x, y, WALL], [UNIT / 2.0, UNIT / 2.0, WALL]);
        block.set_contype(1);
        block.set_conaffinity(1);
    }
    let floor = spec.geom_mut("floor").ok_or_else(|| missing("floor"))?;
    let [x, y] = center(map);
    let [width, height] = extent(map);
    (*floor.pos_mut(), *floor.size_mut()) = ([x, y, 0.0], [2.0 * width, 2.0 * height, 0.2]);
    for (kind, cells) in [("teleport_in", map.teleports.0), ("teleport_out", map.teleports.1)] {
        for (i, &cell) in cells.iter().enumerate() {
            marker(&mut spec, &format!("{kind}_{i}"), kind, middle(cell), TELEPORT);
        }
    }
    if seen {
        *spec.material_mut("wall").ok_or_else(|| missing("wall"))?.rgba_mut() = [0.6, 0.6, 0.6, 1.0];
        *spec.light_mut("global").ok_or_else(|| missing("global"))?.ambient_mut() = [0.0; 3];
        spec.material_mut("grid").ok_or_else(|| missing("grid"))?.set_texuniform(false);
        let torso = spec.light_mut("torso_light").ok_or_else(|| missing("torso_light"))?;
        remove(torso).map_err(|error| failed(&error))?;
        for name in if agent == Agent::Ant { &WHITE[..] } else { &[] } {
            spec.geom_mut(name).ok_or_else(|| missing(name))?.set_material("self_white");
        }
    } else {
        marker(&mut spec, "target", "target", [0.0; 2], MARKER.1);
    }
    spec.compile().map_err(|error| failed(&error))
}

/// Takes something out of its description.
#[allow(unsafe_code, reason = "`mujoco-rs` cannot see that nobody refers to it")]
fn remove(element: &mut impl SpecObject) -> Result<(), impl std::fmt::Display> {
    // SAFETY: it is of a living description, deleted once, and nothing refers to it.
    unsafe { element.delete() }
}

/// The middle of a maze, as OGBench looks at it.
pub fn center(map: &Map) -> [f64; 2] {
    extent(map).map(|cells| 2.0 * (cells - 3.0))
}

/// Columns and rows.
pub fn extent(map: &Map) -> [f64; 2] {
    let (rows, columns) = map.size();
    [columns as f64, rows as f64]
}

fn add<'a>(spec: &'a mut MjSpec, name: &str, kind: _mjtGeomBase, material: &str) -> &'a mut MjsGeom {
    let geom = spec.world_body_mut().add_geom().with_name(name);
    geom.set_type(kind);
    geom.set_material(material);
    geom
}

/// A flat cylinder that nothing touches.
fn marker(spec: &mut MjSpec, name: &str, material: &str, [x, y]: [f64; 2], radius: f64) {
    let geom = add(spec, name, mjGEOM_CYLINDER, material);
    (*geom.pos_mut(), *geom.size_mut()) = ([x, y, MARKER.0], [radius, MARKER.0, 0.0]);
    geom.set_contype(0);
    geom.set_conaffinity(0);
}
