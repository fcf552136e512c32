//! Integration tests: parity with the published models, training, checkpoints.

#![allow(clippy::print_stdout, reason = "the measured errors, for `--no-capture`")]

mod capsules;
mod checkpoints;
mod config;
mod devices;
mod dino_wm;
mod dots;
mod gcrl;
mod golden;
mod hostile;
mod hub;
mod online;
mod planning;
mod pldm;
mod reference;
mod training;

use swm_models::{Device, TrainOptions, device};

/// Returns the device that the tests compute on: that of the environment variable `SWM_TEST_DEVICE`, else the CPU.
/// `make test-gpu` sets it.
pub(crate) fn device() -> Device {
    let name = std::env::var("SWM_TEST_DEVICE").unwrap_or_else(|_| "cpu".to_owned());
    device::parse(&name).expect("opening the device that SWM_TEST_DEVICE names")
}

/// Returns the default options of training, on the device of the tests.
pub(crate) fn options() -> TrainOptions {
    TrainOptions { device: device(), ..TrainOptions::default() }
}

/// Returns the default settings whose keys no override has, then the overrides.
pub(crate) fn overridden(defaults: &[&str], overrides: &[&str]) -> Vec<String> {
    let key = |setting: &str| setting.split('=').next().map(str::to_owned);
    let kept = defaults.iter().filter(|setting| overrides.iter().all(|given| key(given) != key(setting)));
    kept.chain(overrides).map(|&setting| setting.to_owned()).collect()
}
