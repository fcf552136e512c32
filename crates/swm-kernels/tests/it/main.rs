//! Integration tests of the kernels.

mod conv;
