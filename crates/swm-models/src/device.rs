//! The device on which a model computes: `cpu`, or a GPU whose backend was built in.

use burn::tensor::Device;
use swm_core::{Error, Result};

/// The name of each backend, and whether this build contains the backend.
const BACKENDS: [(&str, bool); 3] =
    [("cpu", true), ("vulkan", cfg!(feature = "vulkan")), ("cuda", cfg!(feature = "cuda"))];

/// Parses the name of a device: `cpu`, `vulkan` or `cuda` (optionally followed by a GPU index, such as
/// `vulkan:1`), or `auto`, which is the last built-in backend of `cpu`, `vulkan`, `cuda`.
///
/// # Errors
/// When the name is not that of a backend, the GPU index is no integer, or this build does not contain the backend.
pub fn parse(name: &str) -> Result<Device> {
    if name == "auto" {
        let found = BACKENDS.iter().rev().find(|(_, built)| *built);
        return parse(found.map_or("cpu", |(backend, _)| backend));
    }
    let (backend, index) = match name.split_once(':') {
        None => (name, 0),
        Some((backend, index)) => {
            let invalid = |_| {
                Error::config("--device", format!("'{index}' is not a GPU index"), "write the device like vulkan:0")
            };
            (backend, index.parse().map_err(invalid)?)
        }
    };
    let Some((_, built)) = BACKENDS.iter().find(|(known, _)| *known == backend) else {
        let known: Vec<&str> = BACKENDS.iter().map(|(known, _)| *known).chain(["auto"]).collect();
        let hint = format!("choose {}; a GPU index follows a colon, such as vulkan:0", known.join(", "));
        return Err(Error::unknown("device", backend, known, hint));
    };
    if !built {
        let problem = format!("this program was built without {backend}");
        let fix = format!("build it with `--features {backend}` (`make gpu` builds for Vulkan), or pass --device cpu");
        return Err(Error::config("--device", problem, fix));
    }
    open(backend, index)
}

#[cfg_attr(
    not(any(feature = "vulkan", feature = "cuda")),
    allow(
        unused_variables,
        clippy::unnecessary_wraps,
        reason = "the index and the result matter to GPU backends only"
    )
)]
fn open(backend: &str, index: usize) -> Result<Device> {
    match backend {
        #[cfg(feature = "vulkan")]
        "vulkan" => Ok(Device::vulkan(burn::tensor::DeviceKind::DiscreteGpu(index))),
        #[cfg(feature = "cuda")]
        "cuda" => Ok(Device::cuda(index)),
        _ => Ok(Device::flex()),
    }
}

/// Returns the name of a device in manifests.
pub fn name(device: &Device) -> String {
    if *device == Device::flex() { "cpu (flex)".to_owned() } else { format!("{device:?}") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cpu_is_available_and_invalid_device_names_are_errors() {
        assert_eq!(name(&parse("cpu").expect("parsing 'cpu'")), "cpu (flex)");
        let message = |name: &str| parse(name).expect_err("an invalid device is accepted").to_string();
        assert!(message("cdua").contains("did you mean cuda"), "{}", message("cdua"));
        assert!(message("cpu:x").contains("not a GPU index"), "{}", message("cpu:x"));
        if !cfg!(feature = "cuda") {
            assert!(message("cuda:0").contains("without cuda"), "{}", message("cuda:0"));
        }
    }
}
