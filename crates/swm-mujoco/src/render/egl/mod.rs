//! MuJoCo's OpenGL renderer without a window, in contexts that EGL creates on a device.
//!
//! An OpenGL context is current in one thread at a time, while environments run on any thread. Contexts therefore belong
//! to render threads of this module, which render the jobs of a queue while the callers wait. Graphics cards are
//! preferred to Mesa's software renderer. `MUJOCO_EGL_DEVICE_ID` selects a device by index, as in MuJoCo's Python
//! packages.
#![allow(
    unsafe_code,
    reason = "EGL and OpenGL through pointers, and scenes lent to another thread while the owner waits"
)]

mod context;
mod library;

use super::renderer::{FrameBuffer, ModelScene, Renderer};
use context::RenderContexts;
use library::{Display, Library};
use std::collections::VecDeque;
use std::sync::mpsc::{self, Sender};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use swm_core::{Error, Result};

/// The maximal number of render threads of a software renderer; each thread holds contexts and their memory.
const MAX_THREADS: usize = 8;

/// The maximal number of render threads on a graphics card; more threads do not increase the utilisation of the card.
const MAX_HARDWARE_THREADS: usize = 4;

/// Whether EGL renders on a graphics card. EGL is loaded only if the system has a device file of a card; otherwise EGL
/// would load Mesa with the LLVM compiler, whose symbols conflict with those that PyTorch's Triton loads into the same
/// process.
pub(crate) fn has_hardware() -> bool {
    let is_card = |name: &str| name == "dri" || name == "dxg" || name.starts_with("nvidia");
    let devices = std::fs::read_dir("/dev").into_iter().flatten().flatten();
    let known = devices.filter_map(|device| device.file_name().into_string().ok()).any(|name| is_card(&name));
    known && Library::open().and_then(|library| library.display()).is_ok_and(|display| display.hardware)
}

/// MuJoCo's OpenGL renderer: a queue of jobs, and threads that render them.
pub(crate) struct EglRenderer {
    name: String,
    queue: Arc<Queue>,
}

/// A frame to render, for which the caller waits.
struct Job {
    scene: ModelScene<'static>,
    size: (usize, usize),
    buffer: FrameBuffer<'static>,
    completion: Arc<Completion>,
}

// SAFETY: the caller keeps the memory that a job points to valid until the job is complete; until then, only one
// thread accesses this memory.
unsafe impl Send for Job {}

/// Jobs in order of arrival.
#[derive(Default)]
struct Queue {
    jobs: Mutex<VecDeque<Job>>,
    added: Condvar,
}

/// Signals the completion of a job to its caller.
#[derive(Default)]
struct Completion {
    outcome: Mutex<Option<Result<()>>>,
    set: Condvar,
}

/// Locks a mutex, ignoring poisoning: the guarded queue or result is valid after any panic.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl EglRenderer {
    /// Opens a device and starts the render threads.
    ///
    /// # Errors
    /// When EGL is not installed, or no device is usable.
    pub fn new() -> Result<Self> {
        crate::link::load()?;
        let library = Arc::new(Library::open()?);
        let display = library.display()?;
        let queue = Arc::new(Queue::default());
        let (sender, started) = mpsc::channel();
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let threads = cores.min(if display.hardware { MAX_HARDWARE_THREADS } else { MAX_THREADS });
        let mut failure = None;
        for i in 0..threads {
            let (library, queue, sender) = (Arc::clone(&library), Arc::clone(&queue), sender.clone());
            let run = move || run_render_thread(library, display, &queue, &sender);
            if let Err(error) = std::thread::Builder::new().name(format!("render-{i}")).spawn(run) {
                failure = Some(Error::external("starting a render thread", error));
            }
        }
        drop(sender);
        // One working thread is enough; a thread that cannot create a context ends.
        for result in started {
            match result {
                Ok(device) => return Ok(Self { name: format!("egl ({device})"), queue }),
                Err(error) => failure = Some(error),
            }
        }
        Err(failure.unwrap_or_else(|| Error::external("EGL", "no render thread could start")))
    }
}

impl Renderer for EglRenderer {
    fn name(&self) -> &str {
        &self.name
    }

    fn draw(&self, scene: ModelScene<'_>, width: usize, height: usize, buffer: FrameBuffer<'_>) -> Result<()> {
        thread_local! {
            /// Reused, so that a frame needs no allocation.
            static COMPLETION: Arc<Completion> = Arc::default();
        }
        COMPLETION.with(|completion| {
            // SAFETY: this call ends after the job is complete, so the extended lifetimes are never used beyond it.
            let (scene, buffer) = unsafe {
                (
                    std::mem::transmute::<ModelScene<'_>, ModelScene<'static>>(scene),
                    std::mem::transmute::<FrameBuffer<'_>, FrameBuffer<'static>>(buffer),
                )
            };
            let job = Job { scene, size: (width, height), buffer, completion: Arc::clone(completion) };
            lock(&self.queue.jobs).push_back(job);
            self.queue.added.notify_one();
            let mut outcome = lock(&completion.outcome);
            loop {
                match outcome.take() {
                    Some(outcome) => return outcome,
                    None => outcome = completion.set.wait(outcome).unwrap_or_else(PoisonError::into_inner),
                }
            }
        })
    }
}

/// The main function of a render thread: reports whether it can create a context, then renders the jobs of the queue.
fn run_render_thread(library: Arc<Library>, display: Display, queue: &Queue, started: &Sender<Result<String>>) {
    let device = match library.create_context(display) {
        Ok(gl) => {
            let device = library.device_name();
            library.destroy_context(&gl);
            device
        }
        Err(error) => {
            // The receiver is gone if another thread has started already.
            let _ignored = started.send(Err(error));
            return;
        }
    };
    let _ignored = started.send(Ok(device));
    let mut contexts = RenderContexts::new(library, display);
    loop {
        let mut jobs = lock(&queue.jobs);
        let job = loop {
            match jobs.pop_front() {
                Some(job) => break job,
                None => jobs = queue.added.wait(jobs).unwrap_or_else(PoisonError::into_inner),
            }
        };
        drop(jobs);
        let Job { scene, size, buffer, completion } = job;
        // After a panic, the caller must be woken and the thread must continue.
        let drawn = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| contexts.draw(scene, size, buffer)));
        let outcome = drawn.unwrap_or_else(|_| Err(Error::external("rendering a scene", "the renderer panicked")));
        *lock(&completion.outcome) = Some(outcome);
        completion.set.notify_one();
    }
}
