//! MuJoCo's library, loaded when the first world needs it.
//!
//! `mujoco-rs` declares MuJoCo's functions as symbols that somebody links with. Here they are trampolines: one jump each,
//! through a table that [`load`] fills from `libmujoco` of the installed assets. So one program starts, and everything
//! else works, where MuJoCo is absent. A jump before loading ends in [`absent`], which says so.
//!
//! It also decides what MuJoCo does with its errors. By itself it writes them to `MUJOCO_LOG.TXT` of the working
//! directory and exits the process. Here warnings go to the log of the program, and an error inside [`guard`] unwinds
//! to it and becomes an [`Error`].
#![allow(unsafe_code, reason = "foreign symbols, a table of addresses, and a handler that MuJoCo calls")]

mod symbols;

use crate::assets;
use libloading::os::unix::{Library, RTLD_LOCAL, RTLD_NOW};
use mujoco_rs::mujoco_c::mjtLogLevel;
use std::cell::Cell;
use std::ffi::{CStr, c_char, c_int};
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::OnceLock;
use swm_core::{Error, Result};

/// The version of MuJoCo that is loaded, no other: `mujoco-rs` describes the structures of this one.
pub const VERSION: &str = "3.17.0";

macro_rules! trampolines {
    ($($name:ident)*) => {
        /// The names, in the order of the table.
        const NAMES: &[&CStr] = &[$(
            match CStr::from_bytes_with_nul(concat!(stringify!($name), "\0").as_bytes()) {
                Ok(name) => name,
                Err(_) => panic!("a name holds no zero"),
            }
        ),*];

        // Each function jumps to the address in its place of the table; places follow one another as the names do.
        std::arch::global_asm!(
            ".pushsection .data.swm_mujoco_table,\"aw\",%progbits",
            ".balign 8",
            ".hidden swm_mujoco_table",
            ".globl swm_mujoco_table",
            "swm_mujoco_table:",
            ".popsection",
            $(
                ".pushsection .data.swm_mujoco_table,\"aw\",%progbits",
                "22:",
                ".quad {absent}",
                ".popsection",
                ".pushsection .text.swm_mujoco,\"ax\",%progbits",
                concat!(".hidden ", stringify!($name)),
                concat!(".globl ", stringify!($name)),
                concat!(".type ", stringify!($name), ",%function"),
                concat!(stringify!($name), ":"),
                jump!(),
                ".popsection",
            )*
            absent = sym absent,
        );
    };
}

#[cfg(target_arch = "x86_64")]
macro_rules! jump {
    () => {
        "jmp qword ptr [rip + 22b]"
    };
}

#[cfg(target_arch = "aarch64")]
macro_rules! jump {
    () => {
        "adrp x16, 22b\nldr x16, [x16, :lo12:22b]\nbr x16"
    };
}

symbols::each_symbol!(trampolines);

unsafe extern "C" {
    /// Addresses of the functions of [`NAMES`]; written once, by [`open`].
    static mut swm_mujoco_table: [*const (); NAMES.len()];
}

/// Where a trampoline leads before [`load`]: a defect of this crate, which must load before it calls.
extern "C" fn absent() -> ! {
    tracing::error!("a MuJoCo function was called before MuJoCo was loaded");
    std::process::abort();
}

/// Loads MuJoCo, once; afterwards its functions may be called.
///
/// # Errors
/// When it is not installed (naming the command that brings it), or cannot be loaded.
pub fn load() -> Result<()> {
    static LOADED: OnceLock<()> = OnceLock::new();
    if LOADED.get().is_some() {
        return Ok(());
    }
    // Whoever comes second waits for the first, and a failure may be mended and tried again.
    static TURN: std::sync::Mutex<()> = std::sync::Mutex::new(());
    let _turn = TURN.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
    if LOADED.get().is_none() {
        open()?;
        LOADED.get_or_init(|| ());
    }
    Ok(())
}

/// Opens the library, fills the table, and takes over MuJoCo's messages.
fn open() -> Result<()> {
    let path = assets::path("mujoco")?.join(format!("mujoco/libmujoco.so.{VERSION}"));
    let failed = |error: libloading::Error| Error::external(format!("loading {}", path.display()), error);
    // SAFETY: MuJoCo's library runs no code of consequence when it is opened; its SHA-256 was checked when it was installed.
    let library = unsafe { Library::open(Some(&path), RTLD_NOW | RTLD_LOCAL) }.map_err(failed)?;
    let mut table = [std::ptr::null(); NAMES.len()];
    for (place, name) in table.iter_mut().zip(NAMES) {
        // SAFETY: only the address is taken; `mujoco-rs` declares the signature it is called with.
        *place = *unsafe { library.get::<*const ()>(name.to_bytes_with_nul()) }.map_err(failed)?;
    }
    // The addresses stay valid until the process ends.
    std::mem::forget(library);
    // SAFETY: `load` lets one thread in, and lets none call a function before it is done.
    unsafe {
        (&raw mut swm_mujoco_table).write(table);
        mju_setLogHandler(Some(on_message));
    }
    Ok(())
}

thread_local! {
    /// Whether this thread is inside [`guard`].
    static GUARDED: Cell<bool> = const { Cell::new(false) };
}

/// What unwinds from MuJoCo's error to [`guard`].
struct Fault(String);

/// Calls into MuJoCo. What MuJoCo calls an error, and would end the process with, is returned.
///
/// Only functions declared `extern "C-unwind"` may be called inside (`crate::ffi`), and whatever they worked on is in
/// an undefined state after an error: a world resets it.
///
/// # Errors
/// MuJoCo's own, in its words.
pub(crate) fn guard<T>(doing: &str, call: impl FnOnce() -> T) -> Result<T> {
    let before = GUARDED.replace(true);
    let outcome = catch_unwind(AssertUnwindSafe(call));
    GUARDED.set(before);
    outcome.map_err(|payload| match payload.downcast::<Fault>() {
        Ok(fault) => Error::external(format!("MuJoCo, {doing}"), fault.0),
        Err(other) => resume_unwind(other),
    })
}

/// The head of MuJoCo's `mjLogMessage`.
#[repr(C)]
struct Message {
    level: c_int,
    topic: c_int,
    subject: [c_char; 1024],
    body: *const c_char,
}

type Handler = unsafe extern "C-unwind" fn(*const Message);

unsafe extern "C" {
    /// As `mujoco-rs` declares it, but for a handler that may unwind.
    fn mju_setLogHandler(handler: Option<Handler>) -> Option<Handler>;
}

/// Receives every message of MuJoCo.
unsafe extern "C-unwind" fn on_message(message: *const Message) {
    // SAFETY: MuJoCo passes a valid message for the time of the call.
    let message = unsafe { &*message };
    // SAFETY: the subject is a buffer that ends in zero; the body is null or ends in zero.
    let text = unsafe {
        let subject = CStr::from_ptr(message.subject.as_ptr()).to_string_lossy();
        match message.body.is_null() {
            true => subject.into_owned(),
            false => format!("{subject}\n{}", CStr::from_ptr(message.body).to_string_lossy()),
        }
    };
    if message.level == mjtLogLevel::mjLOG_ERROR as i32 {
        if GUARDED.get() {
            // Not a panic: no hook prints it, and `guard` waits for it.
            resume_unwind(Box::new(Fault(text)));
        }
        tracing::error!("MuJoCo: {text}");
    } else if message.level == mjtLogLevel::mjLOG_WARNING as i32 {
        tracing::debug!("MuJoCo: {text}");
    } else {
        tracing::trace!("MuJoCo: {text}");
    }
}
