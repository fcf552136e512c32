//! MuJoCo's library, loaded when the first environment needs it.
//!
//! `mujoco-rs` declares MuJoCo's functions as symbols for the linker. This module defines them as trampolines to `libmujoco` of the
//! installed assets, which [`load`] loads. A program with this crate therefore starts where MuJoCo is not installed, and only
//! the environments of this crate fail there.
//!
//! The module also replaces MuJoCo's error handling. By default MuJoCo writes errors to `MUJOCO_LOG.TXT` in the working
//! directory and exits the process. Here, messages go to the program's log, and an error inside [`guard`] unwinds to
//! `guard`, which returns an [`Error`].
#![allow(unsafe_code, reason = "foreign symbols, a table of addresses, and a handler that MuJoCo calls")]

mod symbols;

use crate::assets;
use libloading::os::unix::{Library, RTLD_LOCAL, RTLD_NOW};
use mujoco_rs::mujoco_c::mjtLogLevel;
use std::cell::Cell;
use std::ffi::{CStr, c_char, c_int};
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use swm_core::{Error, Result};
use swm_dlopen::{Once, reason};

/// The version of MuJoCo that is loaded. No other version works: `mujoco-rs` declares the structures of this version.
pub const VERSION: &str = "3.17.0";

macro_rules! trampolines {
    ($($name:ident)*) => {
        swm_dlopen::functions! { swm_mujoco_table: $($name)* }
    };
}

symbols::each_symbol!(trampolines);

/// Loads MuJoCo's library on the first call; later calls do nothing. MuJoCo's functions may be called afterwards.
///
/// # Errors
/// When MuJoCo is not installed (the error names the command to install it), or its library cannot be loaded.
pub fn load() -> Result<()> {
    static LOADED: Once = Once::new();
    LOADED.run(open)
}

/// Loads MuJoCo to compile a model, for which MuJoCo may take `bytes` of memory.
///
/// # Errors
/// As [`load`] and [`check_memory`].
pub(crate) fn load_to_compile(bytes: usize) -> Result<()> {
    load()?;
    check_memory("compiling a model", bytes)
}

/// Checks that the system has memory for what MuJoCo is about to do. Where an allocation of its own fails, MuJoCo ends the process.
/// Threads that ask at once may be told of the same memory.
///
/// # Errors
/// When the system refuses `bytes`.
pub(crate) fn check_memory(doing: &str, bytes: usize) -> Result<()> {
    let (access, kind) = (libc::PROT_READ | libc::PROT_WRITE, libc::MAP_PRIVATE | libc::MAP_ANONYMOUS);
    // SAFETY: a new mapping, at an address that the system chooses, overlaps nothing; it is removed below, and never used.
    let mapped = unsafe { libc::mmap(std::ptr::null_mut(), bytes, access, kind | libc::MAP_NORESERVE, -1, 0) };
    if mapped == libc::MAP_FAILED {
        let needed = bytes >> 20;
        let problem = format!("out of memory: MuJoCo may take {needed} MiB; raise the limit of memory (`ulimit -v`)");
        return Err(Error::external(doing, problem));
    }
    // SAFETY: the mapping has this address and length.
    unsafe { libc::munmap(mapped, bytes) };
    Ok(())
}

/// Opens the library, fills the table, and installs the log handler.
fn open() -> Result<()> {
    let path = assets::path("mujoco")?.join(format!("mujoco/libmujoco.so.{VERSION}"));
    let failed = |error: libloading::Error| Error::external(format!("loading {}", path.display()), reason(&error));
    // SAFETY: MuJoCo's library has no initialisers with side effects; its SHA-256 was checked at installation.
    let library = unsafe { Library::open(Some(&path), RTLD_NOW | RTLD_LOCAL) }.map_err(failed)?;
    // SAFETY: `mujoco-rs` declares the signatures of this version's functions. `load` calls this function under a lock, and no function
    // of the table is called before it returns.
    unsafe {
        fill(|name| library.get::<*const ()>(name.to_bytes_with_nul()).map(|address| Some(*address)).map_err(failed))?;
        mju_setLogHandler(Some(on_message));
    }
    // Unloading would invalidate the addresses in the table.
    std::mem::forget(library);
    Ok(())
}

thread_local! {
    /// Whether this thread is inside [`guard`].
    static GUARDED: Cell<bool> = const { Cell::new(false) };
}

/// The payload that unwinds from MuJoCo's log handler to [`guard`].
struct Fault(String);

/// Runs `call` and returns MuJoCo's error, which would otherwise end the process.
///
/// `call` may only use functions declared `extern "C-unwind"` (`crate::ffi`). After an error, the MuJoCo objects that
/// `call` used are in an undefined state: `Physics` resets its state, and the renderer drops its context.
///
/// # Errors
/// MuJoCo's error message.
pub(crate) fn guard<T>(doing: &str, call: impl FnOnce() -> T) -> Result<T> {
    let was_guarded = GUARDED.replace(true);
    let outcome = catch_unwind(AssertUnwindSafe(call));
    GUARDED.set(was_guarded);
    outcome.map_err(|payload| match payload.downcast::<Fault>() {
        Ok(fault) => Error::external(format!("MuJoCo failed while {doing}"), fault.0),
        Err(other) => resume_unwind(other),
    })
}

/// The first fields of MuJoCo's `mjLogMessage`.
#[repr(C)]
struct Message {
    level: c_int,
    topic: c_int,
    subject: [c_char; 1024],
    body: *const c_char,
}

type Handler = unsafe extern "C-unwind" fn(*const Message);

unsafe extern "C" {
    /// Sets MuJoCo's log handler. `mujoco-rs` declares the same function for handlers that may not unwind.
    fn mju_setLogHandler(handler: Option<Handler>) -> Option<Handler>;
}

/// The log handler, which MuJoCo calls with each of its messages.
unsafe extern "C-unwind" fn on_message(message: *const Message) {
    // SAFETY: MuJoCo passes a message that is valid during the call.
    let message = unsafe { &*message };
    // SAFETY: the subject is a zero-terminated buffer; the body is null or zero-terminated.
    let text = unsafe {
        let subject = CStr::from_ptr(message.subject.as_ptr()).to_string_lossy();
        match message.body.is_null() {
            true => subject.into_owned(),
            false => format!("{subject}\n{}", CStr::from_ptr(message.body).to_string_lossy()),
        }
    };
    if message.level == mjtLogLevel::mjLOG_ERROR as i32 {
        if GUARDED.get() {
            // `resume_unwind` runs no panic hook, so nothing is printed; `guard` catches the unwinding.
            resume_unwind(Box::new(Fault(text)));
        }
        tracing::error!("MuJoCo: {text}");
    } else if message.level == mjtLogLevel::mjLOG_WARNING as i32 {
        tracing::debug!("MuJoCo: {text}");
    } else {
        tracing::trace!("MuJoCo: {text}");
    }
}
