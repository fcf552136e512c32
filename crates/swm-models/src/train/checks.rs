//! Checks of settings that several configurations share.

use swm_core::{Error, Result};

/// Checks lower bounds of sizes, given as `(name, value, least)`.
///
/// # Errors
/// Naming the first size below its bound.
pub fn at_least(sizes: &[(&str, usize, usize)]) -> Result<()> {
    match sizes.iter().find(|(_, value, least)| value < least) {
        Some((name, value, least)) => Err(Error::config(*name, value.to_string(), format!("give at least {least}"))),
        None => Ok(()),
    }
}
