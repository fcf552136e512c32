//! [`Choice`]: the selection of the renderer, per process and per thread.

use super::renderer::Renderer;
use super::{cpu, egl};
use std::cell::Cell;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU8, Ordering};
use swm_core::{Error, Result};

/// A choice of renderer.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Choice {
    /// MuJoCo's renderer if there is a graphics card, otherwise the CPU renderer.
    #[default]
    Auto,
    /// MuJoCo's OpenGL renderer through EGL: on a graphics card, or slowly in Mesa's software renderer.
    Egl,
    /// The CPU renderer of this project.
    Cpu,
}

impl std::str::FromStr for Choice {
    type Err = Error;

    fn from_str(word: &str) -> Result<Self> {
        match word {
            "auto" => Ok(Self::Auto),
            "egl" => Ok(Self::Egl),
            "cpu" => Ok(Self::Cpu),
            _ => Err(Error::config("the renderer", format!("there is no '{word}'"), "choose auto, egl or cpu")),
        }
    }
}

/// The discriminant of this process's choice.
static PROCESS_CHOICE: AtomicU8 = AtomicU8::new(Choice::Auto as u8);

thread_local! {
    /// The choice of this thread during [`with`].
    static THREAD_CHOICE: Cell<Option<Choice>> = const { Cell::new(None) };
}

/// Selects the renderer of this process for all frames from now on.
pub fn choose(choice: Choice) {
    PROCESS_CHOICE.store(choice as u8, Ordering::Relaxed);
}

/// Selects the renderer for the frames that `draw` renders on this thread.
pub fn with<T>(choice: Choice, draw: impl FnOnce() -> T) -> T {
    /// Restores the previous choice, also when `draw` panics.
    struct Restore(Option<Choice>);
    impl Drop for Restore {
        fn drop(&mut self) {
            THREAD_CHOICE.set(self.0);
        }
    }
    let _restore = Restore(THREAD_CHOICE.replace(Some(choice)));
    draw()
}

/// Returns the choice of this thread, otherwise that of this process.
fn chosen() -> Choice {
    THREAD_CHOICE.get().unwrap_or_else(|| match PROCESS_CHOICE.load(Ordering::Relaxed) {
        chosen if chosen == Choice::Egl as u8 => Choice::Egl,
        chosen if chosen == Choice::Cpu as u8 => Choice::Cpu,
        _ => Choice::Auto,
    })
}

static EGL: OnceLock<Result<egl::EglRenderer, String>> = OnceLock::new();
static CPU: cpu::CpuRenderer = cpu::CpuRenderer;

/// The name of the chosen renderer with its device, for manifests.
///
/// # Errors
/// When EGL was chosen and is not available; the error names the package to install.
pub fn name() -> Result<String> {
    renderer().map(|renderer| renderer.name().to_owned())
}

/// The chosen renderer.
///
/// # Errors
/// When EGL was chosen and is not available; the error names the package to install.
pub(super) fn renderer() -> Result<&'static dyn Renderer> {
    /// Whether there is a graphics card; determined once.
    static HARDWARE: OnceLock<bool> = OnceLock::new();
    let egl = match chosen() {
        Choice::Cpu => false,
        Choice::Egl => true,
        Choice::Auto => *HARDWARE.get_or_init(egl::has_hardware),
    };
    if !egl {
        return Ok(&CPU);
    }
    let started = EGL.get_or_init(|| {
        let started = egl::EglRenderer::new().map_err(|error| error.to_string());
        match &started {
            Ok(renderer) => tracing::info!("MuJoCo environments are rendered by {}", renderer.name()),
            Err(problem) => tracing::warn!("MuJoCo environments cannot be rendered with EGL: {problem}"),
        }
        started
    });
    match started {
        Ok(renderer) => Ok(renderer),
        Err(problem) if chosen() == Choice::Auto => {
            tracing::debug!("rendering on the CPU: {problem}");
            Ok(&CPU)
        }
        Err(problem) => {
            let egl =
                "install EGL (Debian: apt install libegl1 libegl-mesa0 libgl1-mesa-dri), or choose the renderer cpu";
            // What says itself what to install is not about EGL.
            let fix = if problem.contains("swm assets") { "or choose the renderer cpu" } else { egl };
            Err(Error::config("rendering a MuJoCo environment with EGL", problem, fix))
        }
    }
}
