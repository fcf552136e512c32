//! The picture: floor, walls and doors as an exact area average of the 224-pixel world at any size, soft discs
//! for target and agent on top.
//!
//! Everything but the agent keeps still during an episode, so it is drawn once into a background that frames
//! begin with. At 224 pixels the background equals the reference's bit for bit (the line in `border_color`
//! aside), and the discs are within a rounding of it.

use super::physics::{BORDER, CENTER, SIZE};
use crate::draw::{Brush, Disc, Rgb};
use swm_core::FrameMut;

/// The lines that frame the world are this thick, ending where the rooms begin.
const LINE: f64 = 4.0;
/// The outermost part of them, drawn in `border_color`. The reference ignores that colour: a hairline makes it seen
/// and leaves pictures the same, but for little.
const EDGE: f64 = 0.5;

/// What keeps still during an episode.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// The floor's colour.
    pub floor: Rgb,
    /// The colour of the wall and of the lines that frame the world.
    pub wall: Rgb,
    /// The colour of the frame's outer edge.
    pub border: Rgb,
    /// The doors' colour.
    pub door: Rgb,
    /// The coordinate one changes to get from room to room.
    pub across: usize,
    /// Half the wall's thickness.
    pub half: f64,
    /// Middle and half-width of every door, along the wall.
    pub doors: Vec<[f64; 2]>,
    /// The target, where it is drawn.
    pub target: Option<Disc>,
}

impl Scene {
    /// The colour at a place, in pixels of the 224-pixel picture from its upper left corner.
    fn color_at(&self, p: [f64; 2]) -> Rgb {
        // How far inside the outer edge of the frame's lines a coordinate is; negative is outside.
        let depth = p.map(|v| v.min(SIZE - v) - (BORDER - LINE));
        let on = |depth: f64, width: f64| (0.0..width).contains(&depth);
        if depth.iter().all(|&d| d >= 0.0) && depth.iter().any(|&d| on(d, EDGE)) {
            self.border
        } else if depth.iter().any(|&d| on(d, LINE)) {
            self.wall
        } else if (p[self.across] - (CENTER + 0.5)).abs() > self.half + 0.5 {
            self.floor
        } else if self.doors.iter().any(|&[center, size]| (p[1 - self.across] - (center + 0.5)).abs() < size + 0.5) {
            self.door
        } else {
            self.wall
        }
    }

    /// Where colours may change along the x (0) or y (1) axis, ascending, from 0 to the world's size.
    fn breaks(&self, axis: usize) -> Vec<f64> {
        let outer = BORDER - LINE;
        let mut breaks = vec![0.0, outer, outer + EDGE, BORDER];
        for i in 0..4 {
            breaks.push(SIZE - breaks[i]);
        }
        if axis == self.across {
            breaks.extend([CENTER - self.half, CENTER + self.half + 1.0]);
        } else {
            breaks.extend(self.doors.iter().flat_map(|[center, size]| [center - size, center + size + 1.0]));
        }
        breaks.retain(|b| (0.0..=SIZE).contains(b));
        breaks.sort_by(f64::total_cmp);
        breaks.dedup();
        breaks
    }

    /// Draws the scene, without the target: every pixel is the average of the world over its area.
    #[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    fn draw(&self, width: usize, height: usize, rgb: &mut [u8]) {
        let [xs, ys] = [self.breaks(0), self.breaks(1)];
        let columns: Vec<Vec<(usize, f64)>> = (0..width).map(|i| parts(&xs, i, width)).collect();
        let mut above: Option<Vec<(usize, f64)>> = None;
        for y in 0..height {
            let row = parts(&ys, y, height);
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

/// Which cells between `breaks` a pixel lies in, and with which share of it.
#[allow(clippy::cast_precision_loss)]
fn parts(breaks: &[f64], pixel: usize, pixels: usize) -> Vec<(usize, f64)> {
    let scale = SIZE / pixels as f64;
    let (start, end) = (pixel as f64 * scale, (pixel + 1) as f64 * scale);
    let overlap = |i: usize| (breaks[i + 1].min(end) - breaks[i].max(start)) / scale;
    (0..breaks.len() - 1).map(|i| (i, overlap(i))).filter(|&(_, share)| share > 1e-9).collect()
}

fn average(parts: &[(usize, f64)], color: impl Fn(usize) -> [f64; 3]) -> [f64; 3] {
    parts.iter().fold([0.0; 3], |sum, &(i, share)| {
        let color = color(i);
        std::array::from_fn(|c| sum[c] + color[c] * share)
    })
}

/// Draws frames, remembering the last scene at the sizes it was asked for.
#[derive(Default)]
pub struct Renderer {
    scene: Option<Scene>,
    /// The newest first.
    backgrounds: Vec<Background>,
    brush: Brush,
}

/// What keeps still, at one size.
struct Background {
    size: [usize; 2],
    rgb: Vec<u8>,
    /// Whether `rgb` shows the last scene.
    current: bool,
}

/// At how many sizes the background is kept.
const MAX_BACKGROUNDS: usize = 4;

impl Renderer {
    /// Draws a scene and the agent in it.
    pub fn draw(&mut self, scene: &Scene, agent: &Disc, frame: FrameMut<'_>) {
        let FrameMut { width, height, rgb } = frame;
        if self.scene.as_ref() != Some(scene) {
            self.scene = Some(scene.clone());
            self.backgrounds.iter_mut().for_each(|background| background.current = false);
        }
        let size = [width, height];
        let known = self.backgrounds.iter().position(|background| background.size == size);
        let place = known.unwrap_or_else(|| {
            self.backgrounds.truncate(MAX_BACKGROUNDS - 1);
            self.backgrounds.insert(0, Background { size, rgb: vec![0; width * height * 3], current: false });
            0
        });
        let background = &mut self.backgrounds[place];
        if !background.current {
            scene.draw(width, height, &mut background.rgb);
            if let Some(target) = &scene.target {
                self.brush.blend(target, width, height, &mut background.rgb);
            }
            background.current = true;
        }
        rgb.copy_from_slice(&background.rgb);
        self.brush.blend(agent, width, height, rgb);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scene() -> Scene {
        Scene {
            floor: [250, 200, 100],
            wall: [10, 20, 30],
            border: [40, 50, 60],
            door: [70, 80, 90],
            across: 0,
            half: 5.0,
            doors: vec![[60.0, 14.0], [3.0, 9.0]],
            target: None,
        }
    }

    #[test]
    fn other_sizes_are_area_averages() {
        let full = |w: usize, h: usize| {
            let mut rgb = vec![0; w * h * 3];
            scene().draw(w, h, &mut rgb);
            rgb
        };
        let world = full(224, 224);
        for (w, h) in [(112, 112), (32, 56), (7, 1)] {
            let picture = full(w, h);
            let (dx, dy) = (224 / w, 224 / h);
            for (i, &byte) in picture.iter().enumerate() {
                let (x, y, c) = (i / 3 % w, i / 3 / w, i % 3);
                let cells = (0..dx * dy).map(|k| world[((y * dy + k / dx) * 224 + x * dx + k % dx) * 3 + c]);
                let mean = cells.map(f64::from).sum::<f64>() / (dx * dy) as f64;
                assert!((f64::from(byte) - mean).abs() <= 0.501, "{w} x {h}, pixel {x} {y}: {byte}, not {mean}");
            }
        }
        // Shrinking by two what is drawn twice as large gives the same again.
        let large = full(448, 448);
        for (i, &byte) in world.iter().enumerate() {
            let (x, y, c) = (i / 3 % 224, i / 3 / 224, i % 3);
            let four = [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(u, v)| large[((2 * y + v) * 448 + 2 * x + u) * 3 + c]);
            let mean = four.map(f64::from).iter().sum::<f64>() / 4.0;
            assert!((f64::from(byte) - mean).abs() <= 0.501, "pixel {x} {y}: {byte}, not {mean}");
        }
    }
}
