//! Simple scenes whose frames are known.

use crate::scenes::CAMERA;
use std::sync::Arc;
use swm_raster::{Assets, Axis, Camera, Canvas, Corner, Geom, IDENTITY, Light, Mesh, Scene, Shape, Target, V3};

fn geom(shape: Shape, position: V3) -> Geom {
    Geom {
        shape,
        position,
        rotation: IDENTITY,
        rgba: [1.0; 4],
        emission: 0.0,
        specular: 0.0,
        shininess: 0.5,
        reflectance: 0.0,
        paint: None,
        label: Some(0),
        casts: true,
    }
}

/// A directional light from above.
fn light(shadows: bool) -> Light {
    Light {
        position: [0.0, 5.0, 9.0],
        direction: [0.0, 0.0, -1.0],
        directional: true,
        attenuation: [1.0, 0.0, 0.0],
        cutoff: 45.0,
        exponent: 10.0,
        ambient: [0.0; 3],
        diffuse: [0.8; 3],
        specular: [0.0; 3],
        shadows,
    }
}

const SIDE: usize = 64;

fn rgb(scene: &Scene, assets: &Assets) -> Vec<u8> {
    let mut rgb = vec![0; SIDE * SIDE * 3];
    Canvas::new().draw(scene, assets, (SIDE, SIDE), 4, Target::Rgb(&mut rgb));
    rgb
}

fn depths(scene: &Scene, assets: &Assets) -> Vec<f32> {
    let mut depths = vec![0.0; SIDE * SIDE];
    Canvas::new().draw(scene, assets, (SIDE, SIDE), 1, Target::Depth(&mut depths));
    depths
}

/// The first channel of the pixel at the centre of a frame.
fn middle<T: Copy>(frame: &[T]) -> T {
    let channels = frame.len() / (SIDE * SIDE);
    frame[(SIDE / 2 * SIDE + SIDE / 2) * channels]
}

#[test]
fn depths_of_shapes_are_exact() {
    let quarter_turn = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, -1.0, 0.0];
    for (shape, nearest) in [
        (Shape::Ellipsoid([1.0, 2.0, 1.0]), 8.0),
        (Shape::Capsule(0.5, 2.0), 9.5),
        (Shape::Cylinder(0.5, 2.0), 9.5),
        (Shape::Box([1.0, 3.0, 1.0]), 7.0),
    ] {
        let scene = Scene { camera: CAMERA, geoms: vec![geom(shape, [0.0, 10.0, 0.0])], ..Scene::default() };
        let depth = middle(&depths(&scene, &Assets::default()));
        assert!((depth - nearest).abs() < 0.05, "{shape:?}: {depth}");
        // A shape that is far away and small must not be lost by rounding.
        let mut far = scene.clone();
        far.camera.far = 2e4;
        far.geoms[0].position[1] += 1e4;
        far.camera.frustum = [-2e-5, 2e-5, -2e-5, 2e-5];
        let depth = middle(&depths(&far, &Assets::default()));
        assert!((depth - nearest - 1e4).abs() < 0.05, "{shape:?}: {depth}");
    }
    // A capsule along the viewing direction.
    let mut lying = geom(Shape::Capsule(0.5, 2.0), [0.0, 10.0, 0.0]);
    lying.rotation = quarter_turn;
    let scene = Scene { camera: CAMERA, geoms: vec![lying], ..Scene::default() };
    assert!((middle(&depths(&scene, &Assets::default())) - 7.5).abs() < 0.05);
}

/// A plane below the camera, and a sphere above the plane.
fn sphere_over_plane(shadows: bool) -> Scene {
    let floor = Shape::Plane(Axis::even(20.0, 40), Axis::even(20.0, 40));
    Scene {
        camera: Camera { position: [0.0, 0.0, 2.0], ..CAMERA },
        geoms: vec![geom(floor, [0.0; 3]), geom(Shape::Ellipsoid([1.0; 3]), [0.0, 5.0, 2.0])],
        lights: vec![light(shadows)],
        shadows: true,
        reflections: true,
        shadow_reach: 20.0,
        shadow_angle: 0.6,
        ..Scene::default()
    }
}

/// The pixel that shows a position in [`sphere_over_plane`].
fn pixel([x, y, z]: V3) -> usize {
    let side = SIDE as f32;
    let column = ((x / y + 1.0) * 0.5 * side) as usize;
    let row = ((1.0 - (z - 2.0) / y) * 0.5 * side) as usize;
    row * SIDE + column
}

#[test]
fn sphere_casts_a_shadow_below_it() {
    let (lit, dark) = (sphere_over_plane(false), sphere_over_plane(true));
    let [lit, dark] = [lit, dark].map(|scene| rgb(&scene, &Assets::default()));
    let (below, beside) = (3 * pixel([0.0, 5.0, 0.0]), 3 * pixel([3.0, 5.0, 0.0]));
    assert_eq!(lit[below], 204);
    assert_eq!((lit[beside], dark[beside]), (204, 204));
    assert_eq!(dark[below], 0);
}

#[test]
fn plane_reflects_by_its_reflectance() {
    let mut scene = sphere_over_plane(false);
    scene.geoms[0].rgba = [0.0, 0.0, 0.0, 1.0];
    scene.geoms[0].reflectance = 0.5;
    scene.geoms[1].emission = 1.0;
    scene.lights.clear();
    let frame = rgb(&scene, &Assets::default());
    // The sphere emits its colour and gets dim light from everywhere: 1.3 of its colour, halved by the mirror.
    let mirrored = frame[3 * pixel([0.0, 5.0, -1.8])];
    assert!((160..=170).contains(&mirrored), "{mirrored}");
    assert_eq!(frame[3 * pixel([3.0, 5.0, -1.8])], 0);
}

#[test]
fn transparent_geoms_are_blended_twice() {
    let mut scene = sphere_over_plane(false);
    scene.lights.clear();
    scene.geoms.remove(0);
    scene.geoms[0].rgba = [1.0, 1.0, 1.0, 0.5];
    scene.geoms[0].emission = 0.7;
    // Drawn from near to far and again from far to near: three quarters of white over black.
    assert_eq!(middle(&rgb(&scene, &Assets::default())), 191);
}

#[test]
fn mesh_of_a_box_equals_the_box() {
    let corner = |i: usize| -> V3 { std::array::from_fn(|k| if i >> k & 1 == 1 { 1.0 } else { -1.0 }) };
    // The corners of each side, counterclockwise seen from outside, and its normal.
    let sides = [
        ([1, 3, 7, 5], [1.0, 0.0, 0.0]),
        ([0, 4, 6, 2], [-1.0, 0.0, 0.0]),
        ([2, 6, 7, 3], [0.0, 1.0, 0.0]),
        ([0, 1, 5, 4], [0.0, -1.0, 0.0]),
        ([4, 5, 7, 6], [0.0, 0.0, 1.0]),
        ([0, 2, 3, 1], [0.0, 0.0, -1.0]),
    ];
    let triangles = sides.iter().flat_map(|([a, b, c, d], normal)| {
        let corner = |i: usize| Corner { position: corner(i), normal: *normal, coordinates: [0.0; 2] };
        [[corner(*a), corner(*b), corner(*c)], [corner(*a), corner(*c), corner(*d)]]
    });
    let assets = Assets { meshes: vec![Arc::new(Mesh::new(triangles))], ..Assets::default() };
    let mut scene = sphere_over_plane(true);
    scene.camera.position[0] = 1.5;
    let [solid, mesh] = [Shape::Box([1.0; 3]), Shape::Mesh(0)].map(|shape| {
        scene.geoms[1].shape = shape;
        rgb(&scene, &assets)
    });
    let apart = solid.iter().zip(&mesh).filter(|(a, b)| a.abs_diff(**b) > 2).count();
    assert!(apart < 3 * 20, "{apart} bytes differ");
}
