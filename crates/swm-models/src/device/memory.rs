//! A lack of memory on a device, as an error that names the setting to lower.

use super::{is_cpu, name};
use burn::tensor::Device;
use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use swm_core::{Error, Result};

/// Returns what `compute` returns. If the memory of the device does not suffice, which Burn reports by a panic, the error asks to
/// lower `setting`.
///
/// # Errors
/// As `compute`, and when the memory does not suffice.
pub(crate) fn within_memory<T>(device: &Device, setting: &str, compute: impl FnOnce() -> Result<T>) -> Result<T> {
    if is_cpu(device) {
        return compute();
    }
    catch_unwind(AssertUnwindSafe(compute)).unwrap_or_else(|panic| {
        if !lacks_memory(&*panic) {
            resume_unwind(panic);
        }
        let fix = format!("lower {setting}, or pass --device cpu");
        Err(Error::config(name(device), "the memory of the device does not suffice", fix))
    })
}

/// Returns whether a panic reports that an allocation on a device failed.
fn lacks_memory(panic: &(dyn Any + Send)) -> bool {
    let text = panic.downcast_ref::<String>().map(String::as_str).or(panic.downcast_ref::<&str>().copied());
    let text = text.unwrap_or_default().to_lowercase();
    ["out of memory", "out-of-memory", "out of device memory", "outofmemory", "buffertoobig", "can't allocate buffer"]
        .iter()
        .any(|reported| text.contains(reported))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn allocations_that_failed_are_told_from_other_panics() {
        let reports = |text: &str| lacks_memory(&text.to_owned());
        assert!(reports("called `Result::unwrap()`: An error happened\n out of device memory allocating 4096 bytes"));
        assert!(reports("An out-of-memory error happened during launch"));
        assert!(lacks_memory(&"CUDA_ERROR_OUT_OF_MEMORY: out of memory"));
        assert!(!reports("index out of bounds: the len is 3") && !lacks_memory(&7));
    }

    #[test]
    fn the_cpu_computes_without_a_guard() {
        assert_eq!(within_memory(&Device::flex(), "x", || Ok(3)).expect("a value"), 3);
    }
}
