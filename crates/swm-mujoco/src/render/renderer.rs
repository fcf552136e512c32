//! [`Renderer`]: the trait that both renderers implement, and its argument types.

use crate::physics::Appearance;
use mujoco_rs::mujoco_c::mjvScene;
use mujoco_rs::wrappers::MjModel;
use swm_core::Result;

/// The viewpoint of a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Camera {
    /// The free camera at the default pose of the model.
    Free,
    /// A camera that orbits a point.
    Orbit {
        /// The point in the centre of the image, in metres.
        lookat: [f64; 3],
        /// Distance from the point, in metres.
        distance: f64,
        /// Angle around the vertical axis, in degrees.
        azimuth: f64,
        /// Angle above the horizon, in degrees; negative for a camera that points down.
        elevation: f64,
    },
    /// A camera of the model, by index.
    Fixed(usize),
}

/// The modality to render, with its buffer of row-major `[height, width]` pixels, top row first.
pub enum FrameBuffer<'a> {
    /// Red, green, blue: three bytes per pixel.
    Rgb(&'a mut [u8]),
    /// Distance from the camera plane, in metres.
    Depth(&'a mut [f32]),
    /// The index of the geom at each pixel, -1 at pixels without a geom.
    Segmentation(&'a mut [i32]),
}

impl FrameBuffer<'_> {
    /// The number of elements of the buffer.
    pub(super) fn len(&self) -> usize {
        match self {
            Self::Rgb(bytes) => bytes.len(),
            Self::Depth(metres) => metres.len(),
            Self::Segmentation(geoms) => geoms.len(),
        }
    }

    /// Elements per pixel.
    pub(super) fn channels(&self) -> usize {
        match self {
            Self::Rgb(_) => 3,
            Self::Depth(_) | Self::Segmentation(_) => 1,
        }
    }
}

/// An abstract scene with the model it was made from.
pub(crate) struct ModelScene<'a> {
    pub scene: &'a mut mjvScene,
    pub model: &'a MjModel,
    pub appearance: &'a Appearance,
}

/// Renders abstract scenes. Calls are allowed from any thread and return when the frame is complete.
pub(crate) trait Renderer: Send + Sync {
    /// The name of renderer and device for logs and manifests, such as `egl (llvmpipe …)`.
    fn name(&self) -> &str;

    /// Renders a scene.
    ///
    /// # Errors
    /// When the graphics library fails.
    fn draw(&self, scene: ModelScene<'_>, width: usize, height: usize, buffer: FrameBuffer<'_>) -> Result<()>;
}
