//! Products of single precision on x86, by the instructions that are used. Whatever the width of its vectors, a kernel computes an
//! element of the result as one sum in the order of its terms, except in products of rows with columns.

use crate::tiles::{Tiles, can_multiply};
use crate::{Factors, Parallelism, Product, call};
use gemm_common::gemm::gemm_basic_generic;
use gemm_common::simd::{V3, V4};
use gemm_f32::microkernel;

macro_rules! instructions {
    ($name:ident, $simd:ty, $lanes:literal) => {
        pub mod $name {
            use super::*;
            use microkernel::$name::f32::{H_M, H_N, H_UKR, MR_DIV_N, NR, UKR};

            static TILES: Tiles<$lanes, MR_DIV_N, NR> = Tiles(UKR);

            /// Computes a product.
            ///
            /// # Safety
            /// As for [`gemm()`](crate::gemm()). The processor must have the instructions.
            pub unsafe fn multiply(product: &Product<f32>, factors: Factors<f32>, parallelism: Parallelism) {
                // SAFETY: as for this function.
                unsafe {
                    if can_multiply(product) {
                        TILES.multiply(product, factors, threads(parallelism));
                    } else {
                        call(kernel, product, factors, 0.0, parallelism);
                    }
                }
            }

            /// A kernel: as [`gemm()`](crate::gemm()).
            #[allow(clippy::too_many_arguments, clippy::fn_params_excessive_bools, reason = "the type of kernels")]
            pub unsafe fn kernel(
                m: usize,
                n: usize,
                k: usize,
                dst: *mut f32,
                dst_cs: isize,
                dst_rs: isize,
                read_dst: bool,
                lhs: *const f32,
                lhs_cs: isize,
                lhs_rs: isize,
                rhs: *const f32,
                rhs_cs: isize,
                rhs_rs: isize,
                alpha: f32,
                beta: f32,
                conj_dst: bool,
                conj_lhs: bool,
                conj_rhs: bool,
                parallelism: Parallelism,
            ) {
                let simd = <$simd>::try_new().expect("the processor has the instructions of the chosen kernel");
                // SAFETY: the caller vouches for the matrices, and `try_new` for the instructions.
                unsafe {
                    gemm_basic_generic::<_, f32, $lanes, { MR_DIV_N * $lanes }, NR, MR_DIV_N, H_M, H_N>(
                        simd,
                        m,
                        n,
                        k,
                        dst,
                        dst_cs,
                        dst_rs,
                        read_dst,
                        lhs,
                        lhs_cs,
                        lhs_rs,
                        rhs,
                        rhs_cs,
                        rhs_rs,
                        alpha,
                        beta,
                        conj_dst,
                        conj_lhs,
                        conj_rhs,
                        |a, b, c| a * b + c,
                        &UKR,
                        &H_UKR,
                        false,
                        parallelism,
                    );
                }
            }
        }
    };
}
instructions!(fma, V3, 8);
instructions!(avx512f, V4, 16);

/// Returns the number of threads that compute a product.
fn threads(parallelism: Parallelism) -> usize {
    match parallelism {
        Parallelism::None => 1,
        #[cfg(feature = "rayon")]
        Parallelism::Rayon(0) => rayon::current_num_threads(),
        #[cfg(feature = "rayon")]
        Parallelism::Rayon(threads) => threads,
    }
}

/// Computes a product with the widest vectors that it may be computed with.
///
/// # Safety
/// As for [`gemm()`](crate::gemm()).
pub unsafe fn multiply(product: &Product<f32>, factors: Factors<f32>, parallelism: Parallelism) {
    // SAFETY: as for this function, and the processor has the instructions.
    unsafe {
        match (V3::try_new(), V4::try_new()) {
            (_, Some(_)) if !product.has_sums_over_lanes() => avx512f::multiply(product, factors, parallelism),
            (Some(_), _) => fma::multiply(product, factors, parallelism),
            _ => call(gemm_f32::gemm::f32::get_gemm_fn(), product, factors, 0.0, parallelism),
        }
    }
}
