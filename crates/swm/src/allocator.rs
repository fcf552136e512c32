//! [`Allocator`]: the system's allocator, which ends the program with a message when memory runs out.
//!
//! Without it, the standard library prints a backtrace under a lock, whose own allocations fail and wait for the same
//! lock, so the program hangs or aborts.

use std::alloc::{GlobalAlloc, Layout, System};

/// Larger requests return an error to callers that handle it (`try_reserve`); a file may have decided their size.
const FALLIBLE: usize = 256 << 20;

/// The allocator of the program.
pub struct Allocator;

#[allow(unsafe_code, reason = "an allocator is an unsafe trait")]
// SAFETY: every method passes its arguments to the system's allocator, whose contract is the same, and returns the
// result or does not return.
unsafe impl GlobalAlloc for Allocator {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        // SAFETY: the caller keeps the contract of `GlobalAlloc::alloc`.
        checked(unsafe { System.alloc(layout) }, layout.size())
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        // SAFETY: the caller keeps the contract of `GlobalAlloc::alloc_zeroed`.
        checked(unsafe { System.alloc_zeroed(layout) }, layout.size())
    }

    unsafe fn realloc(&self, memory: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        // SAFETY: the caller keeps the contract of `GlobalAlloc::realloc`.
        checked(unsafe { System.realloc(memory, layout, size) }, size)
    }

    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        // SAFETY: the caller keeps the contract of `GlobalAlloc::dealloc`.
        unsafe { System.dealloc(memory, layout) }
    }
}

/// Makes the system's allocator keep freed memory for later requests. It would return what a training step frees to the system, and get
/// it back page by page in the next step, which takes a tenth of the time of SAC's and TD-MPC2's steps.
pub fn keep_freed_memory() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    #[allow(unsafe_code, reason = "the settings of the allocator are a function of the C library")]
    // SAFETY: the function takes any numbers, and no other thread runs yet.
    unsafe {
        libc::mallopt(libc::M_TRIM_THRESHOLD, 256 << 20);
        libc::mallopt(libc::M_MMAP_THRESHOLD, 32 << 20);
    }
}

/// Returns allocated memory; ends the program if there is none and the request is small.
#[inline]
fn checked(memory: *mut u8, size: usize) -> *mut u8 {
    if memory.is_null() && size < FALLIBLE {
        end();
    }
    memory
}

/// Ends the program without allocating, locking, or running destructors. Committed data is kept, as after a kill.
#[cold]
#[allow(unsafe_code, reason = "functions of the C library that work without memory")]
fn end() -> ! {
    const MESSAGE: &[u8] = b"error: out of memory; choose fewer --envs or --threads, smaller images or batches, or a \
        machine with more memory; finished work is saved\n";
    // SAFETY: the pointer and the length are those of a constant, and `_exit` takes any status.
    unsafe {
        libc::write(libc::STDERR_FILENO, MESSAGE.as_ptr().cast(), MESSAGE.len());
        libc::_exit(1)
    }
}
