//! [`SharedModel`]: weights that training updates while policies use them.

use std::sync::{Arc, Mutex, PoisonError};

/// A handle to a model whose weights change. All clones of the handle share the weights.
#[derive(Debug)]
pub struct SharedModel<M>(Arc<Mutex<M>>);

impl<M> Clone for SharedModel<M> {
    fn clone(&self) -> Self {
        Self(Arc::clone(&self.0))
    }
}

impl<M: Clone> SharedModel<M> {
    /// Creates a handle to a model.
    pub fn new(model: M) -> Self {
        Self(Arc::new(Mutex::new(model)))
    }

    /// Returns the present model without copying tensors.
    pub fn get(&self) -> M {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Replaces the model of all clones.
    pub fn set(&self, model: M) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = model;
    }
}
