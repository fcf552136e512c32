//! Every camera of every world, in colours, distances and geoms; and what draws them.

use swm_core::{Batch, Env, FrameMut, Modality, ResetOptions, Result, Schema, View};
use swm_mujoco::ENVS;

const HEIGHT: usize = 24;
const WIDTH: usize = 32;

fn see(env: &mut dyn Env, view: &View) -> Result<Vec<f64>> {
    let mut row = Batch::zeros(&Schema::new([view.column(HEIGHT, WIDTH)])?, 1);
    env.render_view(view, HEIGHT, WIDTH, row.row_mut(0).bytes(0))?;
    row.row(0).to_f64(&view.to_string())
}

#[test]
fn views_show_what_they_say() {
    for entry in ENVS.rows {
        let mut env = entry.env().unwrap_or_else(|error| panic!("{}: {error}", entry.id));
        env.reset(0, &ResetOptions::default()).expect("a reset");
        let mut rgb = vec![0; HEIGHT * WIDTH * 3];
        env.render(FrameMut::new(WIDTH, HEIGHT, &mut rgb)).unwrap_or_else(|error| panic!("{}: {error}", entry.id));
        let cameras = env.spec().cameras.clone();
        for (i, camera) in cameras.into_iter().enumerate() {
            for modality in [Modality::Rgb, Modality::Depth, Modality::Segmentation] {
                let view = View { camera: Some(camera.clone()), modality };
                let seen = see(&mut *env, &view).unwrap_or_else(|error| panic!("{}: {error}", entry.id));
                let fine = match modality {
                    // The first camera is the default one.
                    Modality::Rgb => i > 0 || seen.iter().zip(&rgb).all(|(seen, byte)| *seen == f64::from(*byte)),
                    Modality::Depth => seen.iter().all(|&metres| metres > 0.0 && metres.is_finite()),
                    Modality::Segmentation => seen.iter().all(|&geom| geom >= -1.0),
                };
                assert!(fine, "{}: {view}: {seen:?}", entry.id);
            }
        }
        let geoms = see(&mut *env, &View { camera: None, modality: Modality::Segmentation }).expect("geoms");
        assert!(geoms.iter().any(|&geom| geom >= 0.0), "{}: something is to be seen", entry.id);
        let unknown = View { camera: Some("nowhere".to_owned()), modality: Modality::Rgb };
        assert!(see(&mut *env, &unknown).is_err(), "{}", entry.id);
        let libraries = env.libraries();
        assert_eq!(libraries.get("mujoco").map(String::as_str), Some(swm_mujoco::link::VERSION));
        assert!(libraries["renderer"].starts_with("egl ("), "{libraries:?}");
    }
}
