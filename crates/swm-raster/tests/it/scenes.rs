//! Random scenes of every kind, including invalid ones: sizes of zero, positions that are NaN, cameras inside of
//! geoms.
#![allow(clippy::expect_used, reason = "tests may panic")]

use proptest::prelude::*;
use std::sync::Arc;
use swm_raster::{
    Assets, Axis, Camera, Canvas, Corner, Geom, Haze, IDENTITY, Light, Mapping, Mesh, Paint, Scene, Shape, Target,
    Texture, V3,
};

/// A camera at the origin that faces +y, with a field of view of 90 degrees.
pub const CAMERA: Camera = Camera {
    position: [0.0; 3],
    forward: [0.0, 1.0, 0.0],
    up: [0.0, 0.0, 1.0],
    frustum: [-0.02, 0.02, -0.02, 0.02],
    near: 0.02,
    far: 100.0,
    orthographic: false,
};

/// Values, including infinities, NaN and extremes.
fn value() -> impl Strategy<Value = f32> {
    prop_oneof![
        8 => -3.0..3.0f32,
        1 => prop::sample::select(vec![
            0.0, -0.0, 1.0, f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1e30, -1e30, 1e-30, f32::MIN_POSITIVE, f32::MAX,
        ]),
    ]
}

fn vector() -> impl Strategy<Value = V3> {
    prop::array::uniform3(value())
}

fn shape() -> impl Strategy<Value = Shape> {
    let axis = || {
        (value(), value(), value(), 1..50usize, any::<bool>()).prop_map(|(half, pad, step, cells, infinite)| Axis {
            half,
            pad,
            step,
            cells,
            infinite,
        })
    };
    prop_oneof![
        (axis(), axis()).prop_map(|(x, y)| Shape::Plane(x, y)),
        vector().prop_map(Shape::Ellipsoid),
        (value(), value()).prop_map(|(radius, half)| Shape::Capsule(radius, half)),
        (value(), value()).prop_map(|(radius, half)| Shape::Cylinder(radius, half)),
        vector().prop_map(Shape::Box),
        (0..4usize).prop_map(Shape::Mesh),
    ]
}

fn rotation() -> impl Strategy<Value = [f32; 9]> {
    prop_oneof![3 => Just(IDENTITY), 1 => prop::array::uniform9(value())]
}

fn paint() -> impl Strategy<Value = Option<Paint>> {
    let mapping = prop_oneof![
        (prop::array::uniform2(value()), prop::array::uniform2(value()))
            .prop_map(|(scale, offset)| Mapping::Flat { scale, offset }),
        vector().prop_map(Mapping::Cube),
        prop::array::uniform2(value()).prop_map(Mapping::Sides),
        Just(Mapping::Own),
    ];
    prop::option::of((0..4usize, mapping).prop_map(|(texture, mapping)| Paint { texture, mapping }))
}

/// A random geom.
pub fn geom() -> impl Strategy<Value = Geom> {
    let material = (prop::array::uniform4(value()), value(), value(), value(), value(), paint());
    (shape(), vector(), rotation(), material, any::<bool>()).prop_map(|(shape, position, rotation, material, casts)| {
        let (rgba, emission, specular, shininess, reflectance, paint) = material;
        let label = Some(1);
        Geom { shape, position, rotation, rgba, emission, specular, shininess, reflectance, paint, label, casts }
    })
}

fn light() -> impl Strategy<Value = Light> {
    let colours = (vector(), vector(), vector());
    (vector(), vector(), any::<bool>(), vector(), (value(), value()), colours, any::<bool>()).prop_map(
        |(position, direction, directional, attenuation, (cutoff, exponent), (ambient, diffuse, specular), shadows)| {
            Light {
                position,
                direction,
                directional,
                attenuation,
                cutoff: 60.0 * cutoff,
                exponent,
                ambient,
                diffuse,
                specular,
                shadows,
            }
        },
    )
}

fn camera() -> impl Strategy<Value = Camera> {
    let usual = vector().prop_map(|position| Camera { position, ..CAMERA });
    let odd = (vector(), vector(), vector(), prop::array::uniform4(value()), value(), value(), any::<bool>()).prop_map(
        |(position, forward, up, frustum, near, far, orthographic)| Camera {
            position,
            forward,
            up,
            frustum,
            near,
            far,
            orthographic,
        },
    );
    prop_oneof![3 => usual, 1 => odd]
}

/// A random scene.
pub fn scene() -> impl Strategy<Value = Scene> {
    let more = (prop::option::of(0..4usize), any::<bool>(), any::<bool>(), value(), value());
    (camera(), prop::collection::vec(geom(), 0..12), prop::collection::vec(light(), 0..4), more).prop_map(
        |(camera, geoms, lights, (sky, shadows, reflections, shadow_reach, shadow_angle))| Scene {
            camera,
            geoms,
            lights,
            sky,
            haze: Some(Haze { rgb: [0.5; 3], depth: 0.3 }),
            shadows,
            reflections,
            shadow_reach,
            shadow_angle,
        },
    )
}

/// Three meshes (a tetrahedron, triangles that are degenerate or not finite, no triangles) and three textures (flat,
/// cube, white).
pub fn assets() -> Assets {
    let corner = |position: V3| Corner { position, normal: position, coordinates: [0.5, 2.5] };
    let [a, b, c, d] = [[1.0, 1.0, 1.0], [-1.0, -1.0, 1.0], [-1.0, 1.0, -1.0], [1.0, -1.0, -1.0]].map(corner);
    let solid = Mesh::new([[a, b, d], [a, d, c], [a, c, b], [b, c, d]]);
    let broken = Mesh::new([[a, a, a], [a, b, corner([f32::NAN, 0.0, 0.0])], [a, b, corner([1e30; 3])]]);
    let bytes: Vec<u8> = (0..72u8).map(|i| i.wrapping_mul(89)).collect();
    let flat = Texture::flat(3, 2, 3, &bytes[..18]).expect("creating the texture");
    let cube = Texture::cube(2, 3, &bytes).expect("creating the texture");
    Assets {
        textures: vec![Arc::new(flat), Arc::new(cube), Arc::new(Texture::white())],
        meshes: vec![Arc::new(solid), Arc::new(broken), Arc::new(Mesh::new([]))],
    }
}

const SIZE: (usize, usize) = (13, 9);

/// Draws a scene; returns its colours, the bits of its depths, and its labels.
pub fn drawn(canvas: &mut Canvas, scene: &Scene, assets: &Assets) -> (Vec<u8>, Vec<u32>, Vec<i32>) {
    let n = SIZE.0 * SIZE.1;
    let (mut rgb, mut depths, mut labels) = (vec![0; 3 * n], vec![0.0; n], vec![0; n]);
    canvas.draw(scene, assets, SIZE, 4, Target::Rgb(&mut rgb));
    canvas.draw(scene, assets, SIZE, 4, Target::Depth(&mut depths));
    canvas.draw(scene, assets, SIZE, 4, Target::Labels(&mut labels));
    (rgb, depths.into_iter().map(f32::to_bits).collect(), labels)
}
