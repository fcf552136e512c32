//! What a thread that draws keeps of the models it draws: MuJoCo's contexts, with meshes and textures on the device.

use super::library::{Canvas, Display, Library};
use crate::render::{Look, Picture, Scene};
use crate::{ffi, link};
use mujoco_rs::mujoco_c::{
    mjModel, mjr_defaultContext, mjrContext, mjrRect, mjtFontScale, mjtFramebuffer, mjtObj, mjvScene,
};
use mujoco_rs::wrappers::MjModel;
use std::ffi::c_int;
use std::sync::{Arc, Mutex, PoisonError};
use swm_core::{Error, Result};

/// Contexts a thread keeps; the one unused for longest makes room. Each holds a shadow map of 64 MB, and more.
const MOST: usize = 4;

/// MuJoCo counts contexts in a variable that it does not guard.
static COUNTING: Mutex<()> = Mutex::new(());

/// The contexts of one thread, the one used last at the end.
pub struct Contexts {
    library: Arc<Library>,
    display: Display,
    kept: Vec<Context>,
    /// Where coloured geoms are read to.
    scratch: Vec<u8>,
}

/// A context for models of one group. Each has a canvas of its own: MuJoCo leaves lights and the shadow map in OpenGL's
/// state, and would light one model as another.
struct Context {
    library: Arc<Library>,
    canvas: Canvas,
    inner: Box<mjrContext>,
    /// What was sent to the device.
    look: Look,
}

impl Contexts {
    /// None yet, and where they will be made.
    pub fn new(library: Arc<Library>, display: Display) -> Self {
        Self { library, display, kept: vec![], scratch: vec![] }
    }

    /// Draws a scene into the caller's buffer.
    ///
    /// # Errors
    /// When OpenGL or MuJoCo fail; the context is made anew the next time.
    pub fn draw(&mut self, scene: Scene<'_>, (width, height): (usize, usize), picture: Picture<'_>) -> Result<()> {
        let size = |pixels: usize| match c_int::try_from(pixels) {
            Ok(pixels) if pixels <= 16384 => Ok(pixels),
            _ => {
                Err(Error::config("size of a picture", format!("{pixels} pixels"), "at most 16384 a side can be drawn"))
            }
        };
        let rect = mjrRect { left: 0, bottom: 0, width: size(width)?, height: size(height)? };
        let Scene { abstracted, model, look } = scene;
        let mut context = match self.kept.iter().position(|context| context.look.group == look.group) {
            Some(place) => {
                let context = self.kept.remove(place);
                self.library.bind(&context.canvas)?;
                context
            }
            None => {
                if self.kept.len() == MOST {
                    self.kept.remove(0);
                }
                Context::new(Arc::clone(&self.library), self.display, model, look)?
            }
        };
        context.fit(model, look, rect)?;
        context.render(abstracted, rect)?;
        match picture {
            Picture::Rgb(bytes) => {
                context.read(Some(bytes), None, rect)?;
                flip(bytes, 3 * width);
            }
            Picture::Depth(metres) => {
                context.read(None, Some(metres), rect)?;
                flip(metres, width);
                to_metres(metres, abstracted);
            }
            Picture::Segmentation(geoms) => {
                self.scratch.resize(3 * width * height, 0);
                context.read(Some(&mut self.scratch), None, rect)?;
                flip(&mut self.scratch, 3 * width);
                to_geoms(&self.scratch, geoms, abstracted);
            }
        }
        self.kept.push(context);
        Ok(())
    }
}

impl Context {
    /// A context for a model, its canvas bound to this thread.
    fn new(library: Arc<Library>, display: Display, model: &MjModel, look: &Look) -> Result<Self> {
        let canvas = library.canvas(display)?;
        match Self::make(model) {
            Ok(inner) => Ok(Self { library, canvas, inner, look: look.clone() }),
            Err(error) => {
                library.discard(&canvas);
                Err(error)
            }
        }
    }

    /// MuJoCo's part of it, on the canvas that is bound.
    fn make(model: &MjModel) -> Result<Box<mjrContext>> {
        let mut inner = Box::new_uninit();
        let model: *const mjModel = model.ffi();
        let turn = COUNTING.lock().unwrap_or_else(PoisonError::into_inner);
        // SAFETY: the first call fills the context, the second makes it for a valid model.
        let inner = unsafe {
            mjr_defaultContext(inner.as_mut_ptr());
            let mut inner = inner.assume_init();
            let pointer = &raw mut *inner;
            link::guard("making a context", || {
                ffi::mjr_makeContext(model, pointer, mjtFontScale::mjFONTSCALE_100 as c_int)
            })?;
            inner
        };
        drop(turn);
        Ok(inner)
    }

    /// Draws into its own memory: not to a window, nor where another context of this thread drew last.
    fn aim(&mut self) -> Result<()> {
        let context = &raw mut *self.inner;
        // SAFETY: the context was made.
        link::guard("choosing a buffer", || unsafe {
            ffi::mjr_setBuffer(mjtFramebuffer::mjFB_OFFSCREEN as c_int, context);
        })
    }

    /// Makes it fit a model of its group, and a size.
    #[allow(clippy::cast_possible_truncation)]
    fn fit(&mut self, model: &MjModel, look: &Look, rect: mjrRect) -> Result<()> {
        let (width, height) = (rect.width.max(self.inner.offWidth), rect.height.max(self.inner.offHeight));
        if (width, height) != (self.inner.offWidth, self.inner.offHeight) {
            let context = &raw mut *self.inner;
            // SAFETY: the context was made.
            link::guard("resizing a buffer", || unsafe { ffi::mjr_resizeOffscreen(width, height, context) })?;
        }
        self.aim()?;
        // What MuJoCo takes from the model when a context is made.
        let (vis, extent) = (model.vis(), model.stat().extent as f32);
        self.inner.lineWidth = vis.global.linewidth;
        self.inner.shadowClip = extent * vis.map.shadowclip;
        self.inner.shadowScale = vis.map.shadowscale;
        self.inner.fogStart = extent * vis.map.fogstart;
        self.inner.fogEnd = extent * vis.map.fogend;
        self.inner.fogRGBA = vis.rgba.fog;
        if look.textures != self.look.textures {
            for (place, (now, known)) in look.textures.iter().zip(&*self.look.textures).enumerate() {
                if now != known {
                    let place = c_int::try_from(place).unwrap_or(c_int::MAX);
                    let (model, context) = (std::ptr::from_ref(model.ffi()), &raw const *self.inner);
                    // SAFETY: the model has the sizes of the one the context was made for.
                    link::guard("sending a texture", || unsafe { ffi::mjr_uploadTexture(model, context, place) })?;
                }
            }
            self.look = look.clone();
        }
        Ok(())
    }

    fn render(&mut self, scene: &mut mjvScene, rect: mjrRect) -> Result<()> {
        let context = &raw const *self.inner;
        // SAFETY: scene and context were made for models of the same sizes.
        link::guard("drawing a scene", || unsafe { ffi::mjr_render(rect, scene, context) })
    }

    /// Reads what was drawn, the lowest row first.
    fn read(&mut self, rgb: Option<&mut [u8]>, depth: Option<&mut [f32]>, rect: mjrRect) -> Result<()> {
        let rgb = rgb.map_or(std::ptr::null_mut(), <[u8]>::as_mut_ptr);
        let depth = depth.map_or(std::ptr::null_mut(), <[f32]>::as_mut_ptr);
        let context = &raw const *self.inner;
        // SAFETY: the buffers have room for the rectangle, which `render::draw` checked.
        link::guard("reading a picture", || unsafe { ffi::mjr_readPixels(rgb, depth, rect, context) })
    }
}

impl Drop for Context {
    fn drop(&mut self) {
        let _turn = COUNTING.lock().unwrap_or_else(PoisonError::into_inner);
        let context = &raw mut *self.inner;
        if self.library.bind(&self.canvas).is_ok() {
            // SAFETY: the context was made on this thread. An error while it goes is of no consequence to anybody.
            let _gone = link::guard("freeing a context", || unsafe { ffi::mjr_freeContext(context) });
        }
        self.library.discard(&self.canvas);
    }
}

/// Turns a picture upside down: OpenGL's rows begin below.
fn flip<T>(picture: &mut [T], row: usize) {
    let rows = picture.len() / row;
    let (upper, lower) = picture.split_at_mut(rows / 2 * row);
    for (above, below) in upper.chunks_exact_mut(row).zip(lower.chunks_exact_mut(row).rev()) {
        above.swap_with_slice(below);
    }
}

/// Turns values of the depth buffer (0 at the near plane, 1 at the far one) into distances.
fn to_metres(depth: &mut [f32], scene: &mjvScene) {
    let (near, far) = (scene.camera[0].frustum_near, scene.camera[0].frustum_far);
    for value in depth {
        *value = near / (1.0 - *value * (1.0 - near / far));
    }
}

/// Turns colours that count the geoms of the scene into places of geoms in the model.
fn to_geoms(colours: &[u8], geoms: &mut [i32], scene: &mjvScene) {
    let count = usize::try_from(scene.ngeom).unwrap_or(0);
    // SAFETY: a scene holds as many geoms as it says.
    let listed = unsafe { std::slice::from_raw_parts(scene.geoms, count) };
    for (&[red, green, blue], geom) in colours.as_chunks().0.iter().zip(geoms) {
        let number = i32::from(red) | i32::from(green) << 8 | i32::from(blue) << 16;
        // Number 0 is the background; `segid` counts from 0 in the order of the scene.
        let seen = usize::try_from(number - 1).ok().and_then(|place| listed.get(place));
        *geom = match seen {
            Some(seen) if seen.objtype == mjtObj::mjOBJ_GEOM as i32 => seen.objid,
            _ => -1,
        };
    }
}
