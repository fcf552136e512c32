//! [`SharedModel`]: weights that are trained while somebody acts with them.

use std::sync::{Arc, Mutex, PoisonError};

/// A model that changes. Cheap to clone; all clones show the same model.
#[derive(Debug)]
pub struct SharedModel<M>(Arc<Mutex<M>>);

impl<M> Clone for SharedModel<M> {
    fn clone(&self) -> Self {
        Self(Arc::clone(&self.0))
    }
}

impl<M: Clone> SharedModel<M> {
    /// A model that may change.
    pub fn new(model: M) -> Self {
        Self(Arc::new(Mutex::new(model)))
    }

    /// The model as it is now. Tensors are shared, not copied.
    pub fn get(&self) -> M {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Changes it, for everybody.
    pub fn set(&self, model: M) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = model;
    }
}
