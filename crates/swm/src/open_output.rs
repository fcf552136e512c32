//! [`is_open`]: whether the program was started with an open standard output.
//!
//! Before `main`, the standard library replaces closed standard streams by `/dev/null`, so that `swm envs >&-` would
//! succeed and lose its output. The check therefore runs earlier, as a function that the loader calls.

use std::sync::atomic::{AtomicBool, Ordering};

static IS_OPEN: AtomicBool = AtomicBool::new(true);

/// Whether standard output was open when the program was started; always true on systems other than Linux.
pub fn is_open() -> bool {
    IS_OPEN.load(Ordering::Relaxed)
}

#[cfg(target_os = "linux")]
#[used]
#[allow(unsafe_code, reason = "a section of the executable is part of its interface to the loader")]
// SAFETY: the loader calls every entry of this section before `main`, and functions of this type may ignore arguments.
// `check` uses nothing that the standard library initialises later.
#[unsafe(link_section = ".init_array")]
static CHECK: extern "C" fn() = check;

#[cfg(target_os = "linux")]
#[allow(unsafe_code, reason = "a function of the C library that needs no standard library")]
extern "C" fn check() {
    // SAFETY: `F_GETFD` takes any descriptor and only reads its flags.
    let flags = unsafe { libc::fcntl(libc::STDOUT_FILENO, libc::F_GETFD) };
    IS_OPEN.store(flags != -1, Ordering::Relaxed);
}
