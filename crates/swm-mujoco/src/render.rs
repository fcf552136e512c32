//! Pictures of a world: RGB, depth and segmentation, through any camera, at any size, straight into the caller's buffer.
//!
//! A [`Stage`] turns a world into MuJoCo's abstract scene (geoms, lights, cameras) on the thread that owns the world. A
//! [`Renderer`] draws scenes: MuJoCo's own, in OpenGL through EGL ([`egl`]), or ours, on the CPU ([`cpu`]). [`Choice`] says which.

mod cpu;
mod egl;
#[cfg(test)]
pub(crate) mod likeness;
mod stage;

pub(crate) use stage::Stage;

use crate::Physics;
use mujoco_rs::mujoco_c::mjvScene;
use mujoco_rs::wrappers::MjModel;
use std::cell::Cell;
use std::sync::atomic::{AtomicU8, Ordering};
use std::sync::{Arc, OnceLock};
use swm_core::{Error, Result};

/// From where a world is seen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Camera {
    /// The free camera, where the model puts it at first.
    Free,
    /// A camera around a place.
    Orbit {
        /// The place, in metres.
        lookat: [f64; 3],
        /// Metres from it.
        distance: f64,
        /// Degrees around the vertical.
        azimuth: f64,
        /// Degrees above the horizon, negative when the camera looks down.
        elevation: f64,
    },
    /// A camera of the model, by its place.
    Fixed(usize),
}

/// What to draw, and where: `height` rows of `width` pixels, the upper row first.
pub enum Picture<'a> {
    /// Red, green, blue: three bytes a pixel.
    Rgb(&'a mut [u8]),
    /// Distance along the line of sight of the camera's middle, in metres.
    Depth(&'a mut [f32]),
    /// The geom at each pixel by its place in the model, -1 where there is none.
    Segmentation(&'a mut [i32]),
}

impl Picture<'_> {
    /// Numbers it has room for.
    fn len(&self) -> usize {
        match self {
            Self::Rgb(bytes) => bytes.len(),
            Self::Depth(metres) => metres.len(),
            Self::Segmentation(geoms) => geoms.len(),
        }
    }

    /// Numbers of one pixel.
    fn channels(&self) -> usize {
        match self {
            Self::Rgb(_) => 3,
            Self::Depth(_) | Self::Segmentation(_) => 1,
        }
    }
}

/// What a renderer keeps of a model from picture to picture: which model, and what its textures are.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Look {
    /// Models of one group have the same meshes, and textures of the same sizes.
    pub group: u64,
    /// A number for the content of each texture; equal contents have equal numbers.
    pub textures: Arc<[u64]>,
}

/// What a renderer is given: an abstract scene and the model it is of.
pub(crate) struct Scene<'a> {
    pub abstracted: &'a mut mjvScene,
    pub model: &'a MjModel,
    pub look: &'a Look,
}

/// Draws scenes. Any thread may ask; the call returns when the picture is there.
pub(crate) trait Renderer: Send + Sync {
    /// What draws, for logs and manifests: `egl (llvmpipe …)`.
    fn name(&self) -> &str;

    /// Draws a scene.
    ///
    /// # Errors
    /// When the graphics library fails.
    fn draw(&self, scene: Scene<'_>, width: usize, height: usize, picture: Picture<'_>) -> Result<()>;
}

/// Which renderer draws.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Choice {
    /// MuJoCo's own where a graphics card is, ours elsewhere.
    #[default]
    Auto,
    /// MuJoCo's own, in OpenGL through EGL: on a graphics card, or in Mesa's software, which is slow.
    Egl,
    /// Ours, on the CPU.
    Cpu,
}

impl std::str::FromStr for Choice {
    type Err = Error;

    fn from_str(word: &str) -> Result<Self> {
        match word {
            "auto" => Ok(Self::Auto),
            "egl" => Ok(Self::Egl),
            "cpu" => Ok(Self::Cpu),
            _ => Err(Error::config("the renderer", word, "choose auto, egl or cpu")),
        }
    }
}

/// What this process chose, as a number.
static CHOSEN: AtomicU8 = AtomicU8::new(Choice::Auto as u8);

thread_local! {
    /// What this thread chose for a while.
    static HERE: Cell<Option<Choice>> = const { Cell::new(None) };
}

/// Chooses the renderer of all pictures that are drawn from now on.
pub fn choose(choice: Choice) {
    CHOSEN.store(choice as u8, Ordering::Relaxed);
}

/// Chooses the renderer of the pictures that `draw` asks for on this thread.
pub fn with<T>(choice: Choice, draw: impl FnOnce() -> T) -> T {
    /// Puts back what was chosen before, also when `draw` panics.
    struct Back(Option<Choice>);
    impl Drop for Back {
        fn drop(&mut self) {
            HERE.set(self.0);
        }
    }
    let _back = Back(HERE.replace(Some(choice)));
    draw()
}

/// The renderer that draws now.
fn chosen() -> Choice {
    HERE.get().unwrap_or_else(|| match CHOSEN.load(Ordering::Relaxed) {
        chosen if chosen == Choice::Egl as u8 => Choice::Egl,
        chosen if chosen == Choice::Cpu as u8 => Choice::Cpu,
        _ => Choice::Auto,
    })
}

static EGL: OnceLock<Result<egl::Egl, String>> = OnceLock::new();
static CPU: cpu::Cpu = cpu::Cpu;

/// What draws, with its device: what manifests say.
///
/// # Errors
/// When EGL was chosen and this machine has none: says what to install.
pub fn name() -> Result<String> {
    renderer().map(|renderer| renderer.name().to_owned())
}

/// The renderer to draw with.
///
/// # Errors
/// When EGL was chosen and this machine has none: says what to install.
pub(crate) fn renderer() -> Result<&'static dyn Renderer> {
    /// Whether there is a graphics card; asked once.
    static HARDWARE: OnceLock<bool> = OnceLock::new();
    let egl = match chosen() {
        Choice::Cpu => false,
        Choice::Egl => true,
        Choice::Auto => *HARDWARE.get_or_init(egl::hardware),
    };
    if !egl {
        return Ok(&CPU);
    }
    let made = EGL.get_or_init(|| {
        let made = egl::Egl::new().map_err(|error| error.to_string());
        match &made {
            Ok(renderer) => tracing::info!("pictures of MuJoCo's worlds are drawn by {}", renderer.name()),
            Err(problem) => tracing::warn!("no renderer: {problem}"),
        }
        made
    });
    match made {
        Ok(renderer) => Ok(renderer),
        Err(problem) if chosen() == Choice::Auto => {
            tracing::debug!("drawing on the CPU: {problem}");
            Ok(&CPU)
        }
        Err(problem) => Err(Error::config(
            "drawing a MuJoCo world with EGL",
            problem,
            "install EGL (Debian: apt install libegl1 libegl-mesa0 libgl1-mesa-dri), or draw with the renderer cpu",
        )),
    }
}

/// Draws a world. `stage` is made at the first picture, and kept.
///
/// # Errors
/// When there is no renderer, the buffer does not fit, or the graphics library fails.
pub(crate) fn draw(
    stage: &mut Option<Box<Stage>>,
    physics: &mut Physics,
    camera: Camera,
    (width, height): (usize, usize),
    picture: Picture<'_>,
) -> Result<()> {
    let expected = width * height * picture.channels();
    if picture.len() != expected {
        let given = format!("room for {}", picture.len());
        return Err(Error::mismatch(format!("drawing {width} x {height} pixels"), given, expected.to_string()));
    }
    if expected == 0 {
        return Ok(());
    }
    let renderer = renderer()?;
    let stage = stage.get_or_insert_with(|| Box::new(Stage::new(physics.model())));
    stage.set(physics, camera, matches!(picture, Picture::Segmentation(_)))?;
    physics.refresh_look();
    let scene = Scene { abstracted: stage.scene(), model: physics.model(), look: physics.look() };
    renderer.draw(scene, width, height, picture)
}
