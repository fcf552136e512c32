//! A machine without a graphics library: pictures are drawn all the same.

use std::process::Command;
use swm_core::{FrameMut, ResetOptions};
use swm_mujoco::ENVS;
use swm_mujoco::render::{self, Choice};

/// What names the EGL library to open.
const LIBRARY: &str = "SWM_EGL_LIBRARY";

#[test]
fn worlds_are_drawn_where_no_graphics_library_is() {
    if std::env::var_os(LIBRARY).is_none() {
        // What was opened stays open, so this is for a process of its own.
        let test = std::env::current_exe().expect("this program");
        let mut alone = Command::new(test);
        alone.args(["--exact", "no_gl::worlds_are_drawn_where_no_graphics_library_is"]).env(LIBRARY, "libNoEGL.so");
        let output = alone.output().expect("this program again");
        let said = String::from_utf8_lossy(&output.stdout);
        assert!(output.status.success() && said.contains("1 passed"), "{said}");
        return;
    }
    let mut env = ENVS.choose("swm/CheetahDMControl-v0").and_then(|entry| entry.env()).expect("a world");
    env.reset(0, &ResetOptions::default()).expect("a reset");
    let mut draw = |choice| {
        let mut rgb = vec![0; 16 * 16 * 3];
        render::with(choice, || env.render(FrameMut::new(16, 16, &mut rgb))).map(|()| rgb)
    };
    let ours = draw(Choice::Cpu).expect("a picture");
    assert!(ours.iter().any(|byte| *byte > 0));
    assert_eq!(draw(Choice::Auto).expect("a picture"), ours);
    let problem = draw(Choice::Egl).expect_err("there is no EGL").to_string();
    assert!(problem.contains("libNoEGL.so") && problem.contains("the renderer cpu"), "{problem}");
}
