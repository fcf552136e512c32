//! A lock that no fork of the process interrupts: a thread that the forked process lacks would hold it there for ever, and leave the
//! dynamic linker in the middle of its work.
#![allow(unsafe_code, reason = "the C library calls functions before and after a fork")]

use std::cell::UnsafeCell;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

static LOCK: Mutex<()> = Mutex::new(());

/// Waits for the lock.
pub fn lock() -> MutexGuard<'static, ()> {
    static REGISTERED: AtomicBool = AtomicBool::new(false);
    if !REGISTERED.swap(true, Ordering::Relaxed) {
        // SAFETY: the functions take no arguments, do not unwind, and stay loaded as long as the process runs. Without memory for
        // them, forks do not wait, as it would be without this module.
        unsafe { libc::pthread_atfork(Some(before), Some(after), Some(after)) };
    }
    take()
}

fn take() -> MutexGuard<'static, ()> {
    LOCK.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The guard of the thread that forks.
struct Held(UnsafeCell<Option<MutexGuard<'static, ()>>>);

// SAFETY: only the thread that holds the lock uses the value.
unsafe impl Sync for Held {}

static HELD: Held = Held(UnsafeCell::new(None));

/// Takes the lock, in the thread that is about to fork.
unsafe extern "C" fn before() {
    let guard = take();
    // SAFETY: this thread holds the lock.
    unsafe { *HELD.0.get() = Some(guard) };
}

/// Returns the lock, in the same thread, of which the forked process has a copy.
unsafe extern "C" fn after() {
    // SAFETY: this thread holds the lock since `before`.
    drop(unsafe { (*HELD.0.get()).take() });
}

#[cfg(test)]
mod tests {
    use super::{lock, take};
    use std::sync::mpsc::channel;
    use std::time::Duration;

    #[test]
    fn forked_processes_can_take_the_lock_that_another_thread_held() {
        let (taken, wait) = channel();
        let other = std::thread::spawn(move || {
            let guard = lock();
            taken.send(()).expect("the receiver waits");
            std::thread::sleep(Duration::from_millis(100));
            drop(guard);
        });
        wait.recv().expect("the thread has the lock");
        // SAFETY: the child calls only functions that take and return the lock, and then ends.
        let child = unsafe { libc::fork() };
        if child == 0 {
            // SAFETY: ends the child after five seconds if the lock is not free.
            unsafe { libc::alarm(5) };
            drop(take());
            // SAFETY: ends the process.
            unsafe { libc::_exit(7) };
        }
        other.join().expect("the thread ends");
        let mut status = 0;
        // SAFETY: waits for the child.
        assert_eq!(unsafe { libc::waitpid(child, &raw mut status, 0) }, child);
        assert!(libc::WIFEXITED(status) && libc::WEXITSTATUS(status) == 7, "{status}");
        drop(take());
    }
}
