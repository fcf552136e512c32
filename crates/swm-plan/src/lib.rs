//! swm-plan
