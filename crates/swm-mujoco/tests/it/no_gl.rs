//! Tests rendering where no graphics library is installed.

use std::process::Command;
use swm_core::{FrameMut, ResetOptions};
use swm_mujoco::ENVS;
use swm_mujoco::render::{self, Choice};

/// The variable that names the EGL library to load.
const LIBRARY: &str = "SWM_EGL_LIBRARY";

#[test]
fn renders_without_a_graphics_library() {
    if std::env::var_os(LIBRARY).is_none() {
        // A library cannot be unloaded, so the test runs in a separate process.
        let test = std::env::current_exe().expect("finding the test program");
        let mut alone = Command::new(test);
        alone.args(["--exact", "no_gl::renders_without_a_graphics_library"]).env(LIBRARY, "libNoEGL.so");
        let output = alone.output().expect("running the test program");
        let stdout = String::from_utf8_lossy(&output.stdout);
        assert!(output.status.success() && stdout.contains("1 passed"), "{stdout}");
        return;
    }
    let mut env =
        ENVS.choose("swm/CheetahDMControl-v0").and_then(|entry| entry.env()).expect("creating the environment");
    env.reset(0, &ResetOptions::default()).expect("resetting the environment");
    let mut draw = |choice| {
        let mut rgb = vec![0; 16 * 16 * 3];
        render::with(choice, || env.render(FrameMut::new(16, 16, &mut rgb))).map(|()| rgb)
    };
    let ours = draw(Choice::Cpu).expect("rendering a frame");
    assert!(ours.iter().any(|byte| *byte > 0));
    assert_eq!(draw(Choice::Auto).expect("rendering a frame"), ours);
    let problem = draw(Choice::Egl).expect_err("rendering with EGL").to_string();
    assert!(problem.contains("libNoEGL.so") && problem.contains("the renderer cpu"), "{problem}");
}
