//! The CPU renderer: draws MuJoCo's abstract scenes with `swm-raster`, on the calling thread and on idle threads of its
//! pool.
//!
//! The renderer needs no graphics library and produces the same bytes on every machine. Plane grids, mesh vertices and
//! mip maps, which MuJoCo computes when it creates a rendering context, are computed here once per model group and
//! cached.

mod assets;
mod convert;

use super::renderer::{FrameBuffer, ModelScene, Renderer};
use crate::physics::Appearance;
use std::cell::RefCell;
use swm_core::{Error, Result, thread_budget};
use swm_raster::{Assets, Canvas, Target};

/// The CPU renderer. Its buffers are thread-local ([`WORKSPACES`]).
pub(crate) struct CpuRenderer;

/// The buffers of one rendering, reused from frame to frame.
#[derive(Default)]
struct Workspace {
    canvas: Canvas,
    scene: swm_raster::Scene,
    /// The assets of the model rendered last.
    assets: Assets,
    appearance: Option<Appearance>,
}

impl Renderer for CpuRenderer {
    fn name(&self) -> &str {
        "cpu (swm-raster)"
    }

    fn draw(&self, scene: ModelScene<'_>, width: usize, height: usize, buffer: FrameBuffer<'_>) -> Result<()> {
        if width.max(height) > 16384 {
            let size = format!("{width} x {height} pixels");
            return Err(Error::config("the frame size", size, "choose at most 16384 pixels a side"));
        }
        let mut workspace = WORKSPACES.with_borrow_mut(Vec::pop).unwrap_or_default();
        workspace.draw(&scene, (width, height), buffer);
        WORKSPACES.with_borrow_mut(|workspaces| workspaces.push(workspace));
        Ok(())
    }
}

thread_local! {
    /// One workspace per rendering in progress: a thread that waits for other threads to finish its frame may start
    /// another frame.
    static WORKSPACES: RefCell<Vec<Workspace>> = RefCell::default();
}

impl Workspace {
    /// Renders a scene of MuJoCo into `buffer`.
    fn draw(&mut self, from: &ModelScene<'_>, size: (usize, usize), buffer: FrameBuffer<'_>) {
        let ModelScene { scene, model, appearance } = from;
        if self.appearance.as_ref() != Some(appearance) {
            assets::fill(&mut self.assets, model, appearance);
            self.appearance = Some((*appearance).clone());
        }
        convert::fill(&mut self.scene, scene, model, size);
        let samples = usize::try_from(model.vis().quality.offsamples).unwrap_or(0).max(1);
        let target = match buffer {
            FrameBuffer::Rgb(bytes) => Target::Rgb(bytes),
            FrameBuffer::Depth(metres) => Target::Depth(metres),
            FrameBuffer::Segmentation(geoms) => Target::Labels(geoms),
        };
        self.canvas.set_threads(thread_budget::threads());
        self.canvas.draw(&self.scene, &self.assets, size, samples, target);
    }
}
