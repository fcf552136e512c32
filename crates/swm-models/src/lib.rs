//! swm-models
