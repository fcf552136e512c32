//! `swm devices`: lists the devices that models can compute on; and opening the device of `--device`.

use super::{emit, emit_json, eprint, table};
use serde_json::json;
use swm_core::Result;
use swm_models::Device;
use swm_models::device::{self, Choice, Kind};

/// The flag `--device`.
#[derive(clap::Args)]
pub struct DeviceArgs {
    /// Device of the models: cpu, vulkan[:I], cuda[:I] or auto (default: cpu)
    ///
    /// `swm devices` lists them. auto is the first GPU that passes a test computation, else the CPU. A GPU's matrix products have the
    /// precision after a comma: cuda:0,bf16.
    #[arg(long)]
    pub device: Option<String>,
}

/// Lists the devices, and what `auto` chooses.
pub fn devices(as_json: bool) -> anyhow::Result<()> {
    let all = device::list();
    let Choice { description, .. } = device::choose("auto")?;
    if as_json {
        return emit_json(&json!({ "devices": all, "auto": description }));
    }
    let rows = all.into_iter().map(|found| {
        let kind = if found.kind == Kind::Cpu { String::new() } else { found.kind.to_string() };
        vec![found.id, kind, found.name, found.driver]
    });
    emit(&table(&["device", "kind", "name", "driver"], rows));
    emit(&format!("auto: {description}\n"));
    Ok(())
}

impl DeviceArgs {
    /// Checks that the device can be opened.
    ///
    /// # Errors
    /// As [`device::check`].
    pub fn check(&self) -> Result<()> {
        device::check(self.name())
    }

    /// Opens the device, and says which it is unless it is the CPU that was asked for.
    ///
    /// # Errors
    /// As [`device::choose`].
    pub fn open(&self) -> Result<Device> {
        open(self.name())
    }

    /// The name of the device.
    fn name(&self) -> &str {
        self.device.as_deref().unwrap_or("cpu")
    }
}

/// As [`DeviceArgs::open`], for the name of a device.
pub fn open(name: &str) -> Result<Device> {
    let Choice { device, description } = device::choose(name)?;
    if name != "cpu" {
        eprint(&format!("device: {description}\n"));
    }
    Ok(device)
}
