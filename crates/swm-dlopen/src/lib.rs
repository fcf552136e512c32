//! C libraries that are loaded at first use, although their bindings declare functions for the linker.
//!
//! [`functions!`] defines such functions as trampolines: one jump each, through a table of addresses that is filled when the
//! library is loaded. A program therefore starts without the library, and as fast as if it did not use it. [`Once`] loads
//! once, and again after a failure.

mod fork;

use std::error::Error;
use std::ffi::CStr;
use std::sync::OnceLock;

/// Defines functions as trampolines: `functions! { TABLE: NAME … }`.
///
/// In the module that calls it, this defines the constant `NAMES`, and `unsafe fn fill(find)`, which asks `find` for the address of
/// each name. It must run before any of the functions is called, and while none is. Functions that `find` does not find stay as
/// they are: a call of them ends the program. `TABLE` is a symbol that no other library of the program has.
#[macro_export]
macro_rules! functions {
    ($table:ident: $($name:ident)*) => {
        /// The names of the functions, in the order of the table.
        const NAMES: &[&::std::ffi::CStr] = &[$($crate::name(concat!(stringify!($name), "\0"))),*];

        // Each function jumps to the address in its entry of the table; entries are in the order of the names.
        ::std::arch::global_asm!(
            concat!(".pushsection .data.", stringify!($table), ",\"aw\",%progbits"),
            ".balign 8",
            concat!(".hidden ", stringify!($table)),
            concat!(".globl ", stringify!($table)),
            concat!(stringify!($table), ":"),
            ".popsection",
            $(
                concat!(".pushsection .data.", stringify!($table), ",\"aw\",%progbits"),
                "22:",
                ".quad {not_loaded}",
                ".popsection",
                concat!(".pushsection .text.", stringify!($table), ",\"ax\",%progbits"),
                concat!(".hidden ", stringify!($name)),
                concat!(".globl ", stringify!($name)),
                concat!(".type ", stringify!($name), ",%function"),
                concat!(stringify!($name), ":"),
                $crate::jump!(),
                ".popsection",
            )*
            not_loaded = sym $crate::not_loaded,
        );

        unsafe extern "C" {
            /// Addresses of the functions of [`NAMES`].
            static mut $table: [*const (); NAMES.len()];
        }

        /// Fills the table with the addresses that `find` returns.
        ///
        /// # Safety
        /// Addresses must be those of functions with the signatures that the bindings declare, and stay valid. No function of the
        /// table may be called meanwhile, nor the table be filled by another thread.
        unsafe fn fill<E>(
            mut find: impl FnMut(&'static ::std::ffi::CStr) -> ::std::result::Result<Option<*const ()>, E>,
        ) -> ::std::result::Result<(), E> {
            for (i, name) in NAMES.iter().enumerate() {
                if let Some(address) = find(name)? {
                    // SAFETY: the table has an entry for each name, and the caller excludes other uses of it.
                    unsafe { (&raw mut $table).cast::<*const ()>().add(i).write(address) };
                }
            }
            Ok(())
        }
    };
}

/// A jump to the address in the local label 22.
#[doc(hidden)]
#[macro_export]
#[cfg(target_arch = "x86_64")]
macro_rules! jump {
    () => {
        "jmp qword ptr [rip + 22b]"
    };
}

/// A jump to the address in the local label 22.
#[doc(hidden)]
#[macro_export]
#[cfg(target_arch = "aarch64")]
macro_rules! jump {
    () => {
        "adrp x16, 22b\nldr x16, [x16, :lo12:22b]\nbr x16"
    };
}

/// The name of a function, which ends with a zero byte.
#[doc(hidden)]
pub const fn name(with_zero: &'static str) -> &'static CStr {
    match CStr::from_bytes_with_nul(with_zero.as_bytes()) {
        Ok(name) => name,
        Err(_) => panic!("the name of a function must not contain a zero byte"),
    }
}

/// The target of every trampoline before its table is filled. Reaching it is a bug of the crate that defines the trampolines, which
/// must load the library first.
#[doc(hidden)]
pub extern "C" fn not_loaded() -> ! {
    // A panic ends the program, because C functions do not unwind.
    panic!("a function of a C library was called before the library was loaded; please report this as a bug");
}

/// Returns what the system says of a library that cannot be loaded, which is the last cause of `error`.
pub fn reason(error: &dyn Error) -> String {
    let mut last = error;
    while let Some(cause) = last.source() {
        last = cause;
    }
    last.to_string()
}

/// Something that is done once, such as the loading of a library. After a failure, the next call tries again.
#[derive(Debug, Default)]
pub struct Once(OnceLock<()>);

impl Once {
    /// Returns a value that has done nothing.
    pub const fn new() -> Self {
        Self(OnceLock::new())
    }

    /// Calls `act`, unless it was called before with success. Concurrent callers wait, those of other values too, and so do forks of
    /// the process.
    ///
    /// # Errors
    /// Those of `act`.
    pub fn run<E>(&self, act: impl FnOnce() -> Result<(), E>) -> Result<(), E> {
        if self.0.get().is_some() {
            return Ok(());
        }
        let _lock = fork::lock();
        if self.0.get().is_none() {
            act()?;
            self.0.get_or_init(|| ());
        }
        Ok(())
    }
}

#[cfg(test)]
#[allow(unsafe_code, reason = "the functions are foreign")]
mod tests {
    use super::{Once, reason};

    functions! { swm_dlopen_test_table: swm_dlopen_first swm_dlopen_second swm_dlopen_missing }

    unsafe extern "C" {
        fn swm_dlopen_first(a: u64, b: f64) -> f64;
        fn swm_dlopen_second(a: u64) -> u64;
    }

    extern "C" fn sum(a: u64, b: f64) -> f64 {
        a as f64 + b
    }

    extern "C" fn next(a: u64) -> u64 {
        a + 1
    }

    #[test]
    fn functions_jump_to_the_addresses_that_were_found() {
        let find = |name: &std::ffi::CStr| match name.to_bytes() {
            b"swm_dlopen_first" => Ok(Some(sum as *const ())),
            b"swm_dlopen_second" => Ok(Some(next as *const ())),
            _ => Ok::<_, ()>(None),
        };
        // SAFETY: the addresses are those of functions with the declared signatures; only this test uses the table.
        let results = unsafe {
            fill(find).expect("nothing fails");
            (swm_dlopen_first(2, 0.5), swm_dlopen_second(41))
        };
        assert_eq!(results, (2.5, 42));
    }

    #[test]
    fn reason_is_what_the_system_says() {
        let cause = std::io::Error::other("libx.so.1: cannot open shared object file");
        let error = std::io::Error::other(std::io::Error::other(cause));
        assert_eq!(reason(&error), "libx.so.1: cannot open shared object file");
    }

    #[test]
    fn failures_are_tried_again_and_successes_are_not() {
        let once = Once::new();
        assert_eq!(once.run(|| Err("first")), Err("first"));
        assert_eq!(once.run(|| Ok::<_, &str>(())), Ok(()));
        assert_eq!(once.run(|| Err("third")), Ok(()));
    }
}
