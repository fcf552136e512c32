//! EGL, loaded at the first rendering: devices, and OpenGL contexts without a window.
//!
//! Constants and signatures are those of the EGL 1.5 specification and its device and platform extensions.

use libloading::os::unix::{Library as SharedObject, RTLD_GLOBAL, RTLD_NOW};
use std::ffi::{CStr, c_char, c_int, c_void};
use swm_core::{Error, Result};
use swm_dlopen::reason;

type Pointer = *mut c_void;
type Bool = u32;

const TRUE: Bool = 1;
const NONE: c_int = 0x3038;
const EXTENSIONS: c_int = 0x3055;
const OPENGL_API: u32 = 0x30A2;
const PLATFORM_DEVICE: u32 = 0x313F;
const PLATFORM_SURFACELESS: u32 = 0x31DD;
/// 8 bits per colour channel and alpha, 24 bits of depth, 8 bits of stencil, pbuffer surfaces, OpenGL.
const CONFIG: [c_int; 17] =
    [0x3024, 8, 0x3023, 8, 0x3022, 8, 0x3021, 8, 0x3025, 24, 0x3026, 8, 0x3033, 0x0001, 0x3040, 0x0008, NONE];
const PBUFFER: [c_int; 5] = [0x3057, 1, 0x3056, 1, NONE];
const GL_RENDERER: u32 = 0x1F01;

/// The functions of EGL that this crate uses.
pub struct Library {
    get_proc_address: unsafe extern "C" fn(*const c_char) -> Pointer,
    get_display: unsafe extern "C" fn(Pointer) -> Pointer,
    initialize: unsafe extern "C" fn(Pointer, *mut c_int, *mut c_int) -> Bool,
    choose_config: unsafe extern "C" fn(Pointer, *const c_int, *mut Pointer, c_int, *mut c_int) -> Bool,
    bind_api: unsafe extern "C" fn(u32) -> Bool,
    create_context: unsafe extern "C" fn(Pointer, Pointer, Pointer, *const c_int) -> Pointer,
    create_pbuffer: unsafe extern "C" fn(Pointer, Pointer, *const c_int) -> Pointer,
    make_current: unsafe extern "C" fn(Pointer, Pointer, Pointer, Pointer) -> Bool,
    destroy_surface: unsafe extern "C" fn(Pointer, Pointer) -> Bool,
    destroy_context: unsafe extern "C" fn(Pointer, Pointer) -> Bool,
    get_error: unsafe extern "C" fn() -> c_int,
    /// Keeps the library loaded while its functions are used.
    _shared: SharedObject,
}

/// An EGL display.
#[derive(Clone, Copy)]
pub struct Display {
    pointer: Pointer,
    /// Whether EGL reports the device as a graphics card.
    pub hardware: bool,
}

// SAFETY: EGL allows a display to be used from any thread.
unsafe impl Send for Display {}

/// An OpenGL context with its state (lights, textures, shadow map). Belongs to one thread.
pub struct GlContext {
    display: Pointer,
    context: Pointer,
    /// A surface for older drivers, which require one; null otherwise.
    surface: Pointer,
}

impl Library {
    /// Loads EGL: the library that `SWM_EGL_LIBRARY` names, otherwise the system's. Its symbols become globally
    /// visible, because MuJoCo looks up OpenGL's functions through them.
    ///
    /// # Errors
    /// When the library is not installed.
    pub fn open() -> Result<Self> {
        let name = std::env::var("SWM_EGL_LIBRARY").unwrap_or_else(|_| "libEGL.so.1".to_owned());
        let failed = |error: libloading::Error| Error::external(format!("opening {name}"), reason(&error));
        // SAFETY: loading EGL runs the initialisers of a system library.
        let shared = unsafe { SharedObject::open(Some(&name), RTLD_NOW | RTLD_GLOBAL) }.map_err(failed)?;
        // SAFETY: the field types are the signatures of the EGL specification.
        unsafe {
            Ok(Self {
                get_proc_address: *shared.get("eglGetProcAddress").map_err(failed)?,
                get_display: *shared.get("eglGetDisplay").map_err(failed)?,
                initialize: *shared.get("eglInitialize").map_err(failed)?,
                choose_config: *shared.get("eglChooseConfig").map_err(failed)?,
                bind_api: *shared.get("eglBindAPI").map_err(failed)?,
                create_context: *shared.get("eglCreateContext").map_err(failed)?,
                create_pbuffer: *shared.get("eglCreatePbufferSurface").map_err(failed)?,
                make_current: *shared.get("eglMakeCurrent").map_err(failed)?,
                destroy_surface: *shared.get("eglDestroySurface").map_err(failed)?,
                destroy_context: *shared.get("eglDestroyContext").map_err(failed)?,
                get_error: *shared.get("eglGetError").map_err(failed)?,
                _shared: shared,
            })
        }
    }

    /// Looks up an extension function.
    ///
    /// # Safety
    /// `F` must be a function pointer of the function's signature.
    unsafe fn extension<F: Copy>(&self, name: &CStr) -> Option<F> {
        // SAFETY: `eglGetProcAddress` accepts any name.
        let address = unsafe { (self.get_proc_address)(name.as_ptr()) };
        // SAFETY: the address is not null and has the size of a function pointer; the caller guarantees the signature.
        (!address.is_null()).then(|| unsafe { std::mem::transmute_copy(&address) })
    }

    /// Opens the device that `MUJOCO_EGL_DEVICE_ID` selects, otherwise the first usable device, graphics cards first.
    ///
    /// # Errors
    /// When no device is usable.
    pub fn display(&self) -> Result<Display> {
        let mut devices = self.devices();
        match std::env::var("MUJOCO_EGL_DEVICE_ID").ok().filter(|text| !text.is_empty()) {
            Some(text) => {
                let chosen = text.parse().ok().and_then(|index: usize| devices.get(index).copied());
                devices = vec![chosen.ok_or_else(|| {
                    let problem = format!("'{text}' is not the index of one of the {} EGL devices", devices.len());
                    Error::config(
                        "MUJOCO_EGL_DEVICE_ID",
                        problem,
                        "give an index, counted from 0, or leave the variable unset",
                    )
                })?];
            }
            None => devices.sort_by_key(|display| !display.hardware),
        }
        let opened = devices.into_iter().find(|display| {
            // SAFETY: the display was returned by EGL; null pointers are allowed where no version is requested.
            let open =
                unsafe { (self.initialize)(display.pointer, std::ptr::null_mut(), std::ptr::null_mut()) } == TRUE;
            open && self.config(*display).is_some()
        });
        opened.ok_or_else(|| {
            Error::external("EGL", "no device can render: neither a graphics driver nor Mesa is installed")
        })
    }

    /// The displays of all devices, and Mesa's display without a device.
    fn devices(&self) -> Vec<Display> {
        type QueryDevices = unsafe extern "C" fn(c_int, *mut Pointer, *mut c_int) -> Bool;
        type QueryString = unsafe extern "C" fn(Pointer, c_int) -> *const c_char;
        type PlatformDisplay = unsafe extern "C" fn(u32, Pointer, *const c_int) -> Pointer;
        let mut found = vec![];
        // SAFETY: the signatures are those of EGL_EXT_device_enumeration, EGL_EXT_device_query and
        // EGL_EXT_platform_base; the functions receive devices that EGL returned, and buffers of the stated length.
        unsafe {
            let query: Option<QueryDevices> = self.extension(c"eglQueryDevicesEXT");
            let describe: Option<QueryString> = self.extension(c"eglQueryDeviceStringEXT");
            let Some(platform) = self.extension::<PlatformDisplay>(c"eglGetPlatformDisplayEXT") else {
                let pointer = (self.get_display)(std::ptr::null_mut());
                return if pointer.is_null() { vec![] } else { vec![Display { pointer, hardware: false }] };
            };
            let (mut devices, mut count) = ([std::ptr::null_mut(); 32], 0);
            if let Some(query) = query
                && query(32, devices.as_mut_ptr(), &raw mut count) == TRUE
            {
                for device in devices.into_iter().take(usize::try_from(count).unwrap_or(0)) {
                    let words = describe.map_or(std::ptr::null(), |describe| describe(device, EXTENSIONS));
                    let software = !words.is_null() && CStr::from_ptr(words).to_string_lossy().contains("_software");
                    let pointer = platform(PLATFORM_DEVICE, device, std::ptr::null());
                    if !pointer.is_null() {
                        found.push(Display { pointer, hardware: !software });
                    }
                }
            }
            let pointer = platform(PLATFORM_SURFACELESS, std::ptr::null_mut(), std::ptr::null());
            if !pointer.is_null() {
                found.push(Display { pointer, hardware: false });
            }
        }
        found
    }

    /// A frame buffer configuration of the display for OpenGL.
    fn config(&self, display: Display) -> Option<Pointer> {
        let (mut config, mut count) = (std::ptr::null_mut(), 0);
        // SAFETY: there is room for the one configuration that is requested.
        let chosen =
            unsafe { (self.choose_config)(display.pointer, CONFIG.as_ptr(), &raw mut config, 1, &raw mut count) };
        (chosen == TRUE && count > 0).then_some(config)
    }

    /// The error that EGL recorded on this thread.
    fn last_error(&self, operation: &str) -> Error {
        // SAFETY: the function takes no arguments.
        let code = unsafe { (self.get_error)() };
        Error::external("EGL", format!("{operation} failed with {code:#x}"))
    }

    /// Creates an OpenGL context and binds it to this thread.
    ///
    /// # Errors
    /// When EGL fails.
    pub fn create_context(&self, display: Display) -> Result<GlContext> {
        let null = std::ptr::null_mut();
        let config = self.config(display).ok_or_else(|| self.last_error("choosing a configuration"))?;
        let display = display.pointer;
        // SAFETY: display and configuration were returned by EGL; attribute lists end in NONE.
        unsafe {
            if (self.bind_api)(OPENGL_API) != TRUE {
                return Err(self.last_error("choosing OpenGL"));
            }
            let context = (self.create_context)(display, config, null, std::ptr::null());
            if context.is_null() {
                return Err(self.last_error("creating a context"));
            }
            let mut gl = GlContext { display, context, surface: null };
            if self.bind(&gl).is_err() {
                // Older drivers require a surface, though nothing is drawn to it.
                gl.surface = (self.create_pbuffer)(display, config, PBUFFER.as_ptr());
                if let Err(error) = self.bind(&gl) {
                    self.destroy_context(&gl);
                    return Err(error);
                }
            }
            Ok(gl)
        }
    }

    /// Makes a context current on this thread.
    ///
    /// # Errors
    /// When EGL fails.
    pub fn bind(&self, gl: &GlContext) -> Result<()> {
        let GlContext { display, context, surface } = *gl;
        // SAFETY: the pointers were returned by EGL and are used by this thread only.
        match unsafe { (self.make_current)(display, surface, surface, context) } {
            TRUE => Ok(()),
            _ => Err(self.last_error("making a context current")),
        }
    }

    /// Destroys a context; no context is current on this thread afterwards.
    pub fn destroy_context(&self, gl: &GlContext) {
        let GlContext { display, context, surface } = *gl;
        let null = std::ptr::null_mut();
        // SAFETY: the pointers were returned by EGL and are not used again.
        unsafe {
            (self.make_current)(display, null, null, null);
            if !surface.is_null() {
                (self.destroy_surface)(display, surface);
            }
            (self.destroy_context)(display, context);
        }
    }

    /// OpenGL's name of the device of the current context.
    pub fn device_name(&self) -> String {
        // SAFETY: the signature is OpenGL's; the returned text is static.
        unsafe {
            let get_string: Option<unsafe extern "C" fn(u32) -> *const c_char> = self.extension(c"glGetString");
            let name = get_string.map_or(std::ptr::null(), |get_string| get_string(GL_RENDERER));
            if name.is_null() { "unknown".to_owned() } else { CStr::from_ptr(name).to_string_lossy().into_owned() }
        }
    }
}
