//! Pictures of simple scenes, drawn on the CPU: small ones, fast.
//!
//! A [`Scene`] holds planes, ellipsoids, capsules, cylinders, boxes and meshes with materials, lights and a camera; [`Assets`]
//! hold textures and meshes, prepared once. A [`Canvas`] draws them: colours with anti-aliasing, depths, or labels.
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
//! **The method.** Pictures are so small that triangles of a finely divided sphere would be smaller than pixels. So shapes are met
//! by rays, a row of them at a time (`cast`), and only meshes are triangles, in versions as coarse as the picture allows (`mesh`).
//! Both leave the nearest thing at every sample (`layers`); light is computed once a pixel and thing, many at a time (`paint`).
//! What light does not reach is found in the same way, from the light (`shadow`).
//!
//! **The model** is the fixed pipeline of OpenGL as MuJoCo uses it, down to where light is interpolated (planes and boxes)
//! and how textures are filtered, so that pictures are those that MuJoCo's renderer draws, but for some rims.
//!
//! **Threads.** A large picture is cut into strips of rows (`split`), each drawn by a thread (`strip`), while others cast shadows.
//!
//! **What is kept.** What stands still is drawn once: the next picture from the same place begins with a copy of it (`still`). So does
//! the map of a light. The sky is looked up once for each direction one looks in (`sky`).
//!
//! **Determinism.** A picture's bytes depend on the scene alone, not on how it was cut, nor on what
//! was drawn before. Numbers are single precision without fused operations.

#[cfg(test)]
extern crate self as swm_raster;

mod canvas;
mod cast;
mod layers;
mod light;
mod mesh;
mod paint;
mod scalar;
mod scene;
mod shadow;
mod sky;
mod split;
mod still;
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
