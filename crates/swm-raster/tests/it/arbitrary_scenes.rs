//! Every scene, however invalid, is drawn without panic and with the same bytes every time.

use crate::scenes::{CAMERA, assets, drawn, geom, scene};
use proptest::prelude::*;
use proptest::strategy::ValueTree;
use rayon::prelude::*;
use swm_raster::{Assets, Camera, Canvas, Scene, Target};

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]
    #[test]
    fn used_canvas_draws_like_a_new_canvas(first in scene(), second in scene()) {
        let assets = assets();
        let mut canvas = Canvas::new();
        drawn(&mut canvas, &first, &assets);
        // Earlier frames do not affect later frames.
        prop_assert_eq!(drawn(&mut canvas, &second, &assets), drawn(&mut Canvas::new(), &second, &assets));
    }
}

#[test]
fn large_scenes_give_the_same_bytes_on_any_thread() {
    let mut runner = proptest::test_runner::TestRunner::deterministic();
    let tree = prop::collection::vec(geom(), 4000).new_tree(&mut runner).expect("the strategy generates geoms");
    let camera = Camera { position: [0.0, -6.0, 0.0], ..CAMERA };
    let scene = Scene { camera, geoms: tree.current(), shadows: true, reflections: true, ..Scene::default() };
    let assets = assets();
    let alone = drawn(&mut Canvas::new(), &scene, &assets);
    assert!(alone.2.contains(&1));
    let together: Vec<_> = (0..4).into_par_iter().map(|_| drawn(&mut Canvas::new(), &scene, &assets)).collect();
    assert!(together.iter().all(|other| *other == alone));
}

#[test]
fn too_small_targets_stay_unchanged() {
    let mut rgb = [7; 5];
    Canvas::new().draw(&Scene::default(), &Assets::default(), (2, 1), 4, Target::Rgb(&mut rgb));
    assert_eq!(rgb, [7; 5]);
    Canvas::new().draw(&Scene::default(), &Assets::default(), (0, 3), 4, Target::Rgb(&mut []));
}
