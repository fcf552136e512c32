//! [`View`]: projection between world positions and pixels, for a camera, its mirror image, or a light that casts
//! shadows.

use crate::scene::Camera;
use crate::vector::{V3, add, cross, dot, scale, sub};

/// The projection of a frame. Pixel (x, y) covers the square from (x, y) to (x + 1, y + 1); row 0 is the uppermost.
///
/// Ray directions are scaled so that the ray parameter is the depth, the distance along `forward`.
#[derive(Clone, Copy, Debug)]
pub(crate) struct View {
    pub position: V3,
    pub right: V3,
    pub up: V3,
    pub forward: V3,
    /// Left edge of the frame at depth 1, or at any depth of an orthographic view.
    pub left: f32,
    /// Upper edge of the frame at depth 1, or at any depth of an orthographic view.
    pub top: f32,
    /// Pixels per unit of length at depth 1 (at any depth of an orthographic view), along x and y.
    pub pixels_per_unit: [f32; 2],
    pub near: f32,
    pub orthographic: bool,
    pub width: usize,
    pub height: usize,
    /// Whether left and right are exchanged, so that front faces run clockwise.
    pub mirrored: bool,
}

/// The rays of a view. The ray of pixel coordinates (x, y) starts at `origin + x * origins[0] + y * origins[1]`; its
/// direction is the same sum of `direction` and `directions`.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Rays {
    pub origin: V3,
    pub origins: [V3; 2],
    pub direction: V3,
    pub directions: [V3; 2],
}

impl View {
    /// Returns the view of a camera for a frame of this size.
    pub fn of(camera: &Camera, width: usize, height: usize) -> Self {
        let [left, right, bottom, top] = camera.frustum;
        let unit = if camera.orthographic { 1.0 } else { 1.0 / camera.near };
        Self {
            position: camera.position,
            right: cross(camera.forward, camera.up),
            up: camera.up,
            forward: camera.forward,
            left: left * unit,
            top: top * unit,
            pixels_per_unit: [width as f32 / ((right - left) * unit), height as f32 / ((top - bottom) * unit)],
            near: camera.near,
            orthographic: camera.orthographic,
            width,
            height,
            mirrored: false,
        }
    }

    /// Returns the view in a mirror through `point` with this normal.
    pub fn mirrored(&self, point: V3, normal: V3) -> Self {
        let turn = |a: V3| sub(a, scale(normal, 2.0 * dot(a, normal)));
        Self {
            position: add(point, turn(sub(self.position, point))),
            right: turn(self.right),
            up: turn(self.up),
            forward: turn(self.forward),
            mirrored: !self.mirrored,
            ..*self
        }
    }

    /// Returns the rays of all pixels.
    pub fn rays(&self) -> Rays {
        let corner = add(scale(self.right, self.left), scale(self.up, self.top));
        let across = scale(self.right, 1.0 / self.pixels_per_unit[0]);
        let down = scale(self.up, -1.0 / self.pixels_per_unit[1]);
        match self.orthographic {
            true => Rays {
                origin: add(self.position, corner),
                origins: [across, down],
                direction: self.forward,
                directions: [[0.0; 3]; 2],
            },
            false => Rays {
                origin: self.position,
                origins: [[0.0; 3]; 2],
                direction: add(self.forward, corner),
                directions: [across, down],
            },
        }
    }

    /// Projects a position. Returns `[x * w, y * w, w]` for the pixel coordinates (x, y), and the depth. `w` is the
    /// depth, or 1 in an orthographic view.
    #[inline(always)]
    pub fn project(&self, position: V3) -> (V3, f32) {
        let from = sub(position, self.position);
        let depth = dot(from, self.forward);
        let w = if self.orthographic { 1.0 } else { depth };
        let x = (dot(from, self.right) - self.left * w) * self.pixels_per_unit[0];
        let y = (self.top * w - dot(from, self.up)) * self.pixels_per_unit[1];
        ([x, y, w], depth)
    }

    /// Returns the pixels per unit at a depth.
    pub fn pixels_at(&self, depth: f32) -> f32 {
        let pixels_per_unit = self.pixels_per_unit[0].max(self.pixels_per_unit[1]);
        if self.orthographic { pixels_per_unit } else { pixels_per_unit / depth.max(self.near) }
    }

    /// Returns the region of pixels that a box can touch, or `None` if it is out of sight. The box is given by its
    /// centre `middle` and the vectors from the centre to the centres of three sides.
    pub fn touched(&self, middle: V3, halves: [V3; 3]) -> Option<[usize; 4]> {
        let mut bounds = [f32::INFINITY, f32::INFINITY, f32::NEG_INFINITY, f32::NEG_INFINITY];
        let (mut behind, mut before) = (false, false);
        for corner in 0..8u8 {
            let sign = |k: u8| if corner >> k & 1 == 1 { 1.0 } else { -1.0 };
            let position = (0..3u8).fold(middle, |at, k| add(at, scale(halves[usize::from(k)], sign(k))));
            let ([x, y, w], depth) = self.project(position);
            if depth <= self.near {
                behind = true;
                continue;
            }
            before = true;
            let (x, y) = (x / w, y / w);
            bounds = [bounds[0].min(x), bounds[1].min(y), bounds[2].max(x), bounds[3].max(y)];
        }
        if !before {
            return None;
        }
        if behind && !self.orthographic {
            bounds = [0.0, 0.0, self.width as f32, self.height as f32];
        }
        // The conversion saturates, and NaN becomes 0.
        let low = |x: f32, most: usize| (x.floor() as usize).min(most);
        let high = |x: f32, most: usize| (x.ceil() as usize).min(most);
        let touched = [
            low(bounds[0], self.width),
            low(bounds[1], self.height),
            high(bounds[2], self.width),
            high(bounds[3], self.height),
        ];
        (touched[0] < touched[2] && touched[1] < touched[3]).then_some(touched)
    }
}
