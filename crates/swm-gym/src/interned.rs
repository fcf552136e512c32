//! [`interned`]: static copies of texts, for the names and ids that a specification stores as `&'static str`.

use std::collections::BTreeSet;
use std::sync::{Mutex, PoisonError};

/// Returns a static copy of a text. Equal texts share one copy, so each distinct text leaks once.
pub fn interned(text: &str) -> &'static str {
    static TEXTS: Mutex<BTreeSet<&'static str>> = Mutex::new(BTreeSet::new());
    let mut texts = TEXTS.lock().unwrap_or_else(PoisonError::into_inner);
    match texts.get(text) {
        Some(known) => known,
        None => {
            let interned: &'static str = Box::leak(text.into());
            texts.insert(interned);
            interned
        }
    }
}
