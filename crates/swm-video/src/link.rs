//! FFmpeg's libraries, loaded when the first video is decoded or encoded.
//!
//! `ffmpeg-next` declares FFmpeg's functions as symbols for the linker. This module defines those that this crate reaches as
//! trampolines, so that a program starts without the more than a hundred libraries that a distribution's FFmpeg loads, and
//! where FFmpeg is not installed. A function that is missing in the list below is linked as usual, and brings all of these back.
#![allow(unsafe_code, reason = "foreign symbols and addresses of functions")]

use ffmpeg_next::ffi;
use libloading::os::unix::{Library, RTLD_LOCAL, RTLD_NOW};
use std::ffi::{CStr, CString, c_int};
use swm_core::{Error, Result};
use swm_dlopen::{Once, reason};

swm_dlopen::functions! { swm_video_table:
    av_codec_is_decoder av_codec_is_encoder av_dict_free av_dict_set av_frame_alloc av_frame_free av_frame_get_buffer av_free av_freep
    av_init_packet av_interleaved_write_frame av_log_set_level av_mallocz av_new_packet av_packet_rescale_ts av_packet_unref
    av_pix_fmt_desc_get av_strerror av_write_trailer avcodec_alloc_context3 avcodec_close avcodec_find_decoder
    avcodec_find_decoder_by_name avcodec_find_encoder_by_name avcodec_flush_buffers avcodec_free_context avcodec_open2
    avcodec_parameters_from_context avcodec_receive_frame avcodec_receive_packet avcodec_send_frame avcodec_send_packet
    avformat_alloc_output_context2 avformat_close_input avformat_free_context avformat_new_stream avformat_write_header
    avio_alloc_context avio_close avio_context_free avio_flush sws_freeContext sws_getContext sws_scale
}

/// The libraries with the major versions of this build, because other versions have other structures. Those after the second are
/// loaded by these two, which also find their functions.
const LIBRARIES: [(&str, c_int); 4] = [
    ("avformat", ffi::LIBAVFORMAT_VERSION_MAJOR),
    ("swscale", ffi::LIBSWSCALE_VERSION_MAJOR),
    ("avcodec", ffi::LIBAVCODEC_VERSION_MAJOR),
    ("avutil", ffi::LIBAVUTIL_VERSION_MAJOR),
];

/// Loads FFmpeg's libraries on the first call; later calls do nothing. FFmpeg's functions may be called afterwards. FFmpeg logs
/// nothing to standard error, because failures become errors.
///
/// # Errors
/// When FFmpeg is not installed in the version that this program was built with.
pub fn load() -> Result<()> {
    static LOADED: Once = Once::new();
    LOADED.run(|| {
        open()?;
        // Initialisation only registers error messages and cannot fail.
        let _ = ffmpeg_next::init();
        ffmpeg_next::log::set_level(ffmpeg_next::log::Level::Quiet);
        Ok(())
    })
}

fn open() -> Result<()> {
    // The portable wheel is linked with its own FFmpeg, whose files have other names.
    if linked(c"avformat_version").is_some() && linked(c"swscale_version").is_some() {
        // SAFETY: the libraries have the versions whose functions `ffmpeg-next` declares, and `load` excludes other calls.
        return unsafe { fill(|name| expected(name, linked(name))) };
    }
    let libraries = [open_library(LIBRARIES[0])?, open_library(LIBRARIES[1])?];
    let find = |name: &CStr| {
        // SAFETY: only the address is taken.
        let address =
            |library: &Library| unsafe { library.get::<*const ()>(name.to_bytes_with_nul()) }.ok().map(|at| *at);
        expected(name, libraries.iter().find_map(address))
    };
    // SAFETY: as above.
    unsafe { fill(find)? };
    // Unloading would invalidate the addresses in the table.
    std::mem::forget(libraries);
    Ok(())
}

/// Functions that later versions lack. Programs that are built for these do not call them.
const REMOVED: [&CStr; 2] = [c"av_init_packet", c"avcodec_close"];

/// Checks that a function has an address, unless it is one of [`REMOVED`].
fn expected(name: &CStr, address: Option<*const ()>) -> Result<Option<*const ()>> {
    if address.is_none() && !REMOVED.contains(&name) {
        let problem =
            format!("they lack the function {}; install FFmpeg's libraries of this version", name.to_string_lossy());
        return Err(Error::external("loading FFmpeg's libraries for a video", problem));
    }
    Ok(address)
}

/// Returns the address of a function in libraries that this module of the process is linked with, of the right versions.
fn linked(name: &CStr) -> Option<*const ()> {
    LIBRARIES.iter().find_map(|(library, version)| {
        let version = CString::new(format!("LIB{}_{version}", library.to_uppercase())).ok()?;
        // SAFETY: both are zero-terminated, and the handle asks for the default order of search.
        let address = unsafe { libc::dlvsym(libc::RTLD_DEFAULT, name.as_ptr(), version.as_ptr()) };
        (!address.is_null()).then(|| address.cast_const().cast())
    })
}

fn open_library((library, version): (&str, c_int)) -> Result<Library> {
    let file = format!("lib{library}.so.{version}");
    // SAFETY: FFmpeg's libraries have no initialisers with side effects; where they are found is up to the user's system.
    unsafe { Library::open(Some(&file), RTLD_NOW | RTLD_LOCAL) }.map_err(|error| {
        let problem = reason(&error);
        let fix = advice(&problem);
        Error::external(format!("loading {file} for a video"), format!("{problem}; {fix}"))
    })
}

/// What to do about a library that cannot be loaded. One that is there may lack file handles or memory.
fn advice(problem: &str) -> &'static str {
    match problem {
        _ if problem.contains("Too many open files") => "raise the limit of open files",
        _ if problem.contains("Cannot allocate memory") => "raise the limit of memory",
        _ => "install FFmpeg's libraries of this version",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn missing_library_is_an_error_that_names_it() {
        let error = open_library(("swm-missing", 1)).err().map(|error| error.to_string()).unwrap_or_default();
        for part in ["libswm-missing.so.1 for a video", "No such file", "install FFmpeg's libraries"] {
            assert!(error.contains(part), "{error}");
        }
        assert_eq!(advice("libx.so: Too many open files"), "raise the limit of open files");
        assert_eq!(advice("libx.so: Cannot allocate memory"), "raise the limit of memory");
    }

    #[test]
    fn library_without_a_function_is_an_error_that_names_it() {
        let error = expected(c"sws_scale", None).err().map(|error| error.to_string()).unwrap_or_default();
        assert!(error.contains("sws_scale"), "{error}");
        assert!(expected(c"avcodec_close", None).is_ok());
    }

    /// Frames are decoded and encoded in the other tests of this crate; this one finds what the list lacks.
    #[test]
    fn program_is_not_linked_with_ffmpeg() {
        for name in [c"avformat_version", c"swscale_version", c"avcodec_version", c"avutil_version"] {
            assert!(linked(name).is_none(), "{name:?}: a function of this library is missing in the list");
        }
        load().expect("FFmpeg");
        let loaded = std::fs::read_to_string("/proc/self/maps").expect("the mapped files");
        assert!(loaded.contains("libavformat.so") && loaded.contains("libswscale.so"));
    }
}
