//! The device on which a model computes: the CPU, or a graphics card (GPU) whose backend was built in.
//!
//! A device is opened once in a process, and then passes a test computation, so that a driver that does not fit is an error
//! at the start and not in the middle of a run.

mod memory;
mod precision;
#[cfg(feature = "vulkan")]
mod vulkan;

pub(crate) use memory::within_memory;
pub use precision::Precision;
pub(crate) use precision::matmul;

use burn::tensor::{Device, Tensor, activation};
use serde::Serialize;
use std::fmt;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Mutex, PoisonError};
use swm_core::{Error, Result};

/// The name of each backend, and whether this build contains the backend.
const BACKENDS: [(&str, bool); 3] =
    [("cpu", true), ("vulkan", cfg!(feature = "vulkan")), ("cuda", cfg!(feature = "cuda"))];

/// What computes. The order is that of the list of a backend: what is usually faster comes first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Kind {
    /// A GPU with memory of its own.
    Discrete,
    /// A GPU that shares the memory of the CPU.
    Integrated,
    /// A GPU that a hypervisor offers.
    Virtual,
    /// The CPU, through a driver for GPUs such as Mesa's lavapipe: for tests.
    Software,
    /// The CPU, through Burn's `flex` backend and kernels of our own.
    Cpu,
}

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Discrete => "discrete",
            Self::Integrated => "integrated",
            Self::Virtual => "virtual",
            Self::Software => "software",
            Self::Cpu => "cpu",
        })
    }
}

/// A device of this machine.
#[derive(Clone, Debug, Serialize)]
pub struct Found {
    /// What `--device` takes: `cpu`, `vulkan:0`.
    pub id: String,
    /// What computes.
    pub kind: Kind,
    /// The name that the driver gives.
    pub name: String,
    /// The driver and its version.
    pub driver: String,
}

impl fmt::Display for Found {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.kind == Kind::Cpu {
            return f.write_str(&self.name);
        }
        let backend = self.id.split(':').next().unwrap_or_default();
        write!(f, "{backend}: {}", self.name)?;
        if self.driver.is_empty() { Ok(()) } else { write!(f, " ({})", self.driver) }
    }
}

/// A device that was chosen by name, and why.
pub struct Choice {
    /// The device, which passed the test computation.
    pub device: Device,
    /// What was chosen, in words: `vulkan: NVIDIA H100 (NVIDIA, 550.54)`.
    pub description: String,
}

/// Returns the devices that this build can use on this machine.
pub fn list() -> Vec<Found> {
    let all = std::iter::once(cpu());
    #[cfg(feature = "cuda")]
    let all = all.chain(cuda());
    #[cfg(feature = "vulkan")]
    let all = all.chain(vulkan::adapters().iter().map(|adapter| adapter.found.clone()));
    all.collect()
}

fn cpu() -> Found {
    Found { id: "cpu".to_owned(), kind: Kind::Cpu, name: "cpu (flex)".to_owned(), driver: String::new() }
}

/// The devices of the CUDA backend, which gives no names before it opens them.
#[cfg(feature = "cuda")]
fn cuda() -> Vec<Found> {
    let count = catch_unwind(|| Device::enumerate(burn::tensor::DeviceType::Cuda).into_iter().count()).unwrap_or(0);
    let found = |index| Found {
        id: format!("cuda:{index}"),
        kind: Kind::Discrete,
        name: format!("GPU {index}"),
        driver: String::new(),
    };
    (0..count).map(found).collect()
}

/// Opens the device with a name; [`choose`] describes the names.
///
/// # Errors
/// As [`choose`].
pub fn parse(name: &str) -> Result<Device> {
    Ok(choose(name)?.device)
}

/// Opens the device with a name: `cpu`; `vulkan` or `cuda`, the first GPU of the backend; `vulkan:1`, the GPU with that index in
/// [`list`]; or `auto`, the first GPU that passes the test computation, else the CPU. After a comma, the name of a GPU may have the
/// precision of its matrix products: `cuda:0,bf16`.
///
/// `vulkan` is a software adapter only if there is no GPU, and `auto` never is: the CPU kernels are faster.
///
/// # Errors
/// When the name is not that of a backend, the index is no integer, this build does not contain the backend, there is no such
/// GPU, or its driver does not pass the test computation.
pub fn choose(name: &str) -> Result<Choice> {
    let (choice, precision) = find(name)?;
    if !is_cpu(&choice.device) {
        precision.choose()?;
    }
    Ok(choice)
}

/// Checks that [`choose`] finds the device with a name. Unlike it, chooses no precision for the process.
///
/// # Errors
/// As [`choose`], but for another precision than that of the process.
pub fn check(name: &str) -> Result<()> {
    find(name).map(drop)
}

/// Returns the device with a name, and the precision of its matrix products.
fn find(name: &str) -> Result<(Choice, Precision)> {
    let (device, precision) =
        name.split_once(',').map_or((name, None), |(device, precision)| (device, Some(precision)));
    let precision = match precision {
        None => Precision::Single,
        Some(given) => Precision::parse(given).ok_or_else(|| {
            let hint = "write the precision after a comma, such as cuda:0,bf16";
            Error::unknown("precision", given, Precision::names(), hint)
        })?,
    };
    let mut choice = choose_device(device)?;
    if is_cpu(&choice.device) {
        if precision == Precision::Single || device == "auto" {
            return Ok((choice, precision));
        }
        let fix = format!("pass --device {device}, or a GPU of `swm devices` such as cuda:0,{precision}");
        return Err(Error::config("--device", format!("'{name}': the CPU computes in single precision"), fix));
    }
    if precision != Precision::Single {
        if let Err(problem) = test_precision(&choice.device, precision) {
            let fix = format!("pass --device {device}, which computes in single precision");
            return Err(Error::config("--device", format!("{} {problem}", choice.description), fix));
        }
        choice.description = format!("{}, {precision}", choice.description);
    }
    Ok((choice, precision))
}

/// [`find`] for a name without precision.
fn choose_device(name: &str) -> Result<Choice> {
    if name == "auto" {
        return Ok(automatic());
    }
    let (backend, index) = match name.split_once(':') {
        Some(("auto", _)) => {
            let fix = "write auto, or a device of `swm devices` such as vulkan:1";
            return Err(Error::config("--device", format!("'{name}' has an index, and auto chooses one"), fix));
        }
        None => (name, None),
        Some((backend, index)) => {
            let invalid = |_| {
                Error::config("--device", format!("'{index}' is not a GPU index"), "write the device like vulkan:0")
            };
            (backend, Some(index.parse::<usize>().map_err(invalid)?))
        }
    };
    let Some((_, built)) = BACKENDS.iter().find(|(known, _)| *known == backend) else {
        let known: Vec<&str> = BACKENDS.iter().map(|(known, _)| *known).chain(["auto"]).collect();
        let hint = format!("choose {}; a GPU index follows a colon, such as vulkan:0", known.join(", "));
        return Err(Error::unknown("device", backend, known, hint));
    };
    if !built {
        let problem = format!("this program was built without {backend}");
        let fix =
            format!("build it with `make {}`, or pass --device cpu", if backend == "cuda" { "cuda" } else { "gpu" });
        return Err(Error::config("--device", problem, fix));
    }
    if backend == "cpu" {
        if index.is_some() {
            return Err(Error::config("--device", format!("'{name}' has an index, and there is one CPU"), "write cpu"));
        }
        return Ok(Choice { device: Device::flex(), description: cpu().to_string() });
    }
    let id = format!("{backend}:{}", index.unwrap_or(0));
    let all = list();
    let Some(found) = all.iter().find(|found| found.id == id) else { return Err(missing(backend, &id, &all)) };
    Ok(Choice { device: open(found)?, description: found.to_string() })
}

/// The error for a GPU that this machine does not have.
fn missing(backend: &str, id: &str, all: &[Found]) -> Error {
    let of_backend = all.iter().filter(|found| found.id.starts_with(backend));
    let others: Vec<String> = of_backend.map(|found| format!("{} ({})", found.id, found.name)).collect();
    if !others.is_empty() {
        let fix = format!("choose one of {} (`swm devices` lists them)", others.join(", "));
        return Error::config("--device", format!("there is no {id}"), fix);
    }
    #[cfg(feature = "vulkan")]
    if backend == "vulkan" {
        let (problem, fix) = vulkan::missing();
        return Error::config("--device", problem, fix);
    }
    Error::config(
        "--device",
        format!("no GPU was found by {backend}"),
        "install the GPU's driver, or pass --device cpu",
    )
}

/// Returns the first GPU that passes the test computation, else the CPU.
fn automatic() -> Choice {
    let all = list();
    let mut reasons = vec![];
    for found in all.iter().filter(|found| found.kind < Kind::Software) {
        match open(found) {
            Ok(device) => return Choice { device, description: found.to_string() },
            Err(error) => reasons.push(error.to_string()),
        }
    }
    let software = all.iter().find(|found| found.kind == Kind::Software);
    if let Some(found) = software.filter(|_| reasons.is_empty()) {
        reasons.push(format!("{} ({}) is no GPU", found.id, found.name));
    }
    if reasons.is_empty() {
        let built = BACKENDS.iter().any(|(name, built)| *built && *name != "cpu");
        reasons
            .push(if built { "no GPU was found" } else { "this program was built without a GPU backend" }.to_owned());
    }
    Choice { device: Device::flex(), description: format!("{}, because {}", cpu(), reasons.join("; ")) }
}

/// A device and its name in manifests, or why it cannot be opened.
type Opened = std::result::Result<(Device, String), String>;

/// The devices that were opened, by id.
static OPENED: Mutex<Vec<(String, Opened)>> = Mutex::new(vec![]);

/// Opens a GPU and makes the test computation on it. Every GPU is opened once.
///
/// # Errors
/// When its driver does not fit.
fn open(found: &Found) -> Result<Device> {
    let mut opened = OPENED.lock().unwrap_or_else(PoisonError::into_inner);
    if !opened.iter().any(|(id, _)| *id == found.id) {
        let device = create(found).and_then(|device| test(&device).map(|()| (device, found.to_string())));
        opened.push((found.id.clone(), device));
    }
    let outcome = opened.iter().find(|(id, _)| *id == found.id).map(|(_, outcome)| outcome.clone());
    match outcome.unwrap_or_else(|| Err("it was not opened".to_owned())) {
        Ok((device, _)) => Ok(device),
        Err(problem) => {
            let fix =
                "update the GPU's driver (Vulkan 1.2 or newer), choose another of `swm devices`, or pass --device cpu";
            Err(Error::config("--device", format!("{} ({}, {}) {problem}", found.id, found.name, found.driver), fix))
        }
    }
}

#[cfg_attr(not(any(feature = "vulkan", feature = "cuda")), allow(clippy::unnecessary_wraps, reason = "GPUs only"))]
fn create(found: &Found) -> std::result::Result<Device, String> {
    #[cfg(feature = "vulkan")]
    if let Some(adapter) = vulkan::adapters().iter().find(|adapter| adapter.found.id == found.id) {
        return adapter.open().map_err(|problem| format!("cannot be opened: {problem}"));
    }
    #[cfg(feature = "cuda")]
    if let Some(index) = found.id.strip_prefix("cuda:").and_then(|index| index.parse::<usize>().ok()) {
        return Ok(Device::cuda(index));
    }
    Err(format!("is no device of this build: {}", found.id))
}

/// Makes a small computation on a device and compares it with the CPU's.
fn test(device: &Device) -> std::result::Result<(), String> {
    let compute = |device: &Device| -> Vec<f32> {
        let row: Vec<f32> = (0..12 * 12).map(|i| (i * 37 % 101) as f32 / 101.0 - 0.5).collect();
        let x = Tensor::<1>::from_floats(row.as_slice(), device).reshape([12, 12]);
        let y = activation::softmax(x.clone().matmul(x.clone().transpose()), 1);
        let sum = (x.exp() * y).sum_dim(1);
        sum.into_data().iter::<f32>().collect()
    };
    // Backends report some faults of a driver by a panic.
    let found = catch_unwind(AssertUnwindSafe(|| {
        let found = compute(device);
        device.sync().map(|()| found).map_err(|error| error.to_string())
    }));
    let found = match found {
        Ok(found) => found.map_err(|error| format!("failed a test computation: {error}"))?,
        Err(panic) => return Err(Error::panicked("failed a test computation", &*panic).to_string()),
    };
    let expected = compute(&Device::flex());
    let equal = expected.iter().zip(&found).all(|(a, b)| (a - b).abs() <= 1e-3 * a.abs());
    if equal && expected.len() == found.len() { Ok(()) } else { Err("computes wrong values".to_owned()) }
}

/// Multiplies small matrices on a device in another precision and compares the product with the CPU's.
fn test_precision(device: &Device, precision: Precision) -> std::result::Result<(), String> {
    let compute = |device: &Device, precision: Precision| -> Vec<f32> {
        let row: Vec<f32> = (0..64 * 64).map(|i| (i * 37 % 101) as f32 / 101.0 - 0.5).collect();
        let x = precision.lower(Tensor::<1>::from_floats(row.as_slice(), device).reshape([64, 64]));
        precision.raise(x.clone().matmul(x.transpose())).into_data().iter::<f32>().collect()
    };
    let expected = compute(&Device::flex(), Precision::Single);
    let found = catch_unwind(AssertUnwindSafe(|| compute(device, precision)));
    let found =
        found.map_err(|panic| Error::panicked(&format!("does not compute in {precision}"), &*panic).to_string())?;
    let largest = expected.iter().fold(0.0_f32, |most, value| value.abs().max(most));
    let close = expected.iter().zip(&found).all(|(a, b)| (a - b).abs() <= 0.02 * largest);
    if close { Ok(()) } else { Err(format!("computes wrong products in {precision}")) }
}

/// Returns whether a device is the CPU, for which there are kernels of our own.
pub fn is_cpu(device: &Device) -> bool {
    device.clone().inner() == Device::flex()
}

/// Returns the name of a device in manifests.
pub fn name(device: &Device) -> String {
    if is_cpu(device) {
        return cpu().name;
    }
    let opened = OPENED.lock().unwrap_or_else(PoisonError::into_inner);
    let device = device.clone().inner();
    let found = opened.iter().filter_map(|(_, opened)| opened.as_ref().ok()).find(|(known, _)| *known == device);
    let name = found.map_or_else(|| format!("{device:?}"), |(_, name)| name.clone());
    match Precision::chosen() {
        Precision::Single => name,
        precision => format!("{name}, {precision}"),
    }
}

/// Returns the name of a device in the manifest of what is computed from an artifact whose manifest names the device `before`:
/// imported models name the CPU without the backend, and what is computed from them on the CPU does so as well.
pub fn name_after(device: &Device, before: &str) -> String {
    if is_cpu(device) && before == "cpu" { before.to_owned() } else { name(device) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cpu_is_available_and_invalid_device_names_are_errors() {
        assert_eq!(name(&parse("cpu").expect("parsing 'cpu'")), "cpu (flex)");
        let message = |name: &str| parse(name).expect_err("an invalid device is accepted").to_string();
        assert!(message("cdua").contains("did you mean cuda"), "{}", message("cdua"));
        assert!(message("auto:1").contains("auto chooses one"), "{}", message("auto:1"));
        assert!(message("cpu:x").contains("not a GPU index"), "{}", message("cpu:x"));
        assert!(message("cpu:1").contains("there is one CPU"), "{}", message("cpu:1"));
        assert!(message("cpu,bf16").contains("the CPU computes in single precision"), "{}", message("cpu,bf16"));
        assert!(message("cpu,b16").contains("did you mean bf16"), "{}", message("cpu,b16"));
        check("cpu,f32").expect("checking 'cpu,f32'");
        for name in ["cdua", "cpu,bf16"] {
            assert_eq!(check(name).expect_err("an invalid device is accepted").to_string(), message(name));
        }
        assert!(is_cpu(&parse("cpu,f32").expect("parsing 'cpu,f32'")));
        if !cfg!(feature = "cuda") {
            assert!(message("cuda:0").contains("without cuda"), "{}", message("cuda:0"));
        }
    }

    #[test]
    fn the_cpu_comes_first_and_auto_says_what_it_chose() {
        assert_eq!(list()[0].kind, Kind::Cpu);
        let Choice { device, description } = choose("auto").expect("some device");
        assert_eq!(is_cpu(&device), description.starts_with("cpu (flex), because "), "{description}");
        if cfg!(not(any(feature = "vulkan", feature = "cuda"))) {
            assert_eq!(description, "cpu (flex), because this program was built without a GPU backend");
        }
    }

    #[test]
    fn results_name_the_device_that_computed_them() {
        let names =
            ["cpu", "cpu (flex)", "cpu (torch)", "vulkan: a GPU"].map(|before| name_after(&Device::flex(), before));
        assert_eq!(names, ["cpu", "cpu (flex)", "cpu (flex)", "cpu (flex)"]);
    }

    #[test]
    fn the_cpu_passes_the_test_computation() {
        assert_eq!(test(&Device::flex()), Ok(()));
    }

    #[cfg(feature = "vulkan")]
    #[test]
    fn every_adapter_can_be_opened_by_its_index() {
        let adapters: Vec<Found> = list().into_iter().filter(|found| found.id.starts_with("vulkan")).collect();
        for (index, found) in adapters.iter().enumerate() {
            assert_eq!(found.id, format!("vulkan:{index}"));
            let device = parse(&found.id).expect("opening an adapter");
            assert_eq!(name(&device), found.to_string());
            assert_eq!(name(&device.autodiff()), found.to_string());
        }
        let message = parse(&format!("vulkan:{}", adapters.len())).expect_err("a missing adapter").to_string();
        let expected = if adapters.is_empty() { "no Vulkan adapter" } else { "there is no vulkan:" };
        assert!(message.contains(expected), "{message}");
        if adapters.iter().all(|found| found.kind == Kind::Software) {
            assert!(is_cpu(&parse("auto").expect("some device")), "auto chose a software adapter");
        }
    }
}
