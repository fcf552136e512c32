//! Shading: gathers the visible fragments of a frame by geom and lights up to [`MANY`] of them at once.
//!
//! `batch` holds the fragments, `texturing` looks up textures, `light_grid` lights planes and boxes at grid corners.

mod batch;
mod light_grid;
mod texturing;

pub(crate) use batch::{Lighting, ShadingContext};

use crate::cast::PosedShape;
use crate::layers::{Layers, NOTHING, Region};
use crate::texture::MANY;
use batch::Batch;
use light_grid::LightGrids;
use std::ops::Range;
use swm_simd::LANES;

/// The number of rows that are gathered together, counted from the top of the frame. Lighting may depend on the
/// fragments that are gathered together, so strips begin at multiples of this number.
pub(crate) const BAND: usize = 64;

/// One value per fragment, with room for a last vector that is not full.
type Lane = [f32; MANY + LANES];

/// Neighbouring pixels of a row whose samples all show one geom, or one pixel of which some samples show the geom.
#[derive(Clone, Copy, Debug, Default)]
struct Run {
    geom: u32,
    /// The id of the first sample that shows the geom.
    id: u32,
    x: u16,
    y: u16,
    count: u16,
    /// The mask of the samples that show the geom.
    samples: u8,
}

/// The memory of shading, reused between frames.
#[derive(Default)]
pub(crate) struct Painter {
    runs: Vec<Run>,
    /// The runs, sorted by geom.
    sorted: Vec<Run>,
    /// The runs that are being shaded.
    lit: Vec<Run>,
    /// The number of runs of each geom; after sorting, the index after the geom's last sorted run.
    counts: Vec<usize>,
    /// The geoms that have runs.
    present: Vec<u32>,
    batch: Box<Batch>,
    grids: LightGrids,
}

impl Painter {
    /// Clears the light of the last frame, for a frame of `geoms` geoms.
    pub fn start(&mut self, geoms: usize) {
        self.grids.starts.clear();
        self.grids.starts.resize(geoms, u32::MAX);
        self.grids.colours.clear();
        self.grids.known.clear();
        self.counts.clear();
        self.counts.resize(geoms, 0);
    }

    /// Shades the content of layers within a region. Calls `show` with neighbouring pixels (counted from the first
    /// row of the layers), the covered fraction of each pixel, and their red, green and blue.
    pub fn paint(
        &mut self,
        layers: &Layers,
        context: &ShadingContext<'_>,
        region: Region,
        mut show: impl FnMut(Range<usize>, f32, [&[f32]; 3]),
    ) {
        let [x0, mut y, x1, y1] = layers.clip_to_rows(region);
        while y < y1 {
            let next = (y / BAND * BAND + BAND).min(y1);
            self.gather(layers, [x0, y, x1, next]);
            let mut begin = 0;
            for k in 0..self.present.len() {
                let index = self.present[k];
                // After sorting, counts are the ends of the runs.
                let end = std::mem::take(&mut self.counts[index as usize]);
                let geom = &context.scene.geoms[index as usize];
                let shape_pose = PosedShape::new(geom, context.view);
                let mut runs = self.sorted[begin..end].iter().copied();
                let mut rest = runs.next();
                while rest.is_some() {
                    rest = fill(&mut self.lit, rest, &mut runs);
                    self.batch.shade(&mut self.grids, &self.lit, (index, geom, shape_pose.as_ref()), layers, context);
                    self.batch.show(&self.lit, layers, &mut show);
                }
                begin = end;
            }
            y = next;
        }
    }

    /// Adds a run, or extends the last run if the new run continues it.
    #[inline]
    fn push(&mut self, run: Run, all: u8) {
        if run.samples == all
            && let Some(last) = self.runs.last_mut()
            && (last.geom, last.y, last.samples) == (run.geom, run.y, all)
            && last.x + last.count == run.x
        {
            last.count += run.count;
            return;
        }
        self.runs.push(run);
        let count = &mut self.counts[run.geom as usize];
        if *count == 0 {
            self.present.push(run.geom);
        }
        *count += 1;
    }

    /// Gathers the runs of a region, sorted by geom.
    fn gather(&mut self, layers: &Layers, [x0, y0, x1, y1]: Region) {
        self.runs.clear();
        self.present.clear();
        for y in y0..y1 {
            match layers.samples {
                1 => self.gather_row::<1>(layers, y, [x0, x1]),
                2 => self.gather_row::<2>(layers, y, [x0, x1]),
                _ => self.gather_row::<4>(layers, y, [x0, x1]),
            }
        }
        self.present.sort_unstable();
        let mut begin = 0;
        for &geom in &self.present {
            let count = &mut self.counts[geom as usize];
            (begin, *count) = (begin + *count, begin);
        }
        self.sorted.resize(self.runs.len(), Run::default());
        for run in &self.runs {
            let position = &mut self.counts[run.geom as usize];
            self.sorted[*position] = *run;
            *position += 1;
        }
    }

    /// Gathers the runs of a row with `SAMPLES` samples per pixel.
    fn gather_row<const SAMPLES: usize>(&mut self, layers: &Layers, y: usize, [x0, x1]: [usize; 2]) {
        let all = u8::MAX >> (8 - SAMPLES);
        let (pixels, _) = layers.ids[layers.span(y, x0, x1)].as_chunks::<SAMPLES>();
        let mut at = 0;
        while let Some(pixel) = pixels.get(at) {
            let id = pixel[0];
            let x = (x0 + at) as u16;
            if *pixel == [id; SAMPLES] {
                let count = pixels[at..].iter().take_while(|pixel| **pixel == [id; SAMPLES]).count();
                if id != NOTHING {
                    let run = Run { geom: layers.geom(id), id, x, y: y as u16, count: count as u16, samples: all };
                    self.push(run, all);
                }
                at += count;
                continue;
            }
            // A geom has one run in a pixel, even if several triangles of the geom are visible in the pixel.
            let geoms = pixel.map(|id| if id == NOTHING { NOTHING } else { layers.geom(id) });
            for (sample, (&geom, &id)) in geoms.iter().zip(pixel).enumerate() {
                if geom == NOTHING || geoms[..sample].contains(&geom) {
                    continue;
                }
                let same = (0..SAMPLES).filter(|&other| geoms[other] == geom);
                let samples = same.fold(0, |samples, other| samples | 1 << other);
                self.push(Run { geom, id, x, y: y as u16, count: 1, samples }, all);
            }
            at += 1;
        }
    }
}

/// Moves runs to `lit`, up to [`MANY`] pixels. Returns the next run, which may be the rest of a split run.
fn fill(lit: &mut Vec<Run>, first: Option<Run>, more: &mut impl Iterator<Item = Run>) -> Option<Run> {
    lit.clear();
    let (mut room, mut next) = (MANY as u16, first);
    while let Some(run) = next.filter(|_| room > 0) {
        let count = run.count.min(room);
        room -= count;
        lit.push(Run { count, ..run });
        let rest = Run { x: run.x + count, count: run.count - count, ..run };
        next = if rest.count > 0 { Some(rest) } else { more.next() };
    }
    next
}
