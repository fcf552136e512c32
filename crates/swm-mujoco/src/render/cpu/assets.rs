//! What models of a group share: meshes and textures, prepared by the first who draws one.

use crate::render::Look;
use mujoco_rs::mujoco_c::mjtTexture;
use mujoco_rs::wrappers::MjModel;
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use swm_raster::{Assets, Corner, Mesh, Texture, V3};

/// Groups that are kept; the one unused for longest makes room.
const GROUPS: usize = 16;

/// Versions of a group's textures that are kept.
const REPAINTED: usize = 64;

/// Below this cosine, MuJoCo lights a corner of a mesh by the direction of its face instead of its own.
const SMOOTH: f32 = 0.8;

/// The assets of a group.
struct Group {
    meshes: Vec<Arc<Mesh>>,
    /// By place and content.
    textures: BTreeMap<(usize, u64), Arc<Texture>>,
}

/// Puts the assets of a model that looks so in the place of others.
pub(super) fn fill(assets: &mut Assets, model: &MjModel, look: &Look) {
    static KNOWN: Mutex<Vec<(u64, Group)>> = Mutex::new(vec![]);
    let mut known = KNOWN.lock().unwrap_or_else(PoisonError::into_inner);
    let (number, mut group) = match known.iter().position(|(number, _)| *number == look.group) {
        Some(place) => known.remove(place),
        None => {
            let meshes = (0..model.mesh_vertadr().len()).map(|i| Arc::new(mesh(model, i)));
            let mut meshes: Vec<_> = meshes.collect();
            meshes.extend((0..model.hfield_adr().len()).map(|i| Arc::new(height_field(model, i))));
            (look.group, Group { meshes, textures: BTreeMap::new() })
        }
    };
    if group.textures.len() > REPAINTED {
        group.textures.retain(|(_, content), _| *content == 0);
    }
    let textures = look.textures.iter().enumerate().map(|(place, &content)| {
        let made = group.textures.entry((place, content)).or_insert_with(|| Arc::new(texture(model, place)));
        Arc::clone(made)
    });
    assets.textures.clear();
    assets.textures.extend(textures);
    assets.meshes.clone_from(&group.meshes);
    if known.len() >= GROUPS {
        known.remove(0);
    }
    known.push((number, group));
}

/// A number of MuJoCo's as a place; 0 for what is none.
fn place(number: impl TryInto<usize>) -> usize {
    number.try_into().unwrap_or(0)
}

/// A mesh of the model, its corners as MuJoCo lights them.
fn mesh(model: &MjModel, number: usize) -> Mesh {
    let first = |starts: &[i32]| place(starts[number]);
    let (vertices, normals) = (first(model.mesh_vertadr()), first(model.mesh_normaladr()));
    let coordinates = usize::try_from(model.mesh_texcoordadr()[number]).ok();
    let faces = first(model.mesh_faceadr())..first(model.mesh_faceadr()) + place(model.mesh_facenum()[number]);
    Mesh::new(faces.map(|face| {
        let places = model.mesh_face()[face].map(|i| model.mesh_vert()[vertices + place(i)]);
        let flat = normal(places);
        std::array::from_fn(|k| {
            let own = model.mesh_normal()[normals + place(model.mesh_facenormal()[face][k])];
            let smooth = own.iter().zip(flat).map(|(a, b)| a * b).sum::<f32>() >= SMOOTH;
            Corner {
                place: places[k],
                normal: if coordinates.is_some() || smooth { own } else { flat },
                coordinates: coordinates
                    .map_or([0.0; 2], |first| model.mesh_texcoord()[first + place(model.mesh_facetexcoord()[face][k])]),
            }
        })
    }))
}

/// The direction a triangle faces.
fn normal([a, b, c]: [V3; 3]) -> V3 {
    let (u, v): (V3, V3) = (std::array::from_fn(|k| b[k] - a[k]), std::array::from_fn(|k| c[k] - a[k]));
    let n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
    let length = n.iter().map(|x| x * x).sum::<f32>().sqrt();
    if length > 0.0 { n.map(|x| x / length) } else { [0.0, 0.0, 1.0] }
}

/// A height field: its surface, four sides, and the bottom.
#[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation)]
fn height_field(model: &MjModel, number: usize) -> Mesh {
    let (rows, columns) = (place(model.hfield_nrow()[number]), place(model.hfield_ncol()[number]));
    let [x, y, above, below] = model.hfield_size()[number].map(|size| size as f32);
    let heights = &model.hfield_data()[place(model.hfield_adr()[number])..];
    let along = |i: usize, n: usize, half: f32| half * (2.0 * i as f32 / (n.max(2) - 1) as f32 - 1.0);
    let at = |r: usize, c: usize| [along(c, columns, x), along(r, rows, y), above * heights[r * columns + c]];
    let foot = |r: usize, c: usize| [along(c, columns, x), along(r, rows, y), -below];
    let mut triangles = vec![];
    let mut triangle = |places: [V3; 3]| {
        let normal = normal(places);
        triangles.push(places.map(|place| Corner { place, normal, coordinates: [0.0; 2] }));
    };
    for r in 1..rows {
        for c in 1..columns {
            triangle([at(r, c - 1), at(r - 1, c - 1), at(r, c)]);
            triangle([at(r - 1, c - 1), at(r - 1, c), at(r, c)]);
        }
    }
    let mut wall = |a: (usize, usize), b: (usize, usize)| {
        triangle([foot(a.0, a.1), foot(b.0, b.1), at(b.0, b.1)]);
        triangle([foot(a.0, a.1), at(b.0, b.1), at(a.0, a.1)]);
    };
    for r in 1..rows {
        wall((r, 0), (r - 1, 0));
        wall((r - 1, columns - 1), (r, columns - 1));
    }
    for c in 1..columns {
        wall((0, c - 1), (0, c));
        wall((rows - 1, c), (rows - 1, c - 1));
    }
    let corner = |x: f32, y: f32| [x, y, -below];
    triangle([corner(-x, -y), corner(-x, y), corner(x, y)]);
    triangle([corner(-x, -y), corner(x, y), corner(x, -y)]);
    Mesh::new(triangles)
}

/// A texture of the model; white where it is of a kind that is not drawn.
fn texture(model: &MjModel, number: usize) -> Texture {
    let (width, height) = (place(model.tex_width()[number]), place(model.tex_height()[number]));
    let channels = place(model.tex_nchannel()[number]);
    let first = place(model.tex_adr()[number]);
    let bytes = model.tex_data().get(first..first + width * height * channels).unwrap_or_default();
    let made = match model.tex_type()[number] {
        mjtTexture::mjTEXTURE_2D => Texture::flat(width, height, channels, bytes),
        // Six squares, one below the other, or one for all sides.
        _ => Texture::cube(width, channels, bytes),
    };
    made.unwrap_or_else(Texture::white)
}
