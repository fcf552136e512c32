//! [`guarded`]: calls of libraries that panic when a file is damaged.

use crate::Error;
use std::cell::Cell;
use std::panic::{AssertUnwindSafe, PanicHookInfo, catch_unwind, set_hook, take_hook};
use std::sync::Once;

thread_local! {
    /// Whether this thread is in a guarded call.
    static GUARDED: Cell<bool> = const { Cell::new(false) };
}

/// Calls `code`. A panic becomes an error with its text, and is not printed: for the user it means that a file is damaged.
///
/// # Errors
/// The text of the panic.
pub fn guarded<T>(code: impl FnOnce() -> T) -> Result<T, String> {
    static QUIET: Once = Once::new();
    QUIET.call_once(|| {
        let print = take_hook();
        set_hook(Box::new(move |panic: &PanicHookInfo<'_>| {
            if !GUARDED.get() {
                print(panic);
            }
        }));
    });
    let outer = GUARDED.replace(true);
    let result = catch_unwind(AssertUnwindSafe(code));
    GUARDED.set(outer);
    result.map_err(|panic| Error::panicked("the library panicked", &*panic).to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn panic_becomes_an_error() {
        assert_eq!(guarded(|| 3), Ok(3));
        let numbers: Vec<u8> = vec![];
        let error = guarded(|| numbers[std::hint::black_box(4)]).expect_err("an index out of bounds");
        assert!(error.contains("the library panicked") && error.contains("index is 4"), "{error}");
        assert!(!GUARDED.get(), "later panics are printed");
    }
}
