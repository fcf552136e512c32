//! [`Appearance`]: the key of the meshes and textures that renderers cache for a model.

use mujoco_rs::wrappers::MjModel;
use std::collections::BTreeMap;
use std::hash::{DefaultHasher, Hasher};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError, Weak};

/// Identifies the meshes and textures of a model, so that renderers can cache them between frames.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Appearance {
    /// The number of the compiled model that this model is a copy of. All copies have the same meshes and texture
    /// sizes.
    pub group: u64,
    /// A hash of the content of each texture; 0 where the content is that of the compiled model.
    pub textures: Arc<[u64]>,
}

impl Appearance {
    /// The appearance of an unedited copy of `original`.
    pub fn of_original(original: &Arc<MjModel>) -> Self {
        Self { group: group_of(original), textures: vec![0; original.tex_adr().len()].into() }
    }

    /// Recomputes the texture hashes of a model after an edit of its texture data.
    pub fn update_textures(&mut self, model: &MjModel, original: &MjModel) {
        let hashes = (0..model.tex_adr().len()).map(|i| {
            let pixels = texture_bytes(model, i);
            if pixels == texture_bytes(original, i) {
                return 0;
            }
            let mut hasher = DefaultHasher::new();
            hasher.write(pixels);
            hasher.finish().max(1)
        });
        self.textures = hashes.collect();
    }
}

/// The group number of a compiled model, unique while the process runs.
fn group_of(original: &Arc<MjModel>) -> u64 {
    /// The compiled models by group number. While a weak pointer exists, no other model is allocated at its address.
    static GROUPS: Mutex<BTreeMap<u64, Weak<MjModel>>> = Mutex::new(BTreeMap::new());
    static NEXT: AtomicU64 = AtomicU64::new(0);
    let mut groups = GROUPS.lock().unwrap_or_else(PoisonError::into_inner);
    groups.retain(|_, model| model.strong_count() > 0);
    let known = groups.iter().find(|(_, model)| model.as_ptr() == Arc::as_ptr(original)).map(|(group, _)| *group);
    known.unwrap_or_else(|| {
        let group = NEXT.fetch_add(1, Ordering::Relaxed);
        groups.insert(group, Arc::downgrade(original));
        group
    })
}

/// The pixels of a texture.
fn texture_bytes(model: &MjModel, texture: usize) -> &[u8] {
    let begin = usize::try_from(model.tex_adr()[texture]).unwrap_or(0);
    let next = model.tex_adr().get(texture + 1);
    let end = next.map_or(model.tex_data().len(), |&next| usize::try_from(next).unwrap_or(0));
    &model.tex_data()[begin..end]
}
