//! [`GeometryCache`]: caches the depth buffer after the first, static geoms of a scene, so that later frames start
//! from a copy.
//!
//! Scenes list static geometry first (floors and walls, in the order of their bodies), and cameras and lights often do
//! not move. The depth buffer depends only on the view, the far plane and the sequence of geoms drawn so far. If these
//! inputs equal, bit for bit, the inputs of the copy, drawing continues from the copy. The frame has the same bytes as
//! without the cache.

use crate::layers::{Layers, LayersSnapshot};
use crate::mesh::Mesh;
use crate::scene::{Assets, Geom, Shape};
use crate::view::View;
use std::sync::Arc;

/// Number of cached views; a new view replaces the least recently used view. A thread may draw several environments in
/// turn, each with its own view.
const VIEWS: usize = 4;

/// The number of consecutive frames that must share more geoms than are cached before the cache grows.
const FRAMES_BEFORE_GROWTH: usize = 4;

/// All inputs of the depth buffer except the geoms, as bits.
type Key = [u32; 26];

/// The properties of a geom that affect the depth buffer, as bits: shape and pose, but not colours.
type Pose = [u32; 17];

/// The caches of up to [`VIEWS`] views.
#[derive(Default)]
pub(crate) struct GeometryCache {
    views: Vec<CachedView>,
    /// Number of frames drawn.
    clock: u64,
}

/// The cache of a view.
#[derive(Default)]
struct CachedView {
    key: Key,
    meshes: Vec<Arc<Mesh>>,
    /// The geoms of the last frame.
    poses: Vec<Pose>,
    /// The number of leading geoms that are in the snapshot.
    count: usize,
    snapshot: LayersSnapshot,
    /// The number of consecutive frames that shared more leading geoms with the previous frame than are cached.
    waiting: usize,
    /// The smallest number of leading geoms that these frames shared.
    common: usize,
    /// The number of the last frame that used this cache.
    used: u64,
}

/// The inputs of drawing that are the same for all geoms.
#[derive(Clone, Copy)]
pub(crate) struct DrawSettings<'a> {
    pub assets: &'a Assets,
    pub view: &'a View,
    /// The far plane.
    pub far: f32,
    /// Whether the drawing is a shadow map instead of a frame.
    pub casting: bool,
}

impl GeometryCache {
    /// Draws geoms with their indices on started layers, starting from a cached copy if there is one.
    pub fn draw<'a>(
        &mut self,
        layers: &mut Layers,
        settings: DrawSettings<'_>,
        geoms: impl Iterator<Item = (u32, &'a Geom)> + Clone,
    ) {
        self.clock += 1;
        let cached = self.cached(key(layers, settings), &settings.assets.meshes);
        let same = cached.update_poses(geoms.clone());
        let keep = cached.cacheable(same);
        let is_cached = cached.count == keep;
        if is_cached && keep > 0 {
            layers.restore(&cached.snapshot);
        } else {
            layers.clear(settings.far);
        }
        let draw = |layers: &mut Layers, (index, geom): (u32, &Geom)| {
            layers.draw(index, geom, (settings.assets, settings.view), None, settings.casting);
        };
        let (first, rest) = (geoms.clone().take(keep), geoms.skip(keep));
        if !is_cached {
            first.for_each(|geom| draw(layers, geom));
            cached.count = keep;
            if keep > 0 {
                layers.save(&mut cached.snapshot);
            }
        }
        rest.for_each(|geom| draw(layers, geom));
    }

    /// Returns the cache of a view, which is empty for a new view.
    fn cached(&mut self, key: Key, meshes: &[Arc<Mesh>]) -> &mut CachedView {
        let matches = |cached: &CachedView| {
            cached.key == key
                && cached.meshes.len() == meshes.len()
                && cached.meshes.iter().zip(meshes).all(|(a, b)| Arc::ptr_eq(a, b))
        };
        let slot = match self.views.iter().position(matches) {
            Some(slot) => slot,
            None => {
                let slot = match self.views.len() {
                    VIEWS => (0..VIEWS).min_by_key(|&slot| self.views[slot].used).unwrap_or(0),
                    count => {
                        self.views.push(CachedView::default());
                        count
                    }
                };
                let cached = &mut self.views[slot];
                cached.key = key;
                cached.meshes.clear();
                cached.meshes.extend_from_slice(meshes);
                cached.poses.clear();
                (cached.count, cached.waiting) = (0, 0);
                slot
            }
        };
        let cached = &mut self.views[slot];
        cached.used = self.clock;
        cached
    }
}

impl CachedView {
    /// Stores the poses of a frame's geoms. Returns the number of leading geoms that equal those of the last frame.
    fn update_poses<'a>(&mut self, geoms: impl Iterator<Item = (u32, &'a Geom)>) -> usize {
        let (mut same, mut count) = (None, 0);
        for (slot, (index, geom)) in geoms.enumerate() {
            let pose = pose(index, geom);
            match self.poses.get_mut(slot) {
                Some(known) if *known == pose => {}
                Some(known) => {
                    *known = pose;
                    same = same.or(Some(slot));
                }
                None => {
                    self.poses.push(pose);
                    same = same.or(Some(slot));
                }
            }
            count += 1;
        }
        self.poses.truncate(count);
        same.unwrap_or(count)
    }

    /// Returns the number of leading geoms to cache, given that `same` leading geoms did not change. The cache shrinks
    /// at once and grows only after [`FRAMES_BEFORE_GROWTH`] frames.
    fn cacheable(&mut self, same: usize) -> usize {
        if same <= self.count || self.count == 0 {
            self.waiting = 0;
            return same;
        }
        self.common = if self.waiting == 0 { same } else { self.common.min(same) };
        self.waiting += 1;
        if self.waiting < FRAMES_BEFORE_GROWTH {
            return self.count;
        }
        self.waiting = 0;
        self.common
    }
}

/// Collects the first `N` words into an array.
fn bits<const N: usize>(values: impl IntoIterator<Item = u32>) -> [u32; N] {
    let mut values = values.into_iter();
    std::array::from_fn(|_| values.next().unwrap_or_default())
}

fn key(layers: &Layers, DrawSettings { view, far, casting, .. }: DrawSettings<'_>) -> Key {
    let View { position, right, up, forward, left, top, pixels_per_unit, near, orthographic, width, height, mirrored } =
        *view;
    let [x, y] = pixels_per_unit;
    let [dx, dy] = layers.pattern[0];
    let values = [left, top, x, y, near, far, dx, dy];
    let values = [position, right, up, forward].into_iter().flatten().chain(values).map(f32::to_bits);
    let sizes = [width, height, layers.rows.start, layers.rows.end, layers.samples].map(|size| size as u32);
    let flags = [orthographic, mirrored, casting].into_iter().rev().fold(0, |flags, flag| flags << 1 | u32::from(flag));
    bits(values.chain(sizes).chain([flags]))
}

fn pose(index: u32, geom: &Geom) -> Pose {
    let (kind, sizes) = match geom.shape {
        // The grid of a plane affects only its lighting.
        Shape::Plane(x, y) => (0, [x.half, y.half, 0.0]),
        Shape::Ellipsoid(radii) => (1, radii),
        Shape::Capsule(radius, half) => (2, [radius, half, 0.0]),
        Shape::Cylinder(radius, half) => (3, [radius, half, 0.0]),
        Shape::Box(halves) => (4, halves),
        Shape::Mesh(mesh) => (u32::try_from(mesh).unwrap_or(u32::MAX).saturating_add(5), [0.0; 3]),
    };
    let values = sizes.into_iter().chain(geom.position).chain(geom.rotation).map(f32::to_bits);
    bits([index, kind].into_iter().chain(values))
}
