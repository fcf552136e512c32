//! Checks of settings, shared by the configurations of several families.

use swm_core::{Error, Result};

/// Checks that sizes are not below their lower bounds; `sizes` lists `(name, value, lower bound)`.
///
/// # Errors
/// When a size is below its bound; the error names the first such size.
pub fn at_least(sizes: &[(&str, usize, usize)]) -> Result<()> {
    match sizes.iter().find(|(_, value, least)| value < least) {
        Some((name, value, least)) => Err(Error::config(*name, value.to_string(), format!("give at least {least}"))),
        None => Ok(()),
    }
}
