//! swm-report
