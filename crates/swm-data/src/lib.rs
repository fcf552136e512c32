//! swm-data
