//! [`Held`]: a value of Python that threads of the engine may drop.

use crate::exit::{Call, is_over};
use pyo3::prelude::*;
use std::error::Error;
use std::fmt;
use std::ops::Deref;

/// A value that refers to objects of Python, such as a [`Py`] or a [`PyErr`], which is dropped with the GIL. PyO3 puts the objects
/// of a value that is dropped without it into a list behind a lock, and a process that is forked while another thread holds this
/// lock never gets it.
pub struct Held<T>(Option<T>);

impl<T> Held<T> {
    /// Holds a value.
    pub fn new(value: T) -> Self {
        Self(Some(value))
    }

    /// Returns the value.
    pub fn into_inner(mut self) -> T {
        self.0.take().unwrap_or_else(|| unreachable!("{GONE}"))
    }
}

/// Why a value is always there.
const GONE: &str = "only the end of the holder takes its value";

impl<T> Deref for Held<T> {
    type Target = T;

    fn deref(&self) -> &T {
        self.0.as_ref().unwrap_or_else(|| unreachable!("{GONE}"))
    }
}

impl<T> Drop for Held<T> {
    fn drop(&mut self) {
        let Some(value) = self.0.take() else { return };
        let mut value = Some(value);
        let _call = Call::begin();
        if !is_over() {
            Python::try_attach(|_| value = None);
        }
        // At the end of the interpreter there is nobody to return the object to.
        std::mem::forget(value);
    }
}

impl<T: fmt::Debug> fmt::Debug for Held<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Debug::fmt(&**self, f)
    }
}

impl<T: fmt::Display> fmt::Display for Held<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(&**self, f)
    }
}

impl<T: Error> Error for Held<T> {}
