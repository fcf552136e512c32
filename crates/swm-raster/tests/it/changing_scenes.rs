//! Frames of changing scenes equal frames drawn by a new canvas: caches do not affect the result.

use crate::scenes::{CAMERA, assets, drawn, geom, scene};
use proptest::prelude::*;
use swm_raster::{Camera, Canvas, Geom, IDENTITY, Scene, Shape};

/// A change between two frames.
#[derive(Clone, Debug)]
enum Change {
    Nothing,
    /// Replaces a geom.
    Geom(usize, Geom),
    /// Replaces the pose of a geom.
    Pose(usize, Geom),
    /// Replaces the appearance of a geom.
    Appearance(usize, Geom),
    /// Changes one value of a geom's pose or shape.
    GeomValue(usize, usize, f32),
    /// Changes one value of the camera.
    CameraValue(usize, f32),
    /// Adds a geom.
    Add(Geom),
    /// Removes a geom.
    Remove(usize),
    /// Takes the lights, the sky and the settings of shadows and reflections from another scene.
    Lights(Scene),
    /// Takes the camera from another scene.
    Camera(Scene),
}

fn change() -> impl Strategy<Value = Change> {
    let index = || 0..12usize;
    prop_oneof![
        4 => Just(Change::Nothing),
        1 => (index(), geom()).prop_map(|(index, geom)| Change::Geom(index, geom)),
        4 => (index(), geom()).prop_map(|(index, geom)| Change::Pose(index, geom)),
        1 => (index(), geom()).prop_map(|(index, geom)| Change::Appearance(index, geom)),
        4 => (index(), prop_oneof![0..3usize, 0..15usize], -1.0..1.0f32).prop_map(|(index, value, by)| Change::GeomValue(index, value, by)),
        2 => (0..16usize, -0.1..0.1f32).prop_map(|(value, by)| Change::CameraValue(value, by)),
        1 => geom().prop_map(Change::Add),
        1 => index().prop_map(Change::Remove),
        1 => scene().prop_map(Change::Lights),
        1 => scene().prop_map(Change::Camera),
    ]
}

impl Change {
    fn make(self, scene: &mut Scene) {
        let count = scene.geoms.len();
        match self {
            Self::Geom(index, geom) if index < count => scene.geoms[index] = geom,
            Self::Pose(index, geom) if index < count => {
                (scene.geoms[index].position, scene.geoms[index].rotation) = (geom.position, geom.rotation);
            }
            Self::Appearance(index, geom) if index < count => {
                scene.geoms[index] = Geom {
                    shape: scene.geoms[index].shape,
                    position: scene.geoms[index].position,
                    rotation: scene.geoms[index].rotation,
                    ..geom
                }
            }
            Self::GeomValue(index, value, by) if index < count => {
                let geom = &mut scene.geoms[index];
                let value = match (value, &mut geom.shape) {
                    (0..=2, _) => &mut geom.position[value],
                    (3..=11, _) => &mut geom.rotation[value - 3],
                    (12, Shape::Plane(x, _)) => &mut x.half,
                    (_, Shape::Plane(_, y)) => &mut y.half,
                    (_, Shape::Ellipsoid(sizes) | Shape::Box(sizes)) => &mut sizes[value - 12],
                    (13.., Shape::Capsule(_, half) | Shape::Cylinder(_, half)) => half,
                    (_, Shape::Capsule(radius, _) | Shape::Cylinder(radius, _)) => radius,
                    (_, Shape::Mesh(mesh)) => return *mesh = value - 12,
                };
                *value += by;
            }
            Self::CameraValue(value, by) => {
                let Camera { position, forward, up, frustum, near, far, orthographic } = &mut scene.camera;
                match value {
                    0..=2 => position[value] += by,
                    3..=5 => forward[value - 3] += by,
                    6..=8 => up[value - 6] += by,
                    9..=12 => frustum[value - 9] += 0.1 * by,
                    13 => *near += by,
                    14 => *far *= 1.0 + by,
                    _ => *orthographic ^= true,
                }
            }
            Self::Remove(index) if index < count => drop(scene.geoms.remove(index)),
            Self::Add(geom) => scene.geoms.push(geom),
            Self::Lights(other) => {
                let (camera, geoms) = (scene.camera, std::mem::take(&mut scene.geoms));
                *scene = Scene { camera, geoms, ..other };
            }
            Self::Camera(other) => scene.camera = other.camera,
            Self::Nothing
            | Self::Geom(..)
            | Self::Pose(..)
            | Self::Appearance(..)
            | Self::GeomValue(..)
            | Self::Remove(_) => {}
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(1000))]
    #[test]
    fn caches_do_not_change_frames(mut scene in scene(), changes in prop::collection::vec(change(), 16)) {
        let (assets, mut canvas) = (assets(), Canvas::new());
        for change in changes {
            change.make(&mut scene);
            prop_assert_eq!(drawn(&mut canvas, &scene, &assets), drawn(&mut Canvas::new(), &scene, &assets));
        }
    }

    #[test]
    fn scenes_drawn_in_turn_do_not_affect_each_other(scenes in prop::collection::vec(scene(), 2..7), moved in geom()) {
        let (assets, mut canvas) = (assets(), Canvas::new());
        let mut scenes = scenes;
        for turn in 0..4 {
            for scene in &mut scenes {
                if let Some(last) = scene.geoms.last_mut().filter(|_| turn > 1) {
                    last.position = moved.position.map(|x| x * 0.25 * turn as f32);
                }
                prop_assert_eq!(drawn(&mut canvas, scene, &assets), drawn(&mut Canvas::new(), scene, &assets));
            }
        }
    }
}

#[test]
fn replaced_meshes_are_drawn() {
    let camera = Camera { position: [0.0, -6.0, 0.0], ..CAMERA };
    let geom = Geom {
        shape: Shape::Mesh(0),
        position: [0.0; 3],
        rotation: IDENTITY,
        rgba: [1.0; 4],
        emission: 1.0,
        specular: 0.0,
        shininess: 0.0,
        reflectance: 0.0,
        paint: None,
        label: Some(3),
        casts: true,
    };
    let scene = Scene { camera, geoms: vec![geom; 2], ..Scene::default() };
    let (original, mut reversed) = (assets(), assets());
    reversed.meshes.reverse();
    let mut canvas = Canvas::new();
    for _ in 0..3 {
        assert!(drawn(&mut canvas, &scene, &original).2.contains(&3));
    }
    assert!(!drawn(&mut canvas, &scene, &reversed).2.contains(&3), "mesh 0 of the reversed list is empty");
}
