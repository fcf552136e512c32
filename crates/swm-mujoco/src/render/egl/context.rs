//! The OpenGL contexts of a render thread. Each model group (all copies of one compiled model) has one `mjrContext`,
//! which holds its meshes and textures.

use super::library::{Display, GlContext, Library};
use crate::physics::Appearance;
use crate::render::renderer::{FrameBuffer, ModelScene};
use crate::{ffi, link};
use mujoco_rs::mujoco_c::{
    mjModel, mjr_defaultContext, mjrContext, mjrRect, mjtFontScale, mjtFramebuffer, mjtObj, mjvScene,
};
use mujoco_rs::wrappers::MjModel;
use std::ffi::c_int;
use std::sync::{Arc, Mutex, PoisonError};
use swm_core::{Error, Result};

/// The number of contexts that a thread caches; the least recently used context is dropped first. Each context holds a
/// shadow map of 64 MB, a frame buffer, meshes and textures.
const MAX_CONTEXTS: usize = 4;

/// Serialises the creation and destruction of contexts: MuJoCo counts them in an unguarded variable.
static CONTEXT_LOCK: Mutex<()> = Mutex::new(());

/// The contexts of one thread. The most recently used context is the last.
pub struct RenderContexts {
    library: Arc<Library>,
    display: Display,
    cached: Vec<RenderContext>,
    /// Receives the colours of a segmentation before they are decoded.
    scratch: Vec<u8>,
}

/// A context for the models of one group. Each has its own OpenGL context, because MuJoCo leaves lights and the shadow
/// map in OpenGL's state.
struct RenderContext {
    library: Arc<Library>,
    gl: GlContext,
    inner: Box<mjrContext>,
    /// The meshes and textures that were uploaded to the device.
    uploaded: Appearance,
}

impl RenderContexts {
    /// An empty cache that creates contexts on this display.
    pub fn new(library: Arc<Library>, display: Display) -> Self {
        Self { library, display, cached: vec![], scratch: vec![] }
    }

    /// Renders a scene into the caller's buffer.
    ///
    /// # Errors
    /// When the frame is too large, or OpenGL or MuJoCo fails. The next call then creates a new context.
    pub fn draw(
        &mut self,
        scene: ModelScene<'_>,
        (width, height): (usize, usize),
        buffer: FrameBuffer<'_>,
    ) -> Result<()> {
        let size = |pixels: usize| match c_int::try_from(pixels) {
            Ok(pixels) if pixels <= 16384 => Ok(pixels),
            _ => Err(Error::config("the frame size", format!("{pixels} pixels"), "choose at most 16384 pixels a side")),
        };
        let rect = mjrRect { left: 0, bottom: 0, width: size(width)?, height: size(height)? };
        let ModelScene { scene, model, appearance } = scene;
        let mut context = match self.cached.iter().position(|context| context.uploaded.group == appearance.group) {
            Some(index) => {
                let context = self.cached.remove(index);
                self.library.bind(&context.gl)?;
                context
            }
            None => {
                if self.cached.len() == MAX_CONTEXTS {
                    self.cached.remove(0);
                }
                RenderContext::new(Arc::clone(&self.library), self.display, model, appearance)?
            }
        };
        context.prepare(model, appearance, rect)?;
        context.render(scene, rect)?;
        match buffer {
            FrameBuffer::Rgb(bytes) => {
                context.read(Some(bytes), None, rect)?;
                flip_rows(bytes, 3 * width);
            }
            FrameBuffer::Depth(metres) => {
                context.read(None, Some(metres), rect)?;
                flip_rows(metres, width);
                depth_to_metres(metres, scene);
            }
            FrameBuffer::Segmentation(geoms) => {
                self.scratch.resize(3 * width * height, 0);
                context.read(Some(&mut self.scratch), None, rect)?;
                flip_rows(&mut self.scratch, 3 * width);
                colours_to_geoms(&self.scratch, geoms, scene);
            }
        }
        self.cached.push(context);
        Ok(())
    }
}

impl RenderContext {
    /// Creates a context for a model and binds it to this thread.
    fn new(library: Arc<Library>, display: Display, model: &MjModel, appearance: &Appearance) -> Result<Self> {
        let gl = library.create_context(display)?;
        match Self::make(model) {
            Ok(inner) => Ok(Self { library, gl, inner, uploaded: appearance.clone() }),
            Err(error) => {
                library.destroy_context(&gl);
                Err(error)
            }
        }
    }

    /// Creates MuJoCo's context in the OpenGL context that is bound.
    fn make(model: &MjModel) -> Result<Box<mjrContext>> {
        let mut inner = Box::new_uninit();
        let model: *const mjModel = model.ffi();
        let lock = CONTEXT_LOCK.lock().unwrap_or_else(PoisonError::into_inner);
        // SAFETY: `mjr_defaultContext` initialises the context, and `mjr_makeContext` fills it for a valid model.
        let inner = unsafe {
            mjr_defaultContext(inner.as_mut_ptr());
            let mut inner = inner.assume_init();
            let pointer = &raw mut *inner;
            link::guard("creating a rendering context", || {
                ffi::mjr_makeContext(model, pointer, mjtFontScale::mjFONTSCALE_100 as c_int)
            })?;
            inner
        };
        drop(lock);
        Ok(inner)
    }

    /// Selects the offscreen buffer as the render target.
    fn select_offscreen(&mut self) -> Result<()> {
        let context = &raw mut *self.inner;
        // SAFETY: the context was created by `make`.
        link::guard("selecting a buffer", || unsafe {
            ffi::mjr_setBuffer(mjtFramebuffer::mjFB_OFFSCREEN as c_int, context);
        })
    }

    /// Prepares the context for a frame size and for a model of the context's group.
    fn prepare(&mut self, model: &MjModel, appearance: &Appearance, rect: mjrRect) -> Result<()> {
        let (width, height) = (rect.width.max(self.inner.offWidth), rect.height.max(self.inner.offHeight));
        if (width, height) != (self.inner.offWidth, self.inner.offHeight) {
            let context = &raw mut *self.inner;
            // SAFETY: the context was created by `make`.
            link::guard("resizing a buffer", || unsafe { ffi::mjr_resizeOffscreen(width, height, context) })?;
        }
        self.select_offscreen()?;
        // MuJoCo copies these values from the model only when a context is created.
        let (vis, extent) = (model.vis(), model.stat().extent as f32);
        self.inner.lineWidth = vis.global.linewidth;
        self.inner.shadowClip = extent * vis.map.shadowclip;
        self.inner.shadowScale = vis.map.shadowscale;
        self.inner.fogStart = extent * vis.map.fogstart;
        self.inner.fogEnd = extent * vis.map.fogend;
        self.inner.fogRGBA = vis.rgba.fog;
        if appearance.textures != self.uploaded.textures {
            for (index, (now, uploaded)) in appearance.textures.iter().zip(&*self.uploaded.textures).enumerate() {
                if now != uploaded {
                    let index = c_int::try_from(index).unwrap_or(c_int::MAX);
                    let (model, context) = (std::ptr::from_ref(model.ffi()), &raw const *self.inner);
                    // SAFETY: the model has the sizes of the model for which the context was created.
                    link::guard("uploading a texture", || unsafe { ffi::mjr_uploadTexture(model, context, index) })?;
                }
            }
            self.uploaded = appearance.clone();
        }
        Ok(())
    }

    fn render(&mut self, scene: &mut mjvScene, rect: mjrRect) -> Result<()> {
        let context = &raw const *self.inner;
        // SAFETY: scene and context were created for models of the same sizes.
        link::guard("rendering a scene", || unsafe { ffi::mjr_render(rect, scene, context) })
    }

    /// Reads the rendered pixels, bottom row first.
    fn read(&mut self, rgb: Option<&mut [u8]>, depth: Option<&mut [f32]>, rect: mjrRect) -> Result<()> {
        let rgb = rgb.map_or(std::ptr::null_mut(), <[u8]>::as_mut_ptr);
        let depth = depth.map_or(std::ptr::null_mut(), <[f32]>::as_mut_ptr);
        let context = &raw const *self.inner;
        // SAFETY: the buffers have room for the rectangle, which `render::draw` checked.
        link::guard("reading a frame", || unsafe { ffi::mjr_readPixels(rgb, depth, rect, context) })
    }
}

impl Drop for RenderContext {
    fn drop(&mut self) {
        let _lock = CONTEXT_LOCK.lock().unwrap_or_else(PoisonError::into_inner);
        let context = &raw mut *self.inner;
        if self.library.bind(&self.gl).is_ok() {
            // An error here cannot be handled, and the context is not used again.
            // SAFETY: the context was created on this thread.
            let _ignored = link::guard("freeing a rendering context", || unsafe { ffi::mjr_freeContext(context) });
        }
        self.library.destroy_context(&self.gl);
    }
}

/// Reverses the order of the rows: OpenGL returns the bottom row first.
fn flip_rows<T>(pixels: &mut [T], row: usize) {
    let rows = pixels.len() / row;
    let (upper, lower) = pixels.split_at_mut(rows / 2 * row);
    for (above, below) in upper.chunks_exact_mut(row).zip(lower.chunks_exact_mut(row).rev()) {
        above.swap_with_slice(below);
    }
}

/// Converts values of the depth buffer (0 at the near plane, 1 at the far plane) to distances in metres.
fn depth_to_metres(depth: &mut [f32], scene: &mjvScene) {
    let (near, far) = (scene.camera[0].frustum_near, scene.camera[0].frustum_far);
    for value in depth {
        *value = near / (1.0 - *value * (1.0 - near / far));
    }
}

/// Decodes segmentation colours, which number the geoms of the scene, to indices of geoms in the model.
fn colours_to_geoms(colours: &[u8], geoms: &mut [i32], scene: &mjvScene) {
    let count = usize::try_from(scene.ngeom).unwrap_or(0);
    // SAFETY: `geoms` points to `ngeom` geoms.
    let scene_geoms = unsafe { std::slice::from_raw_parts(scene.geoms, count) };
    for (&[red, green, blue], geom) in colours.as_chunks().0.iter().zip(geoms) {
        let number = i32::from(red) | i32::from(green) << 8 | i32::from(blue) << 16;
        // 0 is the background; `segid` counts from 0 in the order of the scene.
        let found = usize::try_from(number - 1).ok().and_then(|index| scene_geoms.get(index));
        *geom = match found {
            Some(found) if found.objtype == mjtObj::mjOBJ_GEOM as i32 => found.objid,
            _ => -1,
        };
    }
}
