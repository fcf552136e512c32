//! swm-eval
