//! [`Pick`]: a selection of latent dimensions.

use serde::{Deserialize, Serialize};
use std::ops::Range;
use swm_core::{Error, Result};

/// One dimension of a latent, or a half-open range of dimensions. A file contains `3` or `[8, 16]`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Pick {
    /// One dimension.
    One(usize),
    /// The dimensions from the first index up to, but excluding, the second.
    Range([usize; 2]),
}

impl Pick {
    fn range(self) -> Range<usize> {
        match self {
            Self::One(i) => i..i + 1,
            Self::Range([from, to]) => from..to,
        }
    }
}

/// The selected dimensions of a latent; all of them for an empty selection.
pub(super) fn picked(picks: &[Pick], latent: usize) -> impl Iterator<Item = usize> + '_ {
    let all = picks.is_empty().then_some(0..latent);
    picks.iter().map(|pick| pick.range()).chain(all).flatten()
}

/// Checks that a selection lies within the latent dimension and names each index once.
pub(super) fn check_picks(what: &str, picks: &[Pick], latent: usize) -> Result<()> {
    let mut seen = vec![false; latent];
    for pick in picks {
        let range = pick.range();
        if range.is_empty() || range.end > latent {
            return Err(Error::OutOfSpace {
                what: format!("{what} latents"),
                given: format!("{}..{}", range.start, range.end),
                expected: format!("latent dimensions within 0..{latent}"),
            });
        }
        for i in range {
            if std::mem::replace(&mut seen[i], true) {
                return Err(Error::config(
                    format!("{what} latents"),
                    format!("dimension {i} is named twice"),
                    "name it once",
                ));
            }
        }
    }
    Ok(())
}
