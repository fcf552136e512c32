//! Pictures of scenes that move are those one would draw afresh, whatever is kept from one to the next.

use crate::scenes::{assets, drawn, geom, scene};
use proptest::prelude::*;
use swm_raster::{Camera, Canvas, Geom, IDENTITY, Scene, Shape};

/// What happens between two pictures.
#[derive(Clone, Debug)]
enum Change {
    Nothing,
    /// A geom is replaced, its place or its look only where there is one.
    Geom(usize, Geom),
    Place(usize, Geom),
    Look(usize, Geom),
    /// One number changes: of a geom's place and form, or of the camera.
    Nudge(usize, usize, f32),
    Turn(usize, f32),
    /// A thing comes, or goes.
    More(Geom),
    Less(usize),
    /// Everything but the geoms is that of another scene.
    Lights(Scene),
    Camera(Scene),
}

fn change() -> impl Strategy<Value = Change> {
    let place = || 0..12usize;
    prop_oneof![
        4 => Just(Change::Nothing),
        1 => (place(), geom()).prop_map(|(place, geom)| Change::Geom(place, geom)),
        4 => (place(), geom()).prop_map(|(place, geom)| Change::Place(place, geom)),
        1 => (place(), geom()).prop_map(|(place, geom)| Change::Look(place, geom)),
        4 => (place(), prop_oneof![0..3usize, 0..15usize], -1.0..1.0f32).prop_map(|(place, number, by)| Change::Nudge(place, number, by)),
        2 => (0..16usize, -0.1..0.1f32).prop_map(|(number, by)| Change::Turn(number, by)),
        1 => geom().prop_map(Change::More),
        1 => place().prop_map(Change::Less),
        1 => scene().prop_map(Change::Lights),
        1 => scene().prop_map(Change::Camera),
    ]
}

impl Change {
    fn make(self, scene: &mut Scene) {
        let count = scene.geoms.len();
        match self {
            Self::Geom(place, geom) if place < count => scene.geoms[place] = geom,
            Self::Place(place, geom) if place < count => {
                (scene.geoms[place].position, scene.geoms[place].rotation) = (geom.position, geom.rotation);
            }
            Self::Look(place, geom) if place < count => {
                scene.geoms[place] = Geom {
                    shape: scene.geoms[place].shape,
                    position: scene.geoms[place].position,
                    rotation: scene.geoms[place].rotation,
                    ..geom
                }
            }
            Self::Nudge(place, number, by) if place < count => {
                let geom = &mut scene.geoms[place];
                let number = match (number, &mut geom.shape) {
                    (0..=2, _) => &mut geom.position[number],
                    (3..=11, _) => &mut geom.rotation[number - 3],
                    (12, Shape::Plane(x, _)) => &mut x.half,
                    (_, Shape::Plane(_, y)) => &mut y.half,
                    (_, Shape::Ellipsoid(sizes) | Shape::Box(sizes)) => &mut sizes[number - 12],
                    (13.., Shape::Capsule(_, half) | Shape::Cylinder(_, half)) => half,
                    (_, Shape::Capsule(radius, _) | Shape::Cylinder(radius, _)) => radius,
                    (_, Shape::Mesh(mesh)) => return *mesh = number - 12,
                };
                *number += by;
            }
            Self::Turn(number, by) => {
                let Camera { position, forward, up, frustum, near, far, orthographic } = &mut scene.camera;
                match number {
                    0..=2 => position[number] += by,
                    3..=5 => forward[number - 3] += by,
                    6..=8 => up[number - 6] += by,
                    9..=12 => frustum[number - 9] += 0.1 * by,
                    13 => *near += by,
                    14 => *far *= 1.0 + by,
                    _ => *orthographic ^= true,
                }
            }
            Self::Less(place) if place < count => drop(scene.geoms.remove(place)),
            Self::More(geom) => scene.geoms.push(geom),
            Self::Lights(other) => {
                let (camera, geoms) = (scene.camera, std::mem::take(&mut scene.geoms));
                *scene = Scene { camera, geoms, ..other };
            }
            Self::Camera(other) => scene.camera = other.camera,
            Self::Nothing | Self::Geom(..) | Self::Place(..) | Self::Look(..) | Self::Nudge(..) | Self::Less(_) => {}
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(1000))]
    #[test]
    fn what_is_kept_is_not_seen(mut scene in scene(), changes in prop::collection::vec(change(), 16)) {
        let (assets, mut canvas) = (assets(), Canvas::new());
        for change in changes {
            change.make(&mut scene);
            prop_assert_eq!(drawn(&mut canvas, &scene, &assets), drawn(&mut Canvas::new(), &scene, &assets));
        }
    }

    #[test]
    fn worlds_in_turn_do_not_see_each_other(worlds in prop::collection::vec(scene(), 2..7), moved in geom()) {
        let (assets, mut canvas) = (assets(), Canvas::new());
        let mut worlds = worlds;
        for turn in 0..4 {
            for world in &mut worlds {
                if let Some(last) = world.geoms.last_mut().filter(|_| turn > 1) {
                    last.position = moved.position.map(|x| x * 0.25 * turn as f32);
                }
                prop_assert_eq!(drawn(&mut canvas, world, &assets), drawn(&mut Canvas::new(), world, &assets));
            }
        }
    }
}

#[test]
fn other_meshes_in_the_same_places_are_other_things() {
    let camera = Camera {
        position: [0.0, -6.0, 0.0],
        forward: [0.0, 1.0, 0.0],
        up: [0.0, 0.0, 1.0],
        frustum: [-0.02, 0.02, -0.02, 0.02],
        near: 0.02,
        far: 100.0,
        orthographic: false,
    };
    let thing = Geom {
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
    let scene = Scene { camera, geoms: vec![thing; 2], ..Scene::default() };
    let (some, mut others) = (assets(), assets());
    others.meshes.reverse();
    let mut canvas = Canvas::new();
    for _ in 0..3 {
        assert!(drawn(&mut canvas, &scene, &some).2.contains(&3));
    }
    assert!(!drawn(&mut canvas, &scene, &others).2.contains(&3), "no mesh is there any more");
}
