//! From what is nearest to colours: the fragments of a picture, gathered by geom and lit many at once.

use crate::cast::Posed;
use crate::layers::{Layers, NOTHING, Region, TRIANGLE};
use crate::light::{Lamp, Matter};
use crate::scalar::nearest;
use crate::scene::{Assets, Axis, Geom, Mapping, Scene, Shape};
use crate::shadow::Shadow;
use crate::texture::{MANY, Reader, Spots, Texture};
use crate::vector::{V3, add, dot, rotate, scale, sub, unrotate};
use crate::view::{Rays, View};
use std::ops::Range;
use swm_simd::vectorize;
use swm_simd::{F32x8, Kernel, LANES, dispatch_avx2};

/// Rows that are gathered at once, counted from the top of the picture. How they are lit may depend on what is gathered with them, so
/// that rows drawn by one thread begin with a band.
pub(crate) const BAND: usize = 64;

/// Quads along the side of a box, between whose corners light is interpolated.
const QUADS: usize = 4;

/// Light between corners that are at most so many pixels apart is as good as at each pixel.
const COARSE: f32 = 6.0;

/// One number for each of many fragments, and room for those that are computed with the last ones.
type Lane = [f32; MANY + LANES];

/// Pixels of a row next to each other, and which of their samples show a geom: all, or of one pixel some.
#[derive(Clone, Copy, Debug, Default)]
struct Run {
    geom: u32,
    /// What the first of the samples shows.
    id: u32,
    x: u16,
    y: u16,
    count: u16,
    /// A bit each.
    samples: u8,
}

/// Fragments of one geom.
struct Batch {
    n: usize,
    x: Lane,
    y: Lane,
    /// Distances along the rays, and then what is needed only once.
    depth: Lane,
    place: [Lane; 3],
    local: [Lane; 3],
    normal: [Lane; 3],
    coordinates: [Lane; 2],
    /// Of planes and boxes: the cell of the grid, and how far inside it.
    cell: [u32; MANY],
    within: [Lane; 2],
    /// Of textures: how many texels a pixel covers, and the face.
    dense: Lane,
    face: [u32; MANY],
    reader: Reader,
    /// What light reaches.
    lit: Lane,
    tint: [Lane; 3],
    /// Light of one pass.
    pass: [Lane; 3],
    sum: [Lane; 3],
}

/// What lights a picture, and what each pass of lighting is: all lamps without shadows, and then one with its shadow each.
#[derive(Clone, Copy)]
pub(crate) struct Lit<'a> {
    /// Lamps without shadows.
    pub plain: &'a [Lamp],
    /// Lamps with shadows, and these.
    pub shadowed: &'a [Lamp],
    pub shadows: &'a [Shadow],
}

/// What is the same for all fragments.
pub(crate) struct Look<'a> {
    pub scene: &'a Scene,
    pub assets: &'a Assets,
    pub view: &'a View,
    pub lamps: Lit<'a>,
    /// What colours are multiplied with.
    pub dimmed: f32,
}

/// Scratch of painting.
pub(crate) struct Painter {
    runs: Vec<Run>,
    /// The same, those of a geom together.
    sorted: Vec<Run>,
    /// What is being lit.
    lit: Vec<Run>,
    /// By geom: runs, and then where the next one goes.
    counts: Vec<usize>,
    present: Vec<u32>,
    batch: Box<Batch>,
    lattices: Lattices,
}

impl Default for Painter {
    fn default() -> Self {
        const ZERO: Lane = [0.0; MANY + LANES];
        Self {
            runs: vec![],
            sorted: vec![],
            lit: vec![],
            counts: vec![],
            present: vec![],
            batch: Box::new(Batch {
                n: 0,
                x: ZERO,
                y: ZERO,
                depth: ZERO,
                place: [ZERO; 3],
                local: [ZERO; 3],
                normal: [ZERO; 3],
                coordinates: [ZERO; 2],
                cell: [0; MANY],
                within: [ZERO; 2],
                dense: ZERO,
                face: [0; MANY],
                reader: Reader::default(),
                lit: ZERO,
                tint: [ZERO; 3],
                pass: [ZERO; 3],
                sum: [ZERO; 3],
            }),
            lattices: Lattices::default(),
        }
    }
}

/// Light at the corners of the grids of planes and boxes, computed when it is needed first.
#[derive(Default)]
struct Lattices {
    /// By geom: where its corners begin; `u32::MAX` for those that have none yet.
    starts: Vec<u32>,
    /// By corner and pass.
    colours: Vec<V3>,
    known: Vec<bool>,
}

impl Painter {
    /// Forgets the light of the last picture; `geoms` are in this one.
    pub fn start(&mut self, geoms: usize) {
        self.lattices.starts.clear();
        self.lattices.starts.resize(geoms, u32::MAX);
        self.lattices.colours.clear();
        self.lattices.known.clear();
        self.counts.clear();
        self.counts.resize(geoms, 0);
    }

    /// Paints what is in the layers, within a region. `show` is given pixels next to each other, counted from the first row of the layers,
    /// the part of each that is covered, and colours: red, green and blue.
    pub fn paint(
        &mut self,
        layers: &Layers,
        look: &Look<'_>,
        region: Region,
        mut show: impl FnMut(Range<usize>, f32, [&[f32]; 3]),
    ) {
        let [x0, mut y, x1, y1] = layers.part(region);
        while y < y1 {
            let next = (y / BAND * BAND + BAND).min(y1);
            self.gather(layers, [x0, y, x1, next]);
            let mut begin = 0;
            for k in 0..self.present.len() {
                let number = self.present[k];
                // After sorting, counts are where the runs end.
                let end = std::mem::take(&mut self.counts[number as usize]);
                let geom = &look.scene.geoms[number as usize];
                let posed = Posed::new(geom, look.view);
                let mut runs = self.sorted[begin..end].iter().copied();
                let mut rest = runs.next();
                while rest.is_some() {
                    rest = fill(&mut self.lit, rest, &mut runs);
                    self.batch.shade(&mut self.lattices, &self.lit, (number, geom, posed.as_ref()), layers, look);
                    self.batch.show(&self.lit, layers, &mut show);
                }
                begin = end;
            }
            y = next;
        }
    }

    /// Adds a run, to the last one if it goes on there.
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
        let known = &mut self.counts[run.geom as usize];
        if *known == 0 {
            self.present.push(run.geom);
        }
        *known += 1;
    }

    /// Gathers the runs of a region, those of a geom together.
    #[allow(clippy::cast_possible_truncation)]
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
            let place = &mut self.counts[run.geom as usize];
            self.sorted[*place] = *run;
            *place += 1;
        }
    }

    /// The same of a row with so many samples a pixel.
    #[allow(clippy::cast_possible_truncation)]
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
            // A pixel shows a geom once, whatever triangles of it.
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

/// Takes the next runs, up to [`MANY`] pixels; returns what is left of the last one.
#[allow(clippy::cast_possible_truncation)]
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

impl Batch {
    /// The colours of fragments, in `sum`.
    fn shade(
        &mut self,
        lattices: &mut Lattices,
        runs: &[Run],
        (number, geom, posed): (u32, &Geom, Option<&Posed>),
        layers: &Layers,
        look: &Look<'_>,
    ) {
        self.place(runs, layers);
        let n = self.n;
        match posed {
            Some(posed) => self.analytic(geom, posed),
            None => self.triangles(geom, runs, layers, look),
        }
        let rays = look.view.rays();
        self.tint(geom, look, &rays);
        let matter = Matter::new(geom, look.dimmed);
        let lit_at_corners = self.is_coarse(geom, look.view);
        let passes = 1 + look.lamps.shadowed.len();
        let start = if lit_at_corners { lattices.of(number, geom, passes) } else { 0 };
        if lit_at_corners {
            self.cells(geom);
        }
        for pass in 0..passes {
            if lit_at_corners {
                self.light_of_corners(lattices, start, (pass, passes), geom, &matter, look);
            } else {
                self.light(pass, &matter, look);
            }
            if pass == 0 {
                for (sum, light) in self.sum.iter_mut().zip(&self.pass) {
                    sum[..n].copy_from_slice(&light[..n]);
                }
            } else {
                let (lamp, shadow) = (&look.lamps.shadowed[pass - 1], &look.lamps.shadows[pass - 1]);
                let (places, normals) =
                    (self.place.each_ref().map(|l| &l[..n]), self.normal.each_ref().map(|l| &l[..n]));
                let lit = &mut self.lit[..n];
                shadow.reaches(number, lamp, places, normals, lit);
                for (sum, light) in self.sum.iter_mut().zip(&self.pass) {
                    add_lit(&mut sum[..n], &light[..n], lit);
                }
            }
        }
        for (sum, tint) in self.sum.iter_mut().zip(&self.tint) {
            tinted(&mut sum[..n], &tint[..n]);
        }
    }

    /// Where pixels are looked at.
    fn place(&mut self, runs: &[Run], layers: &Layers) {
        self.n = 0;
        for run in runs {
            let [dx, dy] = layers.centres[usize::from(run.samples)];
            let fragments = self.n..self.n + usize::from(run.count);
            for (x, i) in self.x[fragments.clone()].iter_mut().zip(0u16..) {
                *x = f32::from(run.x + i) + dx;
            }
            self.y[fragments.clone()].fill(f32::from(run.y) + dy);
            self.n = fragments.end;
        }
    }

    /// Shows the colours of runs.
    #[allow(clippy::cast_precision_loss)]
    fn show(&self, runs: &[Run], layers: &Layers, show: &mut impl FnMut(Range<usize>, f32, [&[f32]; 3])) {
        let mut begin = 0;
        for run in runs {
            let row = usize::from(run.y) - layers.rows.start;
            let (pixel, count) = (row * layers.width + usize::from(run.x), usize::from(run.count));
            let part = run.samples.count_ones() as f32 / layers.samples as f32;
            show(pixel..pixel + count, part, self.sum.each_ref().map(|lane| &lane[begin..begin + count]));
            begin += count;
        }
    }

    /// Places and directions on a shape.
    fn analytic(&mut self, geom: &Geom, posed: &Posed) {
        let n = self.n;
        self.coordinates.iter_mut().for_each(|lane| lane[..n].fill(0.0));
        let [px, py, pz] = &mut self.local;
        let [nx, ny, nz] = &mut self.normal;
        posed.surface(
            &self.x[..n],
            &self.y[..n],
            &mut self.depth[..n],
            [&mut px[..n], &mut py[..n], &mut pz[..n]],
            [&mut nx[..n], &mut ny[..n], &mut nz[..n]],
        );
        to_world(geom, posed.sizes, n, &mut self.local, &mut self.normal, &mut self.place);
    }

    /// Places and directions on a mesh.
    fn triangles(&mut self, geom: &Geom, runs: &[Run], layers: &Layers, look: &Look<'_>) {
        let Shape::Mesh(mesh) = geom.shape else { return };
        let mesh = &look.assets.meshes[mesh];
        // A covered pixel shows what its first sample does.
        let ids = runs.iter().flat_map(|run| {
            let (x, y, count) = (usize::from(run.x), usize::from(run.y), usize::from(run.count));
            let covered = run.samples.count_ones() as usize == layers.samples;
            let first = layers.span(y, x, x + count).step_by(layers.samples);
            first.map(move |at| if covered { layers.ids[at] } else { run.id })
        });
        for (i, id) in ids.enumerate() {
            let triangle = &layers.triangles[(id & !TRIANGLE) as usize];
            let level = mesh.level(triangle.level as usize);
            let (face, corners) = (level.faces[triangle.face as usize], level.corners[triangle.face as usize]);
            // The middle of the pixel may be outside the triangle: then a place on its rim is taken.
            let (shares, _) = triangle.at(self.x[i], self.y[i]);
            let shares = shares.map(|share| share.clamp(0.0, 1.0));
            let sum = shares[0] + shares[1] + shares[2];
            let shares = shares.map(|share| share / if sum > 0.0 { sum } else { 1.0 });
            let mix = |of: [V3; 3]| -> V3 {
                std::array::from_fn(|k| shares[0] * of[0][k] + shares[1] * of[1][k] + shares[2] * of[2][k])
            };
            let local = mix(face.map(|place| level.places[place as usize]));
            let normal = rotate(&geom.rotation, mix(corners.map(|corner| level.normals[corner as usize])));
            let by = 1.0 / dot(normal, normal).max(1e-20).sqrt();
            let place = add(geom.position, rotate(&geom.rotation, local));
            for k in 0..3 {
                (self.local[k][i], self.place[k][i], self.normal[k][i]) = (local[k], place[k], normal[k] * by);
            }
            for k in 0..2 {
                let of = corners.map(|corner| level.coordinates[corner as usize][k]);
                self.coordinates[k][i] = shares[0] * of[0] + shares[1] * of[1] + shares[2] * of[2];
            }
        }
    }

    /// The colours of the texture.
    fn tint(&mut self, geom: &Geom, look: &Look<'_>, rays: &Rays) {
        let n = self.n;
        let Some((paint, texture)) =
            geom.paint.and_then(|paint| Some((paint, look.assets.textures.get(paint.texture)?)))
        else {
            self.tint.iter_mut().for_each(|lane| lane[..n].fill(1.0));
            return;
        };
        let rays = LocalRays::new(geom, look.view, rays);
        if let Mapping::Flat { scale, offset } = paint.mapping {
            let flat = FlatRays { rays, scale, offset };
            let (places, normals) = (self.local.each_ref().map(|l| &l[..n]), self.normal.each_ref().map(|l| &l[..n]));
            let [s, t] = self.coordinates.each_mut().map(|l| &mut l[..n]);
            flat_coordinates(texture, &flat, &self.x[..n], &self.y[..n], places, normals, s, t, &mut self.dense[..n]);
            self.face[..n].fill(0);
        } else if let Mapping::Cube(by) = paint.mapping {
            let (places, normals) = (self.local.each_ref().map(|l| &l[..n]), self.normal.each_ref().map(|l| &l[..n]));
            let ([s, t], dense) = (self.coordinates.each_mut().map(|l| &mut l[..n]), &mut self.dense[..n]);
            let faces = &mut self.face[..n];
            cube_coordinates(texture, &rays, by, &self.x[..n], &self.y[..n], places, normals, s, t, dense, faces);
        } else {
            self.spots(geom, paint.mapping, texture, &rays);
        }
        let [s, t] = self.coordinates.each_ref().map(|l| &l[..n]);
        let spots = Spots { s, t, dense: &self.dense[..n], faces: &self.face[..n] };
        texture.colours(&spots, &mut self.reader, self.tint.each_mut().map(|l| &mut l[..n]));
    }

    /// Where on its texture a geom shows itself.
    fn spots(&mut self, geom: &Geom, mapping: Mapping, texture: &Texture, rays: &LocalRays) {
        for i in 0..self.n {
            let (place, normal) = (self.local.each_ref().map(|l| l[i]), self.normal.each_ref().map(|l| l[i]));
            self.face[i] = 0;
            let moved = rays.moved(self.x[i], self.y[i], place, normal);
            let (s, t);
            match mapping {
                Mapping::Sides(repeat) => {
                    // The axes that run to the right and up on this side.
                    let [u, v] = side_axes(unrotate(&geom.rotation, normal));
                    let (_, halves) = geom.shape.bounds();
                    let by = [0.5 * repeat[0] / halves[u].max(1e-6), 0.5 * repeat[1] / halves[v].max(1e-6)];
                    let change =
                        [(0, u), (1, v)].map(|(k, axis)| by[k] * moved[0][axis].abs().max(moved[1][axis].abs()));
                    (s, t) = (by[0] * place[u] + 0.5 * repeat[0], 0.5 * repeat[1] - by[1] * place[v]);
                    self.dense[i] = texture.dense(change);
                }
                // A mesh's coordinates are taken as they are: its triangles are small.
                Mapping::Own | Mapping::Flat { .. } | Mapping::Cube(_) => {
                    [s, t] = self.coordinates.each_ref().map(|lane| lane[i]);
                    self.dense[i] = 0.0;
                }
            }
            (self.coordinates[0][i], self.coordinates[1][i]) = (s, t);
        }
    }

    /// Light at every fragment.
    fn light(&mut self, pass: usize, matter: &Matter, look: &Look<'_>) {
        let n = self.n;
        let dark = if pass == 0 { matter.dark(look.scene) } else { [0.0; 3] };
        for (lane, dark) in self.pass.iter_mut().zip(dark) {
            lane[..n].fill(dark);
        }
        let (places, normals) = (self.place.each_ref().map(|l| &l[..n]), self.normal.each_ref().map(|l| &l[..n]));
        match pass {
            0 => {
                for lamp in look.lamps.plain {
                    let sums = self.pass.each_mut().map(|l| &mut l[..n]);
                    lamp.add(matter, look.view.position, places, normals, sums);
                }
            }
            pass => {
                let sums = self.pass.each_mut().map(|l| &mut l[..n]);
                look.lamps.shadowed[pass - 1].add(matter, look.view.position, places, normals, sums);
            }
        }
        for lane in &mut self.pass {
            lane[..n].iter_mut().for_each(|x| *x = x.min(1.0));
        }
    }

    /// Whether a geom is lit at the corners of a grid whose cells are large enough for that to be seen.
    fn is_coarse(&self, geom: &Geom, view: &View) -> bool {
        let cell = match geom.shape {
            Shape::Plane(x, y) => x.step.max(y.step).max(x.pad).max(y.pad),
            Shape::Box(halves) => 0.5 * halves.into_iter().fold(0.0, f32::max),
            _ => return false,
        };
        let depth = |i: usize| dot(sub(self.place.each_ref().map(|l| l[i]), view.position), view.forward);
        cell * view.pixels_at(depth(0).min(depth(self.n - 1))) > COARSE
    }

    /// The cell a fragment is in.
    fn grid(&self, geom: &Geom, i: usize) -> Grid {
        Grid::at(geom, self.local.each_ref().map(|l| l[i]), self.normal.each_ref().map(|l| l[i]))
    }

    /// Finds the cell of every fragment.
    fn cells(&mut self, geom: &Geom) {
        if let Shape::Plane(x, y) = geom.shape {
            let n = self.n;
            let [u, v] = &mut self.within;
            let (u, v) = (&mut u[..n], &mut v[..n]);
            return plane_cells(x, y, &self.local[0][..n], &self.local[1][..n], &mut self.cell[..n], u, v);
        }
        for i in 0..self.n {
            let grid = self.grid(geom, i);
            self.cell[i] = u32::try_from(grid.first).unwrap_or(0);
            [self.within[0][i], self.within[1][i]] = grid.within;
        }
    }

    /// Light at the corners of the grid around every fragment, interpolated.
    fn light_of_corners(
        &mut self,
        lattices: &mut Lattices,
        start: usize,
        (pass, passes): (usize, usize),
        geom: &Geom,
        matter: &Matter,
        look: &Look<'_>,
    ) {
        let row = match geom.shape {
            Shape::Plane(x, _) => x.cells + 1,
            _ => QUADS + 1,
        };
        let mut begin = 0;
        while begin < self.n {
            // Neighbours are mostly in the same cell.
            let cell = self.cell[begin];
            let same = self.cell[begin..self.n].iter().take_while(|other| **other == cell).count();
            let mut corners = [[0.0; 3]; 4];
            for (colour, step) in corners.iter_mut().zip([0, 1, row, row + 1]) {
                let corner = start + (cell as usize + step) * passes + pass;
                if !lattices.known[corner] {
                    lattices.known[corner] = true;
                    let corner_there = self.grid(geom, begin).corner(geom, step);
                    lattices.colours[corner] = corner_light(corner_there, pass, matter, look);
                }
                *colour = lattices.colours[corner];
            }
            let run = [begin, begin + same];
            dispatch_avx2(Between { corners, run, within: &self.within, colours: &mut self.pass });
            begin += same;
        }
    }
}

/// The axes of a box's side that look to the right and up on its texture.
fn side_axes(normal: V3) -> [usize; 2] {
    if normal[0].abs() > 0.5 {
        [1, 2]
    } else if normal[1].abs() > 0.5 {
        [0, 2]
    } else {
        [0, 1]
    }
}

/// The light of a pass at a corner of a grid.
fn corner_light((place, normal): (V3, V3), pass: usize, matter: &Matter, look: &Look<'_>) -> V3 {
    let light =
        match pass {
            0 => look.lamps.plain.iter().fold(matter.dark(look.scene), |sum, lamp| {
                add(sum, lamp.at(matter, look.view.position, place, normal))
            }),
            pass => look.lamps.shadowed[pass - 1].at(matter, look.view.position, place, normal),
        };
    light.map(|x| x.min(1.0))
}

/// The rays of a view as a geom sees them.
#[derive(Clone, Copy)]
struct LocalRays {
    rotation: [f32; 9],
    eye: V3,
    ahead: V3,
    direction: V3,
    origins: [V3; 2],
    directions: [V3; 2],
}

/// The same, and how a flat texture lies on the geom.
struct FlatRays {
    rays: LocalRays,
    scale: [f32; 2],
    offset: [f32; 2],
}

impl LocalRays {
    fn new(geom: &Geom, view: &View, rays: &Rays) -> Self {
        let local = |a: V3| unrotate(&geom.rotation, a);
        Self {
            rotation: geom.rotation,
            eye: local(sub(view.position, geom.position)),
            ahead: local(view.forward),
            direction: local(rays.direction),
            origins: rays.origins.map(local),
            directions: rays.directions.map(local),
        }
    }

    /// How far a place moves on its surface, which looks so in the world, from this pixel to the next, to the right and down.
    #[inline(always)]
    fn moved(&self, x: f32, y: f32, place: V3, normal: V3) -> [V3; 2] {
        let normal = unrotate(&self.rotation, normal);
        let depth = dot(sub(place, self.eye), self.ahead);
        let direction = add(self.direction, add(scale(self.directions[0], x), scale(self.directions[1], y)));
        let facing = dot(normal, direction);
        let facing = 1.0 / if facing.abs() > 1e-6 { facing } else { 1e-6 };
        [self.slid(0, depth, direction, normal, facing), self.slid(1, depth, direction, normal, facing)]
    }

    /// The same to one side.
    #[inline(always)]
    fn slid(&self, side: usize, depth: f32, direction: V3, normal: V3, facing: f32) -> V3 {
        let free = add(self.origins[side], scale(self.directions[side], depth));
        sub(free, scale(direction, dot(normal, free) * facing))
    }
}

/// The cell of a grid that a place is in.
struct Grid {
    axes: [Axis; 2],
    /// The cell, along both axes.
    cell: [f32; 2],
    /// Its first corner.
    first: usize,
    /// Corners of a row.
    row: usize,
    /// How far inside the cell.
    within: [f32; 2],
    /// Of a box: the axis across its side, and where on it that is.
    side: (usize, f32),
}

impl Grid {
    /// The cell of a place on a plane or a box, in local coordinates, where the surface (in the world) looks so.
    #[inline]
    fn at(geom: &Geom, place: V3, normal: V3) -> Self {
        let (axes, side, at, begin) = match geom.shape {
            Shape::Box(halves) => {
                let normal = unrotate(&geom.rotation, normal);
                let side = if normal[0].abs() > 0.5 {
                    0
                } else if normal[1].abs() > 0.5 {
                    1
                } else {
                    2
                };
                let (u, v) = ((side + 1) % 3, (side + 2) % 3);
                let up = normal[side] > 0.0;
                let begin = (2 * side + usize::from(up)) * (QUADS + 1) * (QUADS + 1);
                let axes = [Axis::even(halves[u], QUADS), Axis::even(halves[v], QUADS)];
                (axes, (side, if up { halves[side] } else { -halves[side] }), [place[u], place[v]], begin)
            }
            Shape::Plane(x, y) => ([x, y], (2, 0.0), [place[0], place[1]], 0),
            _ => ([Axis::even(1.0, 1); 2], (2, 0.0), [0.0; 2], 0),
        };
        let ((i, s), (j, t)) = (axes[0].cell(at[0]), axes[1].cell(at[1]));
        let row = axes[0].cells + 1;
        Self {
            axes,
            cell: [i, j],
            first: begin + nearest(j) as usize * row + nearest(i) as usize,
            row,
            within: [s, t],
            side,
        }
    }

    /// A corner of the cell in the world, and how the surface looks there.
    fn corner(&self, geom: &Geom, step: usize) -> (V3, V3) {
        let one = |yes: bool| if yes { 1.0 } else { 0.0 };
        let (i, j) = (self.cell[0] + one(step % self.row == 1), self.cell[1] + one(step >= self.row));
        let (side, at) = self.side;
        let (mut place, mut normal) = ([0.0; 3], [0.0; 3]);
        place[side] = at;
        place[(side + 1) % 3] = self.axes[0].line(i);
        place[(side + 2) % 3] = self.axes[1].line(j);
        normal[side] = if at < 0.0 { -1.0 } else { 1.0 };
        (add(geom.position, rotate(&geom.rotation, place)), rotate(&geom.rotation, normal))
    }
}

impl Lattices {
    /// Where the corners of a geom begin.
    fn of(&mut self, number: u32, geom: &Geom, passes: usize) -> usize {
        let start = &mut self.starts[number as usize];
        if *start == u32::MAX {
            let corners = match geom.shape {
                Shape::Plane(x, y) => (x.cells + 1) * (y.cells + 1),
                _ => 6 * (QUADS + 1) * (QUADS + 1),
            };
            *start = u32::try_from(self.colours.len()).unwrap_or(0);
            self.colours.resize(self.colours.len() + corners * passes, [0.0; 3]);
            self.known.resize(self.colours.len(), false);
        }
        *start as usize
    }
}

/// Colours between those at four corners, for fragments of a run; what follows may be overwritten.
struct Between<'a> {
    corners: [V3; 4],
    run: [usize; 2],
    within: &'a [Lane; 2],
    colours: &'a mut [Lane; 3],
}

impl Kernel for Between<'_> {
    type Output = ();

    #[inline(always)]
    fn run<L: swm_simd::Level>(self) {
        let simd = L::f32x8();
        let Self { corners: [a, b, c, d], run: [begin, end], within: [u, v], colours } = self;
        for from in (begin..end).step_by(LANES) {
            let (Some(u), Some(v)) = (u[from..].first_chunk(), v[from..].first_chunk()) else { return };
            let (u, v) = (simd.load(u), simd.load(v));
            for (k, lane) in colours.iter_mut().enumerate() {
                let between = |a: f32, b: f32| simd.add(simd.splat(a), simd.mul(u, simd.splat(b - a)));
                let (low, high) = (between(a[k], b[k]), between(c[k], d[k]));
                let colour = simd.add(low, simd.mul(v, simd.sub(high, low)));
                if let Some(to) = lane[from..].first_chunk_mut() {
                    simd.store(colour, to);
                }
            }
        }
    }
}

vectorize! {
    /// Multiplies light with a texture; more than white is white.
    fn tinted(sums: &mut [f32], tints: &[f32]) {
        for (sum, tint) in sums.iter_mut().zip(tints) {
            *sum = (*sum * tint).min(1.0);
        }
    }

    /// Adds light where there is some.
    fn add_lit(sums: &mut [f32], light: &[f32], lit: &[f32]) {
        for ((sum, light), lit) in sums.iter_mut().zip(light).zip(lit) {
            *sum += light * lit;
        }
    }

    /// The cells of places on a plane, and how far inside they are.
    #[allow(clippy::cast_possible_truncation)]
    fn plane_cells(
        x: Axis, y: Axis, px: &[f32], py: &[f32], cells: &mut [u32], u: &mut [f32], v: &mut [f32],
    ) {
        let n = px.len();
        let (py, cells, u, v) = (&py[..n], &mut cells[..n], &mut u[..n], &mut v[..n]);
        let row = x.cells as u32 + 1;
        for i in 0..n {
            let ((column, s), (line, t)) = (x.cell(px[i]), y.cell(py[i]));
            cells[i] = nearest(line) * row + nearest(column);
            (u[i], v[i]) = (s, t);
        }
    }

    /// Coordinates on a flat texture, and how many texels a pixel covers, for surfaces of one geom.
    fn flat_coordinates(
        texture: &Texture, flat: &FlatRays, x: &[f32], y: &[f32], places: [&[f32]; 3], normals: [&[f32]; 3],
        s: &mut [f32], t: &mut [f32], dense: &mut [f32],
    ) {
        let n = x.len();
        let ([px, py, pz], [nx, ny, nz]) = (places.map(|lane| &lane[..n]), normals.map(|lane| &lane[..n]));
        let (y, s, t, dense) = (&y[..n], &mut s[..n], &mut t[..n], &mut dense[..n]);
        for i in 0..n {
            let place = [px[i], py[i], pz[i]];
            let [right, down] = flat.rays.moved(x[i], y[i], place, [nx[i], ny[i], nz[i]]);
            s[i] = flat.scale[0] * place[0] + flat.offset[0];
            t[i] = flat.scale[1] * place[1] + flat.offset[1];
            let change = |k: usize| flat.scale[k].abs() * right[k].abs().max(down[k].abs());
            dense[i] = texture.dense([change(0), change(1)]);
        }
    }

    /// Faces of a cube texture, coordinates there, and how many texels a pixel covers.
    fn cube_coordinates(
        texture: &Texture, rays: &LocalRays, by: V3, x: &[f32], y: &[f32], places: [&[f32]; 3], normals: [&[f32]; 3],
        s: &mut [f32], t: &mut [f32], dense: &mut [f32], faces: &mut [u32],
    ) {
        let n = x.len();
        let ([px, py, pz], [nx, ny, nz]) = (places.map(|lane| &lane[..n]), normals.map(|lane| &lane[..n]));
        let (y, s, t, dense, faces) = (&y[..n], &mut s[..n], &mut t[..n], &mut dense[..n], &mut faces[..n]);
        let multiply = |a: V3| [a[0] * by[0], a[1] * by[1], a[2] * by[2]];
        for i in 0..n {
            let place = [px[i], py[i], pz[i]];
            let [right, down] = rays.moved(x[i], y[i], place, [nx[i], ny[i], nz[i]]);
            let (face, spot, texels) = texture.face_in(multiply(place), multiply(right), multiply(down));
            (faces[i], s[i], t[i], dense[i]) = (face, spot[0], spot[1], texels);
        }
    }

    /// Unit coordinates to local and world ones, and directions of surfaces to unit vectors in the world.
    fn to_world(
        geom: &Geom, sizes: V3, n: usize, local: &mut [Lane; 3], normal: &mut [Lane; 3], place: &mut [Lane; 3],
    ) {
        let [lx, ly, lz] = local;
        let [nx, ny, nz] = normal;
        let [px, py, pz] = place;
        let by = sizes.map(|size| 1.0 / size);
        for i in 0..n.min(MANY) {
            let at = [lx[i] * sizes[0], ly[i] * sizes[1], lz[i] * sizes[2]];
            (lx[i], ly[i], lz[i]) = (at[0], at[1], at[2]);
            let [x, y, z] = add(geom.position, rotate(&geom.rotation, at));
            (px[i], py[i], pz[i]) = (x, y, z);
            let [x, y, z] = rotate(&geom.rotation, [nx[i] * by[0], ny[i] * by[1], nz[i] * by[2]]);
            let length = (x * x + y * y + z * z).max(1e-30).sqrt();
            (nx[i], ny[i], nz[i]) = (x / length, y / length, z / length);
        }
    }
}
