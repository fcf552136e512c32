//! Integration tests: parity with the published models, training, checkpoints.

#![allow(clippy::print_stdout, reason = "the measured errors, for `--no-capture`")]

mod capsules;
mod checkpoints;
mod config;
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

/// Returns the default settings whose keys no override has, then the overrides.
pub(crate) fn overridden(defaults: &[&str], overrides: &[&str]) -> Vec<String> {
    let key = |setting: &str| setting.split('=').next().map(str::to_owned);
    let kept = defaults.iter().filter(|setting| overrides.iter().all(|given| key(given) != key(setting)));
    kept.chain(overrides).map(|&setting| setting.to_owned()).collect()
}
