//! [`View`]: the way between places and pixels, of a camera, of its mirror image, or of a light that casts shadows.

use crate::scene::Camera;
use crate::vector::{V3, add, cross, dot, scale, sub};

/// A picture's geometry. Pixel (x, y) covers the square from (x, y) to (x + 1, y + 1), row 0 above.
///
/// Rays are so long that their parameter is the depth: the distance along `forward`.
#[derive(Clone, Copy, Debug)]
pub(crate) struct View {
    pub position: V3,
    pub right: V3,
    pub up: V3,
    pub forward: V3,
    /// The left and upper edge of the picture, at depth 1 or, of an orthographic one, at any.
    pub left: f32,
    pub top: f32,
    /// Pixels in a unit there.
    pub dense: [f32; 2],
    pub near: f32,
    pub orthographic: bool,
    pub width: usize,
    pub height: usize,
    /// Left and right are exchanged: the triangles one sees run clockwise.
    pub mirrored: bool,
}

/// A pencil of rays: at pixel coordinates (x, y), `origin + x * origins[0] + y * origins[1]`, and so the direction.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Rays {
    pub origin: V3,
    pub origins: [V3; 2],
    pub direction: V3,
    pub directions: [V3; 2],
}

impl View {
    /// What a camera sees in a picture of this size.
    #[allow(clippy::cast_precision_loss)]
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
            dense: [width as f32 / ((right - left) * unit), height as f32 / ((top - bottom) * unit)],
            near: camera.near,
            orthographic: camera.orthographic,
            width,
            height,
            mirrored: false,
        }
    }

    /// What is seen in a mirror: through `point`, with this normal.
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

    /// All rays.
    pub fn rays(&self) -> Rays {
        let corner = add(scale(self.right, self.left), scale(self.up, self.top));
        let across = scale(self.right, 1.0 / self.dense[0]);
        let down = scale(self.up, -1.0 / self.dense[1]);
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

    /// Pixel coordinates times `w`, and `w`: the depth, or 1 where rays are parallel; and the depth.
    #[inline(always)]
    pub fn project(&self, place: V3) -> (V3, f32) {
        let from = sub(place, self.position);
        let depth = dot(from, self.forward);
        let w = if self.orthographic { 1.0 } else { depth };
        let x = (dot(from, self.right) - self.left * w) * self.dense[0];
        let y = (self.top * w - dot(from, self.up)) * self.dense[1];
        ([x, y, w], depth)
    }

    /// How many pixels a unit has at a depth.
    pub fn pixels_at(&self, depth: f32) -> f32 {
        let dense = self.dense[0].max(self.dense[1]);
        if self.orthographic { dense } else { dense / depth.max(self.near) }
    }

    /// The pixels that a box can touch: `[x0, y0, x1, y1]`, the latter excluded; `None` where it is out of sight. The box is given by
    /// its middle, and the three vectors from there to its sides.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
    pub fn touched(&self, middle: V3, halves: [V3; 3]) -> Option<[usize; 4]> {
        let mut bounds = [f32::INFINITY, f32::INFINITY, f32::NEG_INFINITY, f32::NEG_INFINITY];
        let (mut behind, mut before) = (false, false);
        for corner in 0..8u8 {
            let sign = |k: u8| if corner >> k & 1 == 1 { 1.0 } else { -1.0 };
            let place = (0..3u8).fold(middle, |at, k| add(at, scale(halves[usize::from(k)], sign(k))));
            let ([x, y, w], depth) = self.project(place);
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
        // Conversion saturates, and NaN becomes 0.
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
