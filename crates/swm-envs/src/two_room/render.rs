//! Rendering: floor, walls and doors as an exact area average of the 224-pixel frame at any size, with soft discs for
//! target and agent over them.
//!
//! Everything but the agent is static during an episode, so it is drawn once per frame size. At 224 pixels this
//! background equals the reference's bit for bit (apart from the line in `border_color`), and the discs differ from the
//! reference's by rounding only.

use super::physics::WALL_CENTER;
use crate::draw::{Brush, BySize, Rgb, SoftDisc};
use crate::point_agent::room::{BORDER, LINE, SIZE};
use swm_core::FrameMut;

/// Width of the outermost part of the room's lines, drawn in `border_color`, in pixels. The reference ignores that
/// colour; a narrow line shows the colour and hardly changes the frame.
const EDGE: f64 = 0.5;

/// Geometry and colours of everything but the agent. Lengths are in pixels of the 224-pixel frame.
#[derive(Clone, Debug, PartialEq)]
pub struct RoomAppearance {
    /// Colour of the floor.
    pub floor: Rgb,
    /// Colour of the wall and of the lines around the room.
    pub wall: Rgb,
    /// Colour of the outer edge of the lines around the room.
    pub border: Rgb,
    /// Colour of the doors.
    pub door: Rgb,
    /// The axis that crosses the wall: 0 (x) or 1 (y).
    pub across: usize,
    /// Half the wall's thickness.
    pub half_thickness: f64,
    /// Centre and half-width of every door, along the wall.
    pub doors: Vec<[f64; 2]>,
    /// The target, if it is drawn.
    pub target: Option<SoftDisc>,
}

impl RoomAppearance {
    /// Returns the colour at a point of the 224-pixel frame, measured from its upper left corner.
    fn color_at(&self, p: [f64; 2]) -> Rgb {
        // The distance of each coordinate from the outer edge of the room's lines; negative outside.
        let depth = p.map(|v| v.min(SIZE - v) - (BORDER - LINE));
        let on = |depth: f64, width: f64| (0.0..width).contains(&depth);
        if depth.iter().all(|&d| d >= 0.0) && depth.iter().any(|&d| on(d, EDGE)) {
            self.border
        } else if depth.iter().any(|&d| on(d, LINE)) {
            self.wall
        } else if (p[self.across] - (WALL_CENTER + 0.5)).abs() > self.half_thickness + 0.5 {
            self.floor
        } else if self.doors.iter().any(|&[center, size]| (p[1 - self.across] - (center + 0.5)).abs() < size + 0.5) {
            self.door
        } else {
            self.wall
        }
    }

    /// Returns the coordinates along the x (0) or y (1) axis at which colours may change, ascending, from 0 to
    /// [`SIZE`].
    fn breaks(&self, axis: usize) -> Vec<f64> {
        let outer = BORDER - LINE;
        let mut breaks = vec![0.0, outer, outer + EDGE, BORDER];
        for i in 0..4 {
            breaks.push(SIZE - breaks[i]);
        }
        if axis == self.across {
            breaks.extend([WALL_CENTER - self.half_thickness, WALL_CENTER + self.half_thickness + 1.0]);
        } else {
            breaks.extend(self.doors.iter().flat_map(|[center, size]| [center - size, center + size + 1.0]));
        }
        breaks.retain(|b| (0.0..=SIZE).contains(b));
        breaks.sort_by(f64::total_cmp);
        breaks.dedup();
        breaks
    }

    /// Draws everything but the target into `rgb`, `[height, width, 3]`: every pixel is the average over its area.
    fn draw(&self, width: usize, height: usize, rgb: &mut [u8]) {
        let [xs, ys] = [self.breaks(0), self.breaks(1)];
        let columns: Vec<Vec<(usize, f64)>> = (0..width).map(|i| overlaps(&xs, i, width)).collect();
        let mut above: Option<Vec<(usize, f64)>> = None;
        for y in 0..height {
            let row = overlaps(&ys, y, height);
            let (drawn, rest) = rgb.split_at_mut(y * width * 3);
            if above.as_ref() == Some(&row) {
                rest[..width * 3].copy_from_slice(&drawn[(y - 1) * width * 3..]);
                continue;
            }
            let mixed: Vec<[f64; 3]> = xs
                .windows(2)
                .map(|x| {
                    average(&row, |j| self.color_at([(x[0] + x[1]) / 2.0, (ys[j] + ys[j + 1]) / 2.0]).map(f64::from))
                })
                .collect();
            for (pixel, column) in rest.as_chunks_mut::<3>().0.iter_mut().zip(&columns) {
                *pixel = average(column, |i| mixed[i]).map(|v| (v + 0.5) as u8);
            }
            above = Some(row);
        }
    }
}

/// Returns the cells between `breaks` that a pixel overlaps, each with its share of the pixel.
fn overlaps(breaks: &[f64], pixel: usize, pixels: usize) -> Vec<(usize, f64)> {
    let scale = SIZE / pixels as f64;
    let (start, end) = (pixel as f64 * scale, (pixel + 1) as f64 * scale);
    let overlap = |i: usize| (breaks[i + 1].min(end) - breaks[i].max(start)) / scale;
    (0..breaks.len() - 1).map(|i| (i, overlap(i))).filter(|&(_, share)| share > 1e-9).collect()
}

/// Returns the weighted mean of the colours of some cells.
fn average(cells: &[(usize, f64)], color: impl Fn(usize) -> [f64; 3]) -> [f64; 3] {
    cells.iter().fold([0.0; 3], |sum, &(i, share)| {
        let color = color(i);
        std::array::from_fn(|c| sum[c] + color[c] * share)
    })
}

/// Draws frames. It caches the background of the last appearance at the sizes in use.
#[derive(Default)]
pub struct RoomRenderer {
    appearance: Option<RoomAppearance>,
    backgrounds: BySize<Vec<u8>>,
    brush: Brush,
}

impl RoomRenderer {
    /// Draws a frame with the agent.
    pub fn draw(&mut self, appearance: &RoomAppearance, agent: &SoftDisc, frame: FrameMut<'_>) {
        let FrameMut { width, height, rgb } = frame;
        if self.appearance.as_ref() != Some(appearance) {
            self.appearance = Some(appearance.clone());
            self.backgrounds.invalidate();
        }
        let create = || vec![0; width * height * 3];
        let slot = self.backgrounds.slot(width, height, create, |background| {
            appearance.draw(width, height, background);
            if let Some(target) = &appearance.target {
                self.brush.blend(target, width, height, background);
            }
        });
        rgb.copy_from_slice(&self.backgrounds[slot]);
        self.brush.blend(agent, width, height, rgb);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn drawn(width: usize, height: usize) -> Vec<u8> {
        let appearance = RoomAppearance {
            floor: [250, 200, 100],
            wall: [10, 20, 30],
            border: [40, 50, 60],
            door: [70, 80, 90],
            across: 0,
            half_thickness: 5.0,
            doors: vec![[60.0, 14.0], [3.0, 9.0]],
            target: None,
        };
        let mut rgb = vec![0; width * height * 3];
        appearance.draw(width, height, &mut rgb);
        rgb
    }

    #[test]
    fn frames_of_other_sizes_are_area_averages() {
        let native = drawn(224, 224);
        for (w, h) in [(112, 112), (32, 56), (7, 1)] {
            let (dx, dy) = (224 / w, 224 / h);
            for (i, &byte) in drawn(w, h).iter().enumerate() {
                let (x, y, c) = (i / 3 % w, i / 3 / w, i % 3);
                let cells = (0..dx * dy).map(|k| native[((y * dy + k / dx) * 224 + x * dx + k % dx) * 3 + c]);
                let mean = cells.map(f64::from).sum::<f64>() / (dx * dy) as f64;
                assert!((f64::from(byte) - mean).abs() <= 0.501, "{w} x {h}, pixel {x} {y}: {byte}, not {mean}");
            }
        }
        // Averaging 2 x 2 pixels of the frame drawn at twice the size gives the native frame.
        let large = drawn(448, 448);
        for (i, &byte) in native.iter().enumerate() {
            let (x, y, c) = (i / 3 % 224, i / 3 / 224, i % 3);
            let four = [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(u, v)| large[((2 * y + v) * 448 + 2 * x + u) * 3 + c]);
            let mean = four.map(f64::from).iter().sum::<f64>() / 4.0;
            assert!((f64::from(byte) - mean).abs() <= 0.501, "pixel {x} {y}: {byte}, not {mean}");
        }
    }
}
