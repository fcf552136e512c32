//! Chooses the CPU's vector instructions at run time, for every crate of the workspace. This crate has no dependencies.
//!
//! - [`dispatch`] and [`dispatch_avx2`] run a [`Kernel`], plain loops that are compiled for several instruction sets,
//!   at the best level that the CPU supports.
//! - [`vectorize!`] compiles single functions for the baseline and for AVX2.
//! - [`F32x8`] provides eight floats at once, for loops that are too short for the compiler to vectorise; [`F32x16`]
//!   provides sixteen, for kernels that keep their sums in registers.
//! - [`cpu_level`] returns the best level that the CPU supports.
//!
//! Rust never contracts `a * b + c` into a fused multiply-add, so code that does not call [`Level::fma`] computes the
//! same bytes at every level.

mod f32x16;
mod f32x8;
mod kernel;
mod level;
mod vectorize;

pub use f32x8::{F32x8, LANES, Portable};
pub use f32x16::{F32x16, LANES16, Portable16};
pub use kernel::{Kernel, Level, dispatch, dispatch_avx2};
pub use level::{CpuLevel, cpu_level, limit_cpu_level};
