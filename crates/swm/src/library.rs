//! [`path`]: the file that contains this library.

use std::ffi::{CStr, OsStr};
use std::mem::MaybeUninit;
use std::os::unix::ffi::OsStrExt as _;
use std::path::PathBuf;

/// Returns the path of the shared library that contains this code, such as the engine of the Python package, or the
/// program's name as it was called.
#[allow(unsafe_code, reason = "the dynamic linker is called through C")]
pub fn path() -> Option<PathBuf> {
    let mut info = MaybeUninit::<libc::Dl_info>::zeroed();
    let address: *const libc::c_void = (path as fn() -> Option<PathBuf> as *const ()).cast();
    // SAFETY: `dladdr` reads no memory at the address, and writes a whole `Dl_info` if it returns another value than 0.
    let name = unsafe {
        if libc::dladdr(address, info.as_mut_ptr()) == 0 {
            return None;
        }
        info.assume_init().dli_fname
    };
    if name.is_null() {
        return None;
    }
    // SAFETY: the name is a string of the dynamic linker, which keeps it while the library is loaded, and this code is in
    // the library.
    let name = unsafe { CStr::from_ptr(name) };
    Some(PathBuf::from(OsStr::from_bytes(name.to_bytes())))
}

#[cfg(test)]
mod tests {
    #[test]
    fn path_is_the_file_of_this_program() {
        let path = super::path().expect("a path").canonicalize().expect("an existing file");
        assert_eq!(path, std::env::current_exe().expect("a program").canonicalize().expect("an existing file"));
    }
}
