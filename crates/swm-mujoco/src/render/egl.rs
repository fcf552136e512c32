//! MuJoCo's own renderer, in OpenGL without a window: contexts that EGL makes on a device of its choice.
//!
//! OpenGL wants every context used from one thread, and worlds live on any. So contexts belong to threads of this
//! module, which draw what they are handed while the caller waits. Hardware is preferred; Mesa draws where there is none.
//! `MUJOCO_EGL_DEVICE_ID` chooses a device by its place, as it does for MuJoCo's Python packages.
#![allow(
    unsafe_code,
    reason = "EGL and OpenGL through pointers, and scenes lent to another thread while their owner waits"
)]

mod context;
mod library;

use super::{Picture, Renderer, Scene};
use context::Contexts;
use library::{Display, Library};
use std::collections::VecDeque;
use std::sync::mpsc::{self, Sender};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use swm_core::{Error, Result};

/// The most threads that draw: each holds contexts, and with them memory of the device.
const MOST_THREADS: usize = 8;

/// As many suffice to keep a graphics card busy.
const HARDWARE_THREADS: usize = 4;

/// Whether there is a graphics card that can draw. EGL is opened only where the system knows a card: without one it would
/// load Mesa with its compiler, whose symbols collide with those that PyTorch's Triton brings into the same process.
pub(crate) fn hardware() -> bool {
    let is_card = |name: &str| name == "dri" || name == "dxg" || name.starts_with("nvidia");
    let devices = std::fs::read_dir("/dev").into_iter().flatten().flatten();
    let known = devices.filter_map(|device| device.file_name().into_string().ok()).any(|name| is_card(&name));
    known && Library::open().and_then(|library| library.display()).is_ok_and(|display| display.hardware)
}

/// The renderer: a queue, and threads that draw from it.
pub(crate) struct Egl {
    name: String,
    queue: Arc<Queue>,
}

/// A picture that somebody waits for.
struct Job {
    scene: Scene<'static>,
    size: (usize, usize),
    picture: Picture<'static>,
    done: Arc<Done>,
}

// SAFETY: what a job points to is lent by a caller who waits until it is done, and touched by one thread in between.
unsafe impl Send for Job {}

/// Jobs in the order they came.
#[derive(Default)]
struct Queue {
    jobs: Mutex<VecDeque<Job>>,
    more: Condvar,
}

/// Where a caller waits.
#[derive(Default)]
struct Done {
    outcome: Mutex<Option<Result<()>>>,
    there: Condvar,
}

/// A lock that no panic of another thread spoils: what it guards is a queue of jobs, or one answer.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Egl {
    /// Finds a device and starts the threads.
    ///
    /// # Errors
    /// When EGL is not installed, or no device can draw.
    pub fn new() -> Result<Self> {
        crate::link::load()?;
        let library = Arc::new(Library::open()?);
        let display = library.display()?;
        let queue = Arc::new(Queue::default());
        let (answer, answers) = mpsc::channel();
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let threads = cores.min(if display.hardware { HARDWARE_THREADS } else { MOST_THREADS });
        for i in 0..threads {
            let (library, queue, answer) = (Arc::clone(&library), Arc::clone(&queue), answer.clone());
            std::thread::Builder::new()
                .name(format!("render-{i}"))
                .spawn(move || draw_forever(library, display, &queue, &answer))
                .map_err(|error| Error::external("starting a thread that draws", error))?;
        }
        drop(answer);
        // The first thread that can draw is enough; one that cannot is gone.
        let mut failure = None;
        for answer in answers {
            match answer {
                Ok(device) => return Ok(Self { name: format!("egl ({device})"), queue }),
                Err(error) => failure = Some(error),
            }
        }
        Err(failure.unwrap_or_else(|| Error::external("EGL", "no thread can draw")))
    }
}

impl Renderer for Egl {
    fn name(&self) -> &str {
        &self.name
    }

    fn draw(&self, scene: Scene<'_>, width: usize, height: usize, picture: Picture<'_>) -> Result<()> {
        thread_local! {
            /// Where this thread waits; kept, so that a picture costs no allocation.
            static DONE: Arc<Done> = Arc::default();
        }
        DONE.with(|done| {
            // SAFETY: the lifetimes are those of this call, and it ends after the job has ended.
            let (scene, picture) = unsafe {
                (
                    std::mem::transmute::<Scene<'_>, Scene<'static>>(scene),
                    std::mem::transmute::<Picture<'_>, Picture<'static>>(picture),
                )
            };
            lock(&self.queue.jobs).push_back(Job { scene, size: (width, height), picture, done: Arc::clone(done) });
            self.queue.more.notify_one();
            let mut outcome = lock(&done.outcome);
            loop {
                match outcome.take() {
                    Some(outcome) => return outcome,
                    None => outcome = done.there.wait(outcome).unwrap_or_else(PoisonError::into_inner),
                }
            }
        })
    }
}

/// The life of a thread that draws: it sees whether it can, and then does job after job.
fn draw_forever(library: Arc<Library>, display: Display, queue: &Queue, answer: &Sender<Result<String>>) {
    let device = match library.canvas(display) {
        Ok(canvas) => {
            let device = library.device();
            library.discard(&canvas);
            device
        }
        Err(error) => {
            // Nobody listens any more where another thread came first.
            let _unheard = answer.send(Err(error));
            return;
        }
    };
    let _unheard = answer.send(Ok(device));
    let mut contexts = Contexts::new(library, display);
    loop {
        let mut jobs = lock(&queue.jobs);
        let job = loop {
            match jobs.pop_front() {
                Some(job) => break job,
                None => jobs = queue.more.wait(jobs).unwrap_or_else(PoisonError::into_inner),
            }
        };
        drop(jobs);
        let Job { scene, size, picture, done } = job;
        // A panic here must not leave the caller waiting, nor end the thread.
        let drawn = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| contexts.draw(scene, size, picture)));
        let outcome = drawn.unwrap_or_else(|_| Err(Error::external("drawing a scene", "a defect of the renderer")));
        *lock(&done.outcome) = Some(outcome);
        done.there.notify_one();
    }
}
