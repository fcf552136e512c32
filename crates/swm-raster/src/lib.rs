//! A CPU renderer of small frames of simple 3-D scenes.
//!
//! A [`Scene`] holds planes, ellipsoids, capsules, cylinders, boxes and meshes with materials, lights and a camera.
//! [`Assets`] hold textures and meshes, prepared once. A [`Canvas`] draws scenes: anti-aliased colours, depths,
//! or labels.
//!
//! ```
//! use swm_raster::{Assets, Camera, Canvas, Geom, IDENTITY, Scene, Shape, Target};
//! let ball = Geom {
//!     shape: Shape::Ellipsoid([1.0; 3]),
//!     position: [0.0, 5.0, 0.0],
//!     rotation: IDENTITY,
//!     rgba: [1.0, 0.0, 0.0, 1.0],
//!     emission: 0.0,
//!     specular: 0.5,
//!     shininess: 0.5,
//!     reflectance: 0.0,
//!     paint: None,
//!     label: Some(7),
//!     casts: true,
//! };
//! let camera = Camera {
//!     forward: [0.0, 1.0, 0.0],
//!     up: [0.0, 0.0, 1.0],
//!     frustum: [-0.1, 0.1, -0.1, 0.1],
//!     near: 0.2,
//!     far: 100.0,
//!     ..Camera::default()
//! };
//! let scene = Scene { camera, geoms: vec![ball], ..Scene::default() };
//! let mut labels = [0; 9];
//! Canvas::new().draw(&scene, &Assets::default(), (3, 3), 1, Target::Labels(&mut labels));
//! assert_eq!(labels, [-1, -1, -1, -1, 7, -1, -1, -1, -1]);
//! ```
//!
//! **Method.** In small frames the triangles of a finely divided sphere would be smaller than pixels. So primitives are
//! ray cast, a row of rays at a time (`cast`), and only meshes are rasterised, at the coarsest detail level whose
//! difference is not visible (`mesh`). Primitives and meshes share one depth buffer (`layers`). Shading runs once per
//! pixel and geom, for many fragments at a time (`paint`). Shadow maps are drawn in the same way from the light
//! (`shadow`).
//!
//! **Model.** The fixed pipeline of OpenGL as MuJoCo uses it, including the interpolated lighting of planes and
//! boxes and the filtering of textures. Frames equal those of MuJoCo's renderer except at some edges.
//!
//! **Threads.** A large frame is split into strips of rows (`split`), one thread each (`strip`), while other threads
//! draw shadow maps.
//!
//! **Caches.** Static geometry is drawn once per view; later frames begin with a copy of its depth buffer
//! (`geometry_cache`). Shadow maps are cached in the same way. The sky is looked up once per camera direction (`sky`).
//!
//! **Determinism.** The bytes of a frame depend on the scene alone, not on the number of threads nor on earlier
//! frames. Arithmetic is single precision without fused operations.

#[cfg(test)]
extern crate self as swm_raster;

mod canvas;
mod cast;
mod geometry_cache;
mod layers;
mod light;
mod mesh;
mod paint;
mod scalar;
mod scene;
mod shadow;
mod sky;
mod split;
mod strip;
mod texture;
mod vector;
mod view;

#[cfg(test)]
#[path = "../tests/it/scenes.rs"]
mod scenes;

pub use canvas::{Canvas, Target};
pub use mesh::{Corner, Mesh};
pub use scene::{Assets, Axis, Camera, Geom, Haze, Light, Mapping, Paint, Scene, Shape};
pub use texture::Texture;
pub use vector::{IDENTITY, V3};
