//! The adapters of Vulkan drivers: GPUs, and software that computes on the CPU.

use super::{Found, Kind};
use burn::tensor::wgpu::{WgpuBackend, wgpu};
use burn::tensor::{Device, DeviceKind};
use std::path::PathBuf;
use std::pin::pin;
use std::sync::OnceLock;
use std::task::{Context, Poll, Waker};

/// An adapter of a Vulkan driver.
pub(super) struct Adapter {
    pub found: Found,
    /// How Burn names the adapter: its index among those of its kind.
    selector: DeviceKind,
}

impl Adapter {
    /// Opens the adapter; a second call is an error.
    pub fn open(&self) -> Result<Device, String> {
        let options = Device::wgpu_options().device_kind(self.selector.clone()).graphics_api(WgpuBackend::Vulkan);
        options.init().map_err(|error| error.to_string())
    }
}

/// Returns the adapters of this machine, GPUs first.
pub(super) fn adapters() -> &'static [Adapter] {
    // The instance stays: loaders of Vulkan crash when instances come and go on several threads.
    static ADAPTERS: OnceLock<(wgpu::Instance, Vec<Adapter>)> = OnceLock::new();
    let enumerate = || {
        let backends = wgpu::Backends::VULKAN;
        let instance = wgpu::Instance::new(wgpu::InstanceDescriptor {
            backends,
            ..wgpu::InstanceDescriptor::new_without_display_handle()
        });
        let all = ready(instance.enumerate_adapters(backends)).iter().map(wgpu::Adapter::get_info).collect();
        (instance, listed(all))
    };
    &ADAPTERS.get_or_init(enumerate).1
}

/// Returns the adapters in the order of the list. Burn opens the first software adapter only, and none of unknown type.
fn listed(all: Vec<wgpu::AdapterInfo>) -> Vec<Adapter> {
    let mut counts = [0; 4];
    let mut adapters = vec![];
    for info in all {
        let kind = match info.device_type {
            wgpu::DeviceType::DiscreteGpu => Kind::Discrete,
            wgpu::DeviceType::IntegratedGpu => Kind::Integrated,
            wgpu::DeviceType::VirtualGpu => Kind::Virtual,
            wgpu::DeviceType::Cpu => Kind::Software,
            wgpu::DeviceType::Other => continue,
        };
        let count = &mut counts[kind as usize];
        let index = *count;
        *count += 1;
        let selector = match kind {
            Kind::Discrete => DeviceKind::DiscreteGpu(index),
            Kind::Integrated => DeviceKind::IntegratedGpu(index),
            Kind::Virtual => DeviceKind::VirtualGpu(index),
            Kind::Software if index == 0 => DeviceKind::Cpu,
            Kind::Software | Kind::Cpu => continue,
        };
        let driver = [info.driver, info.driver_info].into_iter().filter(|part| !part.is_empty());
        let driver = driver.collect::<Vec<_>>().join(", ");
        adapters.push(Adapter { found: Found { id: String::new(), kind, name: info.name, driver }, selector });
    }
    adapters.sort_by_key(|adapter| adapter.found.kind);
    for (index, adapter) in adapters.iter_mut().enumerate() {
        adapter.found.id = format!("vulkan:{index}");
    }
    adapters
}

/// Returns the output of a future that waits for nothing, as those of wgpu outside a browser.
fn ready<T>(future: impl Future<Output = T>) -> T {
    let mut future = pin!(future);
    loop {
        match future.as_mut().poll(&mut Context::from_waker(Waker::noop())) {
            Poll::Ready(value) => return value,
            Poll::Pending => std::thread::yield_now(),
        }
    }
}

/// Folders in which drivers of Vulkan register.
const DRIVER_FOLDERS: [&str; 3] = ["/usr/share/vulkan/icd.d", "/usr/local/share/vulkan/icd.d", "/etc/vulkan/icd.d"];

/// Returns why there is no adapter, and what to do.
pub(super) fn missing() -> (String, String) {
    let chosen = ["VK_DRIVER_FILES", "VK_ICD_FILENAMES"].into_iter().find(|name| std::env::var_os(name).is_some());
    let registered = DRIVER_FOLDERS.iter().filter_map(|folder| std::fs::read_dir(folder).ok()).flatten().flatten();
    let registered: Vec<PathBuf> = registered.map(|entry| entry.path()).collect();
    let names: Vec<_> =
        registered.iter().filter_map(|path| path.file_stem()).map(|name| name.to_string_lossy()).collect();
    let cpu = "or pass --device cpu";
    match chosen {
        Some(variable) => (
            format!("no Vulkan adapter was found with the drivers that the environment variable {variable} names"),
            format!("unset {variable}, {cpu}"),
        ),
        None if names.is_empty() => (
            "no Vulkan adapter was found: no driver is installed".to_owned(),
            format!(
                "install the GPU's driver (Debian: mesa-vulkan-drivers for AMD and Intel, nvidia-driver for NVIDIA), {cpu}"
            ),
        ),
        None => (
            format!(
                "no Vulkan adapter was found: the drivers {} fit no GPU of this machine, or the loader libvulkan.so.1 is missing",
                names.join(", ")
            ),
            format!(
                "install libvulkan1 and the GPU's driver; `vulkaninfo --summary` shows what the loader finds; {cpu}"
            ),
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gpus_come_before_software_and_are_counted_by_kind() {
        use wgpu::DeviceType::{Cpu, DiscreteGpu, IntegratedGpu, Other, VirtualGpu};
        let info = |(index, device_type)| wgpu::AdapterInfo {
            name: format!("adapter {index}"),
            driver: "mesa".to_owned(),
            ..wgpu::AdapterInfo::new(device_type, wgpu::Backend::Vulkan)
        };
        let types = [Cpu, IntegratedGpu, Other, DiscreteGpu, VirtualGpu, DiscreteGpu, Cpu];
        let adapters = listed(types.into_iter().enumerate().map(info).collect());
        let ids: Vec<_> =
            adapters.iter().map(|a| (a.found.id.as_str(), a.found.name.as_str(), a.selector.clone())).collect();
        assert_eq!(
            ids,
            [
                ("vulkan:0", "adapter 3", DeviceKind::DiscreteGpu(0)),
                ("vulkan:1", "adapter 5", DeviceKind::DiscreteGpu(1)),
                ("vulkan:2", "adapter 1", DeviceKind::IntegratedGpu(0)),
                ("vulkan:3", "adapter 4", DeviceKind::VirtualGpu(0)),
                ("vulkan:4", "adapter 0", DeviceKind::Cpu),
            ]
        );
        assert_eq!(adapters[0].found.to_string(), "vulkan: adapter 3 (mesa)");
    }
}
