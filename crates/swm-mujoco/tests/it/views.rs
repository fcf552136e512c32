//! Tests every camera of every environment in RGB, depth and segmentation, with both renderers.

use swm_core::{
    Action, Batch, CameraView, Env, FrameMut, Key, Modality, ResetOptions, Result, Schema, VariationRequest,
    thread_budget,
};
use swm_mujoco::ENVS;
use swm_mujoco::render::{self, Choice};

const HEIGHT: usize = 24;
const WIDTH: usize = 32;

fn render_view(env: &mut dyn Env, view: &CameraView) -> Result<Vec<f64>> {
    let mut row = Batch::zeros(&Schema::new([view.column(HEIGHT, WIDTH)])?, 1);
    env.render_view(view, HEIGHT, WIDTH, row.row_mut(0).bytes(0))?;
    row.row(0).to_f64(&view.to_string())
}

#[test]
fn camera_views_have_valid_values() {
    render::with(Choice::Cpu, || check_all_views("cpu ("));
}

fn check_all_views(renderer: &str) {
    for entry in ENVS.rows {
        let mut env = entry.env().unwrap_or_else(|error| panic!("{}: {error}", entry.id));
        env.reset(0, &ResetOptions::default()).expect("resetting the environment");
        let mut rgb = vec![0; HEIGHT * WIDTH * 3];
        env.render(FrameMut::new(WIDTH, HEIGHT, &mut rgb)).unwrap_or_else(|error| panic!("{}: {error}", entry.id));
        let cameras = env.spec().cameras.clone();
        for (i, camera) in cameras.into_iter().enumerate() {
            for modality in [Modality::Rgb, Modality::Depth, Modality::Segmentation] {
                let view = CameraView { camera: Some(camera.clone()), modality };
                let values = render_view(&mut *env, &view).unwrap_or_else(|error| panic!("{}: {error}", entry.id));
                let valid = match modality {
                    // The first camera is the default camera.
                    Modality::Rgb => i > 0 || values.iter().zip(&rgb).all(|(value, byte)| *value == f64::from(*byte)),
                    Modality::Depth => values.iter().all(|&metres| metres > 0.0 && metres.is_finite()),
                    Modality::Segmentation => values.iter().all(|&geom| geom >= -1.0),
                };
                assert!(valid, "{}: {view}: {values:?}", entry.id);
            }
        }
        let geoms = render_view(&mut *env, &CameraView { camera: None, modality: Modality::Segmentation })
            .expect("rendering a segmentation");
        assert!(geoms.iter().any(|&geom| geom >= 0.0), "{}: no geom is visible", entry.id);
        let unknown = CameraView { camera: Some("nowhere".to_owned()), modality: Modality::Rgb };
        assert!(render_view(&mut *env, &unknown).is_err(), "{}", entry.id);
        let libraries = env.libraries();
        assert_eq!(libraries.get("mujoco").map(String::as_str), Some(swm_mujoco::link::VERSION));
        assert!(libraries["renderer"].starts_with(renderer), "{libraries:?}");
    }
}

#[test]
fn frames_do_not_depend_on_the_number_of_threads() {
    let variation = VariationRequest { variation: Some(vec!["all".to_owned()]), ..VariationRequest::default() };
    let pools = [2, 3, 7].map(|threads| swm_core::pool::threads(threads).expect("creating a thread pool"));
    let (mut one, mut many) = (vec![0; 200 * 144 * 3], vec![0; 200 * 144 * 3]);
    render::with(Choice::Cpu, || {
        for entry in ENVS.rows {
            let mut env = entry.env().unwrap_or_else(|error| panic!("{}: {error}", entry.id));
            env.reset(3, &ResetOptions { variation: variation.clone(), ..ResetOptions::default() })
                .expect("resetting the environment");
            env.render(FrameMut::new(144, 200, &mut one)).expect("rendering a frame");
            for pool in &pools {
                let draw = || render::with(Choice::Cpu, || env.render(FrameMut::new(144, 200, &mut many)));
                pool.install(|| thread_budget::all(draw)).expect("rendering a frame");
                assert!(one == many, "{}: {} threads", entry.id, pool.current_num_threads());
            }
        }
    });
}

/// Renders on a new thread, whose caches are empty.
fn render_without_caches(env: &mut dyn Env, (width, height): (usize, usize)) -> Vec<u8> {
    let mut rgb = vec![0; width * height * 3];
    let draw = || render::with(Choice::Cpu, || env.render(FrameMut::new(width, height, &mut rgb)));
    std::thread::scope(|scope| scope.spawn(draw).join()).expect("joining the thread").expect("rendering a frame");
    rgb
}

#[test]
fn cached_geometry_does_not_change_frames() {
    let variation = VariationRequest { variation: Some(vec!["all".to_owned()]), ..VariationRequest::default() };
    for entry in ENVS.rows {
        let mut env = entry.env().unwrap_or_else(|error| panic!("{}: {error}", entry.id));
        let space = env.spec().action_space.clone();
        for step in 0..18 {
            let size = if step < 12 { (64, 48) } else { (40, 56) };
            match step {
                // Resets; the second and third change colours, lights, cameras and sizes.
                0 => env.reset(0, &ResetOptions::default()).expect("resetting the environment"),
                6 | 9 => env
                    .reset(step, &ResetOptions { variation: variation.clone(), ..ResetOptions::default() })
                    .expect("resetting the environment"),
                // These steps render the same state again.
                3 | 7 | 14 => {}
                _ => {
                    let action = space.sample(&mut Key::new(5).at(step).rng());
                    let action: Vec<f32> = action.iter().map(|&x| x as f32).collect();
                    env.step(Action::Continuous(&action)).expect("stepping the environment");
                }
            }
            let mut rgb = vec![0; size.0 * size.1 * 3];
            render::with(Choice::Cpu, || env.render(FrameMut::new(size.0, size.1, &mut rgb)))
                .expect("rendering a frame");
            assert!(rgb == render_without_caches(&mut *env, size), "{}, step {step}", entry.id);
        }
    }
}

/// The side of the frames in which the renderers are compared.
const SIDE: usize = 96;

#[test]
#[allow(clippy::print_stderr, reason = "a table for `--no-capture`")]
fn both_renderers_agree_on_geoms_and_distances() {
    let mut problems = vec![];
    for entry in ENVS.rows.iter().filter(|entry| !entry.id.contains("Dense") && !entry.id.contains("Dict")) {
        let mut env = entry.env().unwrap_or_else(|error| panic!("{}: {error}", entry.id));
        env.reset(1, &ResetOptions::default()).expect("resetting the environment");
        let mut view_of = |choice, modality| {
            let view = CameraView { camera: None, modality };
            let mut row = Batch::zeros(&Schema::new([view.column(SIDE, SIDE)]).expect("creating the schema"), 1);
            render::with(choice, || env.render_view(&view, SIDE, SIDE, row.row_mut(0).bytes(0)))
                .unwrap_or_else(|error| panic!("{}: {error}", entry.id));
            row.row(0).to_f64(&view.to_string()).expect("reading the column")
        };
        let [cpu_geoms, egl_geoms] = [Choice::Cpu, Choice::Egl].map(|choice| view_of(choice, Modality::Segmentation));
        let [cpu_depths, egl_depths] = [Choice::Cpu, Choice::Egl].map(|choice| view_of(choice, Modality::Depth));
        let equal = cpu_geoms.iter().zip(&egl_geoms).filter(|(a, b)| a == b).count() as f64 / cpu_geoms.len() as f64;
        // Distances are compared at pixels with the same geom. At silhouettes, they may be those of different surfaces.
        let depths: Vec<(f64, f64)> = (0..cpu_geoms.len())
            .filter(|&i| cpu_geoms[i] == egl_geoms[i] && cpu_geoms[i] >= 0.0)
            .map(|i| (cpu_depths[i], egl_depths[i]))
            .collect();
        let close =
            depths.iter().filter(|(a, b)| (a - b).abs() <= 0.01 * b).count() as f64 / depths.len().max(1) as f64;
        eprintln!("{}: geoms {equal:.4}, distances {close:.4}", entry.id);
        if equal < 0.99 || close < 0.99 {
            problems.push(format!("{}: geoms {equal:.4}, distances {close:.4}", entry.id));
        }
    }
    assert!(problems.is_empty(), "{problems:#?}");
}
