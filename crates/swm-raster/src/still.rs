//! [`Still`]: what a picture shares with those before it, kept: what is nearest at every sample once its first geoms are drawn.
//!
//! Scenes begin with what stands still (floors, walls, what they are made of comes in the order of their bodies), and many are seen
//! from a place that does not move, by cameras and by lights. Layers depend on nothing but the view, how far one sees, and the geoms
//! drawn so far, in their order. Where all these are the same, bit for bit, drawing goes on from a copy, and gives the same bytes:
//! nothing is said about what is drawn later, which may be nearer, as near, or farther.

use crate::layers::{Layers, Record};
use crate::mesh::Mesh;
use crate::scene::{Assets, Geom, Shape};
use crate::view::View;
use std::sync::Arc;

/// Views that are kept; that unused for longest makes room. A thread may draw worlds in turn, each seen from elsewhere.
const VIEWS: usize = 4;

/// Pictures in a row that have more in common than was kept, until that is kept instead.
const PATIENCE: usize = 4;

/// What decides what a view sees of geoms, bit for bit.
type Key = [u32; 26];

/// What decides what a geom leaves in layers, bit for bit: colours do not.
type Pose = [u32; 17];

/// What is kept, of some views.
#[derive(Default)]
pub(crate) struct Still {
    views: Vec<Kept>,
    /// Pictures drawn.
    clock: u64,
}

/// What is kept of a view.
#[derive(Default)]
struct Kept {
    key: Key,
    meshes: Vec<Arc<Mesh>>,
    /// The geoms drawn last.
    poses: Vec<Pose>,
    /// How many of the first ones are in the record.
    count: usize,
    record: Record,
    /// Pictures in a row that had more than that in common with those before, and the least they had.
    waiting: usize,
    common: usize,
    /// When it was last used.
    used: u64,
}

/// What geoms are drawn in.
#[derive(Clone, Copy)]
pub(crate) struct Setting<'a> {
    pub assets: &'a Assets,
    pub view: &'a View,
    /// How far one sees.
    pub far: f32,
    /// Whether shadows are cast, not pictures drawn.
    pub casting: bool,
}

impl Still {
    /// Draws geoms, with their numbers, on layers that were started: into what is left of them from earlier pictures, or from nothing.
    pub fn draw<'a>(
        &mut self,
        layers: &mut Layers,
        setting: Setting<'_>,
        geoms: impl Iterator<Item = (u32, &'a Geom)> + Clone,
    ) {
        self.clock += 1;
        let kept = self.kept(key(layers, setting), &setting.assets.meshes);
        let same = kept.note(geoms.clone());
        let keep = kept.keeps(same);
        let known = kept.count == keep;
        if known && keep > 0 {
            layers.recall(&kept.record);
        } else {
            layers.clear(setting.far);
        }
        let draw = |layers: &mut Layers, (number, geom): (u32, &Geom)| {
            layers.draw(number, geom, (setting.assets, setting.view), None, setting.casting);
        };
        let (first, rest) = (geoms.clone().take(keep), geoms.skip(keep));
        if !known {
            first.for_each(|geom| draw(layers, geom));
            kept.count = keep;
            if keep > 0 {
                layers.record(&mut kept.record);
            }
        }
        rest.for_each(|geom| draw(layers, geom));
    }

    /// What is kept of a view, or room for it.
    fn kept(&mut self, key: Key, meshes: &[Arc<Mesh>]) -> &mut Kept {
        let alike = |kept: &Kept| {
            kept.key == key
                && kept.meshes.len() == meshes.len()
                && kept.meshes.iter().zip(meshes).all(|(a, b)| Arc::ptr_eq(a, b))
        };
        let place = match self.views.iter().position(alike) {
            Some(place) => place,
            None => {
                let place = match self.views.len() {
                    VIEWS => (0..VIEWS).min_by_key(|&place| self.views[place].used).unwrap_or(0),
                    room => {
                        self.views.push(Kept::default());
                        room
                    }
                };
                let kept = &mut self.views[place];
                kept.key = key;
                kept.meshes.clear();
                kept.meshes.extend_from_slice(meshes);
                kept.poses.clear();
                (kept.count, kept.waiting) = (0, 0);
                place
            }
        };
        let kept = &mut self.views[place];
        kept.used = self.clock;
        kept
    }
}

impl Kept {
    /// Takes note of the geoms of a picture; returns how many of the first ones are as they were in the last one.
    fn note<'a>(&mut self, geoms: impl Iterator<Item = (u32, &'a Geom)>) -> usize {
        let (mut same, mut count) = (None, 0);
        for (place, (number, geom)) in geoms.enumerate() {
            let pose = pose(number, geom);
            match self.poses.get_mut(place) {
                Some(known) if *known == pose => {}
                Some(known) => {
                    *known = pose;
                    same = same.or(Some(place));
                }
                None => {
                    self.poses.push(pose);
                    same = same.or(Some(place));
                }
            }
            count += 1;
        }
        self.poses.truncate(count);
        same.unwrap_or(count)
    }

    /// How many of the first geoms are to be kept, where so many are as they were: at once fewer than now, and more after a while.
    fn keeps(&mut self, same: usize) -> usize {
        if same <= self.count || self.count == 0 {
            self.waiting = 0;
            return same;
        }
        self.common = if self.waiting == 0 { same } else { self.common.min(same) };
        self.waiting += 1;
        if self.waiting < PATIENCE {
            return self.count;
        }
        self.waiting = 0;
        self.common
    }
}

/// The bits of numbers, one after the other.
fn bits<const N: usize>(numbers: impl IntoIterator<Item = u32>) -> [u32; N] {
    let mut numbers = numbers.into_iter();
    std::array::from_fn(|_| numbers.next().unwrap_or_default())
}

#[allow(clippy::cast_possible_truncation, reason = "pictures have less than 2^32 rows, and samples a pixel")]
fn key(layers: &Layers, Setting { view, far, casting, .. }: Setting<'_>) -> Key {
    let View { position, right, up, forward, left, top, dense, near, orthographic, width, height, mirrored } = *view;
    let [x, y] = dense;
    let [dx, dy] = layers.pattern[0];
    let numbers = [left, top, x, y, near, far, dx, dy];
    let numbers = [position, right, up, forward].into_iter().flatten().chain(numbers).map(f32::to_bits);
    let sizes = [width, height, layers.rows.start, layers.rows.end, layers.samples].map(|size| size as u32);
    let flags = [orthographic, mirrored, casting].into_iter().rev().fold(0, |flags, flag| flags << 1 | u32::from(flag));
    bits(numbers.chain(sizes).chain([flags]))
}

fn pose(number: u32, geom: &Geom) -> Pose {
    let (kind, sizes) = match geom.shape {
        // Of a plane, only how it is lit depends on its grid.
        Shape::Plane(x, y) => (0, [x.half, y.half, 0.0]),
        Shape::Ellipsoid(radii) => (1, radii),
        Shape::Capsule(radius, half) => (2, [radius, half, 0.0]),
        Shape::Cylinder(radius, half) => (3, [radius, half, 0.0]),
        Shape::Box(halves) => (4, halves),
        Shape::Mesh(mesh) => (u32::try_from(mesh).unwrap_or(u32::MAX).saturating_add(5), [0.0; 3]),
    };
    let numbers = sizes.into_iter().chain(geom.position).chain(geom.rotation).map(f32::to_bits);
    bits([number, kind].into_iter().chain(numbers))
}
