//! The keys and seeds of episodes.

use swm_core::pool::Reset;
use swm_core::{Key, ResetOptions, VariationRequest};

/// The key of an episode, from which all random values of the episode and of its policy derive.
pub fn episode_key(seed: u64, episode: usize) -> Key {
    Key::new(seed).with("episode").at(episode as u64)
}

/// The seed an environment is reset with, at most 63 bits: results and datasets store it as a signed integer, and
/// Gymnasium accepts no negative seeds.
pub fn reset_seed(key: Key) -> u64 {
    key.seed() >> 1
}

/// A reset of a slot to the start of an episode.
pub(crate) fn reset(slot: usize, key: Key, variation: &VariationRequest) -> Reset {
    let options = ResetOptions { variation: variation.clone(), ..ResetOptions::default() };
    Reset { slot, seed: reset_seed(key), options }
}
