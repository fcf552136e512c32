//! Ctrl-C and other requests to end: the first asks the run to stop at its next safe point, the second ends the program.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};

/// Ctrl-C, a request to terminate, and a closed terminal.
const SIGNALS: [libc::c_int; 3] = [libc::SIGINT, libc::SIGTERM, libc::SIGHUP];

static INTERRUPT: OnceLock<Arc<AtomicBool>> = OnceLock::new();

/// Handles [`SIGNALS`] from now on. Returns the flag that the first of them sets; the second ends the program with the
/// exit code 128 plus its number. Signals that the parent process ignores, as `nohup` does, stay ignored.
#[allow(unsafe_code, reason = "handlers of signals are functions of the C library")]
pub fn interrupt_flag() -> std::io::Result<Arc<AtomicBool>> {
    let flag = INTERRUPT.get_or_init(Arc::default);
    flag.store(false, Ordering::SeqCst);
    for signal in SIGNALS {
        // SAFETY: all fields of `sigaction` are integers and pointers, for which zero is valid, and both structures live
        // during the calls. `handle` only calls functions that may be called in a handler.
        let handled = unsafe {
            let (mut action, mut old): (libc::sigaction, libc::sigaction) = std::mem::zeroed();
            let found = libc::sigaction(signal, std::ptr::null(), &raw mut old);
            if found == 0 && old.sa_sigaction == libc::SIG_IGN {
                continue;
            }
            let handler: extern "C" fn(libc::c_int) = handle;
            action.sa_sigaction = handler as libc::sighandler_t;
            action.sa_flags = libc::SA_RESTART;
            libc::sigaction(signal, &raw const action, std::ptr::null_mut())
        };
        if handled != 0 {
            return Err(std::io::Error::last_os_error());
        }
    }
    Ok(Arc::clone(flag))
}

/// Ignores the signal of a file that grows beyond the limit of the process (`ulimit -f`): writing fails with an error then,
/// which says what is kept.
#[allow(unsafe_code, reason = "ignoring a signal is a function of the C library")]
pub fn report_large_files() {
    // SAFETY: `SIG_IGN` runs no code of ours.
    unsafe { libc::signal(libc::SIGXFSZ, libc::SIG_IGN) };
}

/// Lets a program that is started react to Ctrl-C, also if this one ignores it, as in the background of a script.
#[allow(unsafe_code, reason = "the reaction to a signal is set by a function of the C library")]
pub fn react_to_interrupts(command: &mut std::process::Command) {
    use std::os::unix::process::CommandExt as _;
    // SAFETY: `signal` may be called between fork and exec, and `SIG_DFL` runs no code of ours.
    unsafe {
        command.pre_exec(|| {
            libc::signal(libc::SIGINT, libc::SIG_DFL);
            Ok(())
        });
    }
}

/// The handler of [`SIGNALS`]. It works without memory and without locks, because it interrupts any code.
#[allow(unsafe_code, reason = "functions of the C library that a handler may call")]
extern "C" fn handle(signal: libc::c_int) {
    const MESSAGE: &[u8] = b"\nstopping at the next safe point; press Ctrl-C again to stop at once\n";
    let stopping = INTERRUPT.get().is_some_and(|flag| flag.swap(true, Ordering::SeqCst));
    // SAFETY: the pointer and the length are those of a constant, and `_exit` takes any status.
    unsafe {
        if stopping {
            libc::_exit(128 + signal);
        }
        libc::write(libc::STDERR_FILENO, MESSAGE.as_ptr().cast(), MESSAGE.len());
    }
}
