//! Properties of every scene, and the known content of simple scenes.

mod arbitrary_scenes;
mod changing_scenes;
mod scenes;
mod simple_scenes;
