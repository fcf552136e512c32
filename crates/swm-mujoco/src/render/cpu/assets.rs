//! Converts the meshes and textures of a compiled model for `swm-raster` at the first rendering, and caches them. All
//! copies of one compiled model (one `Appearance::group`) share them.

use crate::physics::Appearance;
use mujoco_rs::mujoco_c::mjtTexture;
use mujoco_rs::wrappers::MjModel;
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use swm_raster::{Assets, Corner, Mesh, Texture, V3};

/// The number of model groups that are cached; the least recently used group is dropped first.
const MAX_GROUPS: usize = 16;

/// The number of textures that are cached per group before edited textures are dropped.
const MAX_TEXTURES: usize = 64;

/// Below this cosine between vertex and face normal, MuJoCo shades a mesh vertex with the face normal.
const SMOOTH_COSINE: f32 = 0.8;

/// The converted assets of a model group.
struct Group {
    meshes: Vec<Arc<Mesh>>,
    /// By texture index and content hash.
    textures: BTreeMap<(usize, u64), Arc<Texture>>,
}

/// Sets `assets` to the meshes and textures of a model.
pub(super) fn fill(assets: &mut Assets, model: &MjModel, appearance: &Appearance) {
    static CACHE: Mutex<Vec<(u64, Group)>> = Mutex::new(vec![]);
    let mut cache = CACHE.lock().unwrap_or_else(PoisonError::into_inner);
    let (group_number, mut group) = match cache.iter().position(|(group_number, _)| *group_number == appearance.group) {
        Some(index) => cache.remove(index),
        None => {
            let meshes = (0..model.mesh_vertadr().len()).map(|i| Arc::new(mesh(model, i)));
            let mut meshes: Vec<_> = meshes.collect();
            meshes.extend((0..model.hfield_adr().len()).map(|i| Arc::new(height_field(model, i))));
            (appearance.group, Group { meshes, textures: BTreeMap::new() })
        }
    };
    if group.textures.len() > MAX_TEXTURES {
        // Hash 0 is the texture of the compiled model.
        group.textures.retain(|(_, content), _| *content == 0);
    }
    let textures = appearance.textures.iter().enumerate().map(|(index, &content)| {
        let texture = group.textures.entry((index, content)).or_insert_with(|| Arc::new(texture(model, index)));
        Arc::clone(texture)
    });
    assets.textures.clear();
    assets.textures.extend(textures);
    assets.meshes.clone_from(&group.meshes);
    if cache.len() >= MAX_GROUPS {
        cache.remove(0);
    }
    cache.push((group_number, group));
}

/// Converts a count or an address of MuJoCo to an index; 0 for negative values.
fn index(value: impl TryInto<usize>) -> usize {
    value.try_into().unwrap_or(0)
}

/// Converts a mesh, with the vertex normals that MuJoCo shades with.
fn mesh(model: &MjModel, asset: usize) -> Mesh {
    let first = |starts: &[i32]| index(starts[asset]);
    let (vertices, normals) = (first(model.mesh_vertadr()), first(model.mesh_normaladr()));
    let coordinates = usize::try_from(model.mesh_texcoordadr()[asset]).ok();
    let faces = first(model.mesh_faceadr())..first(model.mesh_faceadr()) + index(model.mesh_facenum()[asset]);
    Mesh::new(faces.map(|face| {
        let positions = model.mesh_face()[face].map(|i| model.mesh_vert()[vertices + index(i)]);
        let flat = face_normal(positions);
        std::array::from_fn(|k| {
            let vertex_normal = model.mesh_normal()[normals + index(model.mesh_facenormal()[face][k])];
            let smooth = vertex_normal.iter().zip(flat).map(|(a, b)| a * b).sum::<f32>() >= SMOOTH_COSINE;
            Corner {
                position: positions[k],
                normal: if coordinates.is_some() || smooth { vertex_normal } else { flat },
                coordinates: coordinates
                    .map_or([0.0; 2], |first| model.mesh_texcoord()[first + index(model.mesh_facetexcoord()[face][k])]),
            }
        })
    }))
}

/// The unit normal of a triangle; +z for a degenerate triangle.
fn face_normal([a, b, c]: [V3; 3]) -> V3 {
    let (u, v): (V3, V3) = (std::array::from_fn(|k| b[k] - a[k]), std::array::from_fn(|k| c[k] - a[k]));
    let n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
    let length = n.iter().map(|x| x * x).sum::<f32>().sqrt();
    if length > 0.0 { n.map(|x| x / length) } else { [0.0, 0.0, 1.0] }
}

/// Converts a height field: surface, four side walls and bottom.
fn height_field(model: &MjModel, asset: usize) -> Mesh {
    let (rows, columns) = (index(model.hfield_nrow()[asset]), index(model.hfield_ncol()[asset]));
    let [x, y, above, below] = model.hfield_size()[asset].map(|size| size as f32);
    let heights = &model.hfield_data()[index(model.hfield_adr()[asset])..];
    let along = |i: usize, n: usize, half: f32| half * (2.0 * i as f32 / (n.max(2) - 1) as f32 - 1.0);
    let at = |r: usize, c: usize| [along(c, columns, x), along(r, rows, y), above * heights[r * columns + c]];
    let foot = |r: usize, c: usize| [along(c, columns, x), along(r, rows, y), -below];
    let mut triangles = vec![];
    let mut triangle = |positions: [V3; 3]| {
        let normal = face_normal(positions);
        triangles.push(positions.map(|position| Corner { position, normal, coordinates: [0.0; 2] }));
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

/// Converts a texture. Returns a white texture if its data do not match its size or its channels are not supported.
fn texture(model: &MjModel, asset: usize) -> Texture {
    let (width, height) = (index(model.tex_width()[asset]), index(model.tex_height()[asset]));
    let channels = index(model.tex_nchannel()[asset]);
    let first = index(model.tex_adr()[asset]);
    let bytes = model.tex_data().get(first..first + width * height * channels).unwrap_or_default();
    let texture = match model.tex_type()[asset] {
        mjtTexture::mjTEXTURE_2D => Texture::flat(width, height, channels, bytes),
        // Six square faces stacked vertically, or one face for all sides.
        _ => Texture::cube(width, channels, bytes),
    };
    texture.unwrap_or_else(Texture::white)
}
