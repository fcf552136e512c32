//! Whatever a scene is, drawing ends, and gives the same bytes again.

use crate::scenes::{assets, drawn, geom, scene};
use proptest::prelude::*;
use proptest::strategy::ValueTree;
use rayon::prelude::*;
use swm_raster::{Assets, Camera, Canvas, Scene, Target};

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]
    #[test]
    fn odd_scenes_are_drawn_alike_twice(first in scene(), second in scene()) {
        let assets = assets();
        let mut canvas = Canvas::new();
        drawn(&mut canvas, &first, &assets);
        // What was drawn before leaves no trace.
        prop_assert_eq!(drawn(&mut canvas, &second, &assets), drawn(&mut Canvas::new(), &second, &assets));
    }
}

#[test]
fn thousands_of_geoms_give_the_same_bytes_on_any_thread() {
    let mut runner = proptest::test_runner::TestRunner::deterministic();
    let tree = prop::collection::vec(geom(), 4000).new_tree(&mut runner).expect("geoms");
    let camera = Camera {
        position: [0.0, -6.0, 0.0],
        forward: [0.0, 1.0, 0.0],
        up: [0.0, 0.0, 1.0],
        frustum: [-0.02, 0.02, -0.02, 0.02],
        near: 0.02,
        far: 100.0,
        orthographic: false,
    };
    let scene = Scene { camera, geoms: tree.current(), shadows: true, reflections: true, ..Scene::default() };
    let assets = assets();
    let alone = drawn(&mut Canvas::new(), &scene, &assets);
    assert!(alone.2.contains(&1));
    let together: Vec<_> = (0..4).into_par_iter().map(|_| drawn(&mut Canvas::new(), &scene, &assets)).collect();
    assert!(together.iter().all(|other| *other == alone));
}

#[test]
fn targets_that_are_too_small_stay_as_they_are() {
    let mut rgb = [7; 5];
    Canvas::new().draw(&Scene::default(), &Assets::default(), (2, 1), 4, Target::Rgb(&mut rgb));
    assert_eq!(rgb, [7; 5]);
    Canvas::new().draw(&Scene::default(), &Assets::default(), (0, 3), 4, Target::Rgb(&mut []));
}
