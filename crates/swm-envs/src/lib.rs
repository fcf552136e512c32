//! swm-envs
