//! The `swm` command.

mod allocator;
mod open_output;

use std::io::Write as _;

#[global_allocator]
static ALLOCATOR: allocator::Allocator = allocator::Allocator;

/// The stack that a command needs, in bytes: what Linux gives a main thread by default.
const STACK: usize = 8 << 20;

fn main() -> std::process::ExitCode {
    if !open_output::is_open() {
        let error = b"error: standard output is closed; redirect it to a file, or to /dev/null to drop the output\n";
        std::io::stderr().write_all(error).ok();
        return std::process::ExitCode::FAILURE;
    }
    allocator::keep_freed_memory();
    let run = || swm::cli::run(std::env::args_os());
    if main_stack() >= STACK as u64 {
        return run().into();
    }
    match std::thread::Builder::new().name("main".to_owned()).stack_size(STACK).spawn(run) {
        // A panic that nothing caught has printed its message.
        Ok(thread) => thread.join().map_or(std::process::ExitCode::FAILURE, Into::into),
        // The system has no more threads: commands that need none still run.
        Err(_) => run().into(),
    }
}

/// The bytes to which the stack of the main thread may grow (`ulimit -s`).
#[cfg(unix)]
#[allow(unsafe_code, reason = "the limits of a process are a function of the C library")]
fn main_stack() -> u64 {
    let mut limit = libc::rlimit { rlim_cur: 0, rlim_max: 0 };
    // SAFETY: the structure lives during the call, which only writes to it.
    match unsafe { libc::getrlimit(libc::RLIMIT_STACK, &raw mut limit) } {
        0 => limit.rlim_cur,
        _ => 0,
    }
}

/// The bytes to which the stack of the main thread may grow; unknown here.
#[cfg(not(unix))]
fn main_stack() -> u64 {
    0
}
