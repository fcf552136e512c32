//! The renderer of our own: MuJoCo's abstract scene, drawn by `swm-raster` on the thread that asks, and on others that
//! have nothing else to do ([`share`]).
//!
//! It needs no graphics library, and gives the same bytes on every machine. What MuJoCo derives when it makes a context for a
//! model (the grids of planes, corners of meshes, smaller textures) is derived here once for all models of a group, and kept.

mod assets;
mod convert;

use super::{Look, Picture, Renderer, Scene};
use std::cell::RefCell;
use swm_core::{Error, Result, share};
use swm_raster::{Assets, Canvas, Target};

/// The renderer: all it keeps is kept by threads ([`DESKS`]).
pub(crate) struct Cpu;

/// What drawing needs, and keeps from picture to picture.
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
        if width.max(height) > 16384 {
            let size = format!("{width} x {height} pixels");
            return Err(Error::config("size of a picture", size, "at most 16384 a side can be drawn"));
        }
        let mut desk = DESKS.with_borrow_mut(Vec::pop).unwrap_or_default();
        desk.draw(&scene, (width, height), picture);
        DESKS.with_borrow_mut(|desks| desks.push(desk));
        Ok(())
    }
}

thread_local! {
    /// One for each picture that the thread draws at a time: while it waits for others to draw their part of one, it may begin the
    /// next.
    static DESKS: RefCell<Vec<Desk>> = RefCell::default();
}

impl Desk {
    /// Draws a scene.
    fn draw(&mut self, scene: &Scene<'_>, size: (usize, usize), picture: Picture<'_>) {
        let Scene { abstracted, model, look } = scene;
        if self.look.as_ref() != Some(look) {
            assets::fill(&mut self.assets, model, look);
            self.look = Some((*look).clone());
        }
        convert::fill(&mut self.scene, abstracted, model, size);
        let samples = usize::try_from(model.vis().quality.offsamples).unwrap_or(0).max(1);
        let target = match picture {
            Picture::Rgb(bytes) => Target::Rgb(bytes),
            Picture::Depth(metres) => Target::Depth(metres),
            Picture::Segmentation(geoms) => Target::Labels(geoms),
        };
        self.canvas.spread(share::threads());
        self.canvas.draw(&self.scene, &self.assets, size, samples, target);
    }
}
