//! The renderer of our own: MuJoCo's abstract scene, drawn by `swm-raster` on the thread that asks.
//!
//! It needs no graphics library, and gives the same bytes on every machine. What MuJoCo derives when it makes a context for a
//! model (the grids of planes, corners of meshes, smaller textures) is derived here once for all models of a group, and kept.

mod assets;
mod convert;

use super::{Look, Picture, Renderer, Scene};
use std::cell::RefCell;
use swm_core::{Error, Result};
use swm_raster::{Assets, Canvas, Target};

/// The renderer: all it keeps is kept by threads.
pub(crate) struct Cpu;

/// What a thread keeps from picture to picture.
#[derive(Default)]
struct Desk {
    canvas: Canvas,
    scene: swm_raster::Scene,
    /// The assets of the model drawn last.
    assets: Assets,
    look: Option<Look>,
}

impl Renderer for Cpu {
    fn name(&self) -> &str {
        "cpu (swm-raster)"
    }

    fn draw(&self, scene: Scene<'_>, width: usize, height: usize, picture: Picture<'_>) -> Result<()> {
        thread_local! {
            static DESK: RefCell<Desk> = RefCell::default();
        }
        if width.max(height) > 16384 {
            let size = format!("{width} x {height} pixels");
            return Err(Error::config("size of a picture", size, "at most 16384 a side can be drawn"));
        }
        DESK.with_borrow_mut(|desk| {
            let Scene { abstracted, model, look } = scene;
            if desk.look.as_ref() != Some(look) {
                assets::fill(&mut desk.assets, model, look);
                desk.look = Some(look.clone());
            }
            convert::fill(&mut desk.scene, abstracted, model, (width, height));
            let samples = usize::try_from(model.vis().quality.offsamples).unwrap_or(0).max(1);
            let target = match picture {
                Picture::Rgb(bytes) => Target::Rgb(bytes),
                Picture::Depth(metres) => Target::Depth(metres),
                Picture::Segmentation(geoms) => Target::Labels(geoms),
            };
            desk.canvas.draw(&desk.scene, &desk.assets, (width, height), samples, target);
            Ok(())
        })
    }
}
