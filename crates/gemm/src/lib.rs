//! The matrix product of Burn's CPU backend, with sums that are the same on every machine.
//!
//! Burn calls [`gemm()`] of the registry's crate of this name, which this one replaces (`[patch]` in the `Cargo.toml` of the
//! workspace). The original cuts a long sum into blocks whose length follows from the size and the ways of the processor's first
//! cache: 512 products with 32 KiB and 8 ways, 1024 with 48 KiB and 12. Rounded sums depend on where they are cut, so that a training
//! gave other weights on another processor. Here sums of more than 512 products are cut into equal blocks of at most 512 first, which
//! the original's kernels (`gemm-f32` and its siblings) compute as one on every machine. Nothing else of a kernel's
//! result depends on the caches.
//!
//! Of single precision, products are computed with AVX-512 where the processor has it, in tiles whose elements are summed one by one
//! like those of AVX2. Products of rows with columns are the exception: their sums are over the lanes of a vector, so that they
//! are computed with AVX2 everywhere.

#![allow(unsafe_code, reason = "products are computed on pointers, as Burn gives them")]

use core::any::TypeId;
pub use gemm_common::Parallelism;

/// The longest sum that the kernels do not cut, whatever the caches.
const BLOCK: usize = 512;
/// The largest side of products for which the kernels always cut sums after 512 products.
const SMALL: usize = 64;
/// The most elements of products of rows with columns, which the kernels cut after 1024 products on every machine.
const DOTS: usize = 16 * 16;

/// A product of matrices: `[m, k]` times `[k, n]`.
struct Product<T> {
    /// m, n and k.
    sides: [usize; 3],
    dst: Matrix<*mut T>,
    lhs: Matrix<*const T>,
    rhs: Matrix<*const T>,
}

/// The first element of a matrix, and the distances between neighbours along a row (from column to column) and along a column.
struct Matrix<P> {
    first: P,
    to_next_column: isize,
    to_next_row: isize,
}

impl<T> Product<T> {
    /// The same product, of elements of the type that `T` is.
    fn cast<U>(self) -> Product<U> {
        let Self { sides, dst, lhs, rhs } = self;
        Product {
            sides,
            dst: Matrix::new(dst.first.cast(), dst.to_next_column, dst.to_next_row),
            lhs: Matrix::new(lhs.first.cast(), lhs.to_next_column, lhs.to_next_row),
            rhs: Matrix::new(rhs.first.cast(), rhs.to_next_column, rhs.to_next_row),
        }
    }

    /// Returns the product whose destination has its elements of a column closer than those of a row, as the kernels prefer.
    fn oriented(self) -> Self {
        if self.dst.to_next_column.abs() >= self.dst.to_next_row.abs() {
            return self;
        }
        let [m, n, k] = self.sides;
        Self { sides: [n, m, k], dst: self.dst.transposed(), lhs: self.rhs.transposed(), rhs: self.lhs.transposed() }
    }

    /// Whether neighbouring terms of a sum are neighbours in memory, in both matrices.
    fn is_of_rows_and_columns(&self) -> bool {
        self.lhs.to_next_column == 1 && self.rhs.to_next_row == 1
    }

    /// Whether the kernels sum the lanes of vectors, whose number then decides how sums are rounded.
    fn has_sums_over_lanes(&self) -> bool {
        let [m, n, _] = self.sides;
        self.is_of_rows_and_columns() && (m * n <= DOTS || m.min(n) <= 1)
    }

    /// Returns the lengths of the blocks into which sums are cut here; the last may be shorter.
    fn block(&self) -> usize {
        let [m, n, k] = self.sides;
        let (lhs, rhs, dst) = (&self.lhs, &self.rhs, &self.dst);
        let of_rows_and_columns = self.is_of_rows_and_columns();
        let by_columns = n <= 1 && lhs.to_next_row == 1 && dst.to_next_row == 1;
        let by_rows = m <= 1 && rhs.to_next_column == 1 && dst.to_next_column == 1;
        let is_vector = by_columns || by_rows || (m.min(n) <= 1 && of_rows_and_columns);
        let is_cut_alike = m.max(n) <= SMALL || is_vector || (of_rows_and_columns && m * n <= DOTS);
        if k <= BLOCK || is_cut_alike { k } else { k.div_ceil(k.div_ceil(BLOCK)) }
    }
}

impl<P> Matrix<P> {
    const fn new(first: P, to_next_column: isize, to_next_row: isize) -> Self {
        Self { first, to_next_column, to_next_row }
    }

    fn transposed(self) -> Self {
        Self { to_next_column: self.to_next_row, to_next_row: self.to_next_column, ..self }
    }
}

/// A kernel: as [`gemm()`], for one type.
type Kernel<T> = unsafe fn(
    usize,
    usize,
    usize,
    *mut T,
    isize,
    isize,
    bool,
    *const T,
    isize,
    isize,
    *const T,
    isize,
    isize,
    T,
    T,
    bool,
    bool,
    bool,
    Parallelism,
);

/// The kernels of single precision on x86, by the instructions that they use. Whatever the width of its vectors, a kernel computes
/// an element of the result as one sum in the order of its terms, except in products of rows with columns.
#[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
mod single {
    use super::{Kernel, Parallelism};
    use gemm_common::gemm::gemm_basic_generic;
    use gemm_common::simd::{V3, V4};
    use gemm_f32::microkernel;

    macro_rules! kernel {
        ($name:ident, $simd:ty, $lanes:literal) => {
            /// A kernel: as [`gemm()`](super::gemm()).
            #[allow(clippy::too_many_arguments, clippy::fn_params_excessive_bools, reason = "the type of kernels")]
            pub unsafe fn $name(
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
                use microkernel::$name::f32::{H_M, H_N, H_UKR, MR_DIV_N, NR, UKR};
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
        };
    }
    kernel!(fma, V3, 8);
    kernel!(avx512f, V4, 16);

    /// Returns the kernel of the widest vectors that a product may be computed with.
    pub fn kernel(has_sums_over_lanes: bool) -> Kernel<f32> {
        match (V3::try_new(), V4::try_new()) {
            (_, Some(_)) if !has_sums_over_lanes => avx512f,
            (Some(_), _) => fma,
            _ => gemm_f32::gemm::f32::get_gemm_fn(),
        }
    }
}

/// The kernels of single precision of other processors.
#[cfg(not(any(target_arch = "x86", target_arch = "x86_64")))]
mod single {
    /// Returns the kernel of the processor.
    pub fn kernel(_has_sums_over_lanes: bool) -> super::Kernel<f32> {
        gemm_f32::gemm::f32::get_gemm_fn()
    }
}

/// Computes a product block by block. `alpha` is the factor of the destination, none if it is not read; `one` is 1.
///
/// # Safety
/// As for [`gemm()`].
unsafe fn in_blocks<T: Copy>(
    kernel: impl Fn(&Product<T>) -> Kernel<T>,
    product: Product<T>,
    (alpha, beta, one): (Option<T>, T, T),
    parallelism: Parallelism,
) {
    let product = product.oriented();
    let (kernel, block) = (kernel(&product), product.block());
    let Product { sides: [m, n, k], dst, lhs, rhs } = product;
    let (mut done, mut factor) = (0, alpha);
    loop {
        let length = block.min(k - done);
        let lhs_first = lhs.first.wrapping_offset(done as isize * lhs.to_next_column);
        let rhs_first = rhs.first.wrapping_offset(done as isize * rhs.to_next_row);
        // SAFETY: the block consists of elements of the matrices, which the caller vouches for.
        unsafe {
            kernel(
                m,
                n,
                length,
                dst.first,
                dst.to_next_column,
                dst.to_next_row,
                factor.is_some(),
                lhs_first,
                lhs.to_next_column,
                lhs.to_next_row,
                rhs_first,
                rhs.to_next_column,
                rhs.to_next_row,
                factor.unwrap_or(one),
                beta,
                false,
                false,
                false,
                parallelism,
            );
        }
        done += length;
        // The destination holds the sum of the blocks so far.
        factor = Some(one);
        if done == k {
            return;
        }
    }
}

/// Computes `dst = alpha * dst + beta * lhs * rhs`, without the first term unless `read_dst`. A matrix is given by its first element
/// and the distances, in elements, between neighbours in a row (`_cs`, from column to column) and in a column (`_rs`).
///
/// # Shapes
/// `dst` is `[m, n]`, `lhs` `[m, k]` and `rhs` `[k, n]`.
///
/// # Panics
/// If `T` is not `f32`, `f64` or `f16`, or a matrix is to be conjugated.
///
/// # Safety
/// All elements of the three matrices must be valid, and no other thread may access those of `dst`.
#[allow(clippy::too_many_arguments, clippy::fn_params_excessive_bools, reason = "the signature that Burn calls")]
pub unsafe fn gemm<T: 'static>(
    m: usize,
    n: usize,
    k: usize,
    dst: *mut T,
    dst_cs: isize,
    dst_rs: isize,
    read_dst: bool,
    lhs: *const T,
    lhs_cs: isize,
    lhs_rs: isize,
    rhs: *const T,
    rhs_cs: isize,
    rhs_rs: isize,
    alpha: T,
    beta: T,
    conj_dst: bool,
    conj_lhs: bool,
    conj_rhs: bool,
    parallelism: Parallelism,
) {
    assert!(!(conj_dst || conj_lhs || conj_rhs), "products of complex numbers are not computed here");
    let product = Product {
        sides: [m, n, k],
        dst: Matrix::new(dst, dst_cs, dst_rs),
        lhs: Matrix::new(lhs, lhs_cs, lhs_rs),
        rhs: Matrix::new(rhs, rhs_cs, rhs_rs),
    };
    let (alpha, beta) = (&raw const alpha, &raw const beta);
    // SAFETY: `T` is the type that is compared; otherwise as for this function.
    unsafe {
        if TypeId::of::<T>() == TypeId::of::<f32>() {
            let factors = (read_dst.then_some(*alpha.cast()), *beta.cast(), 1.0);
            let kernel = |product: &Product<f32>| single::kernel(product.has_sums_over_lanes());
            in_blocks(kernel, product.cast(), factors, parallelism);
        } else if TypeId::of::<T>() == TypeId::of::<f64>() {
            let factors = (read_dst.then_some(*alpha.cast()), *beta.cast(), 1.0);
            in_blocks(|_| gemm_f64::gemm::f64::get_gemm_fn(), product.cast(), factors, parallelism);
        } else {
            assert!(TypeId::of::<T>() == TypeId::of::<gemm_f16::f16>(), "products of this type are not computed here");
            let factors = (read_dst.then_some(*alpha.cast()), *beta.cast(), gemm_f16::f16::ONE);
            in_blocks(|_| gemm_f16::gemm::f16::get_gemm_fn(), product.cast(), factors, parallelism);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Values between -1 and 1 that have no short binary form.
    fn values(count: usize, seed: usize) -> Vec<f32> {
        (0..count).map(|i| (((i + seed) * 7919 % 10007) as f32 / 5003.5 - 1.0) * 0.9).collect()
    }

    /// The product of row-major matrices, with sums that are cut into blocks of this length.
    fn expected(sides: [usize; 3], lhs: &[f32], rhs: &[f32], block: usize) -> Vec<f32> {
        let [m, n, k] = sides;
        let sum = |row: usize, column: usize| {
            let of_block = |start: usize| {
                let range = start..(start + block).min(k);
                range.fold(0.0_f32, |sum, i| lhs[row * k + i].mul_add(rhs[i * n + column], sum))
            };
            (0..k).step_by(block).map(of_block).reduce(|sum, of_block| sum + of_block).unwrap_or(0.0)
        };
        (0..m * n).map(|i| sum(i / n, i % n)).collect()
    }

    fn product(sides: [usize; 3], lhs: &[f32], rhs: &[f32], parallelism: Parallelism) -> Vec<f32> {
        let [m, n, k] = sides;
        assert_eq!((lhs.len(), rhs.len()), (m * k, k * n));
        let mut out = vec![f32::NAN; m * n];
        let (n_, k_) = (n as isize, k as isize);
        // SAFETY: the matrices have the stated sizes.
        unsafe {
            gemm(
                m,
                n,
                k,
                out.as_mut_ptr(),
                1,
                n_,
                false,
                lhs.as_ptr(),
                1,
                k_,
                rhs.as_ptr(),
                1,
                n_,
                0.0,
                1.0,
                false,
                false,
                false,
                parallelism,
            );
        }
        out
    }

    #[test]
    fn sums_have_the_same_bits_on_every_machine() {
        let fused = cfg!(target_arch = "aarch64") || has_fma();
        // Blocks of 512 and less, of 512 and a rest where both sides are small, and one that is not cut.
        for (sides, block) in [
            ([70, 33, 700], 350),
            ([66, 130, 1025], 342),
            ([130, 5, 2048], 512),
            ([64, 64, 700], 512),
            ([80, 40, 512], 512),
            ([3, 90, 9], 9),
        ] {
            let [m, n, k] = sides;
            let (lhs, rhs) = (values(m * k, 1), values(k * n, 5));
            let found = product(sides, &lhs, &rhs, Parallelism::None);
            #[cfg(feature = "rayon")]
            assert!(found == product(sides, &lhs, &rhs, Parallelism::Rayon(2)), "{sides:?}: threads change the sums");
            let expected = expected(sides, &lhs, &rhs, block);
            let largest = found.iter().zip(&expected).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(largest < 1e-4, "{sides:?}: off by {largest}");
            assert!(!fused || found == expected, "{sides:?}: sums are cut elsewhere, off by {largest}");
        }
    }

    #[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
    fn has_fma() -> bool {
        std::arch::is_x86_feature_detected!("fma") && std::arch::is_x86_feature_detected!("avx2")
    }

    #[cfg(not(any(target_arch = "x86", target_arch = "x86_64")))]
    fn has_fma() -> bool {
        false
    }

    /// Products of every orientation, with small and large sides and with long sums, that are added to what is there.
    #[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
    #[test]
    fn vectors_of_both_widths_give_the_same_bits() {
        if !(has_fma() && std::arch::is_x86_feature_detected!("avx512f")) {
            return;
        }
        for m in [1, 7, 16, 33, 64, 130] {
            for n in [1, 5, 6, 17, 65] {
                for k in [1, 2, 3, 24, 129, 700] {
                    for layouts in 0..8 {
                        let (lhs, rhs) = (values(m * k, 1), values(k * n, 5));
                        let [with_avx512, with_avx2] = [None, Some(single::fma as Kernel<f32>)].map(|kernel| {
                            let mut out = values(m * n, 3);
                            // The strides to the next column and row: row-major or column-major.
                            let strides = |bit: usize, rows: usize, columns: usize| {
                                if layouts >> bit & 1 == 0 { (1, columns as isize) } else { (rows as isize, 1) }
                            };
                            let [dst, l, r] = [strides(0, m, n), strides(1, m, k), strides(2, k, n)];
                            let product = Product {
                                sides: [m, n, k],
                                dst: Matrix::new(out.as_mut_ptr(), dst.0, dst.1),
                                lhs: Matrix::new(lhs.as_ptr(), l.0, l.1),
                                rhs: Matrix::new(rhs.as_ptr(), r.0, r.1),
                            };
                            let choose = |product: &Product<f32>| {
                                kernel.unwrap_or_else(|| single::kernel(product.has_sums_over_lanes()))
                            };
                            // SAFETY: the matrices have the stated sizes.
                            unsafe { in_blocks(choose, product, (Some(0.5), 2.0, 1.0), Parallelism::None) };
                            out
                        });
                        assert!(with_avx512 == with_avx2, "{m} x {k} x {n}, layouts {layouts}");
                    }
                }
            }
        }
    }

    #[test]
    fn the_destination_is_added_to_once() {
        let (lhs, rhs) = (values(70 * 700, 1), values(700 * 66, 5));
        let plain = product([70, 66, 700], &lhs, &rhs, Parallelism::None);
        let mut out = vec![2.0_f64; 70 * 66];
        let (lhs, rhs): (Vec<f64>, Vec<f64>) =
            (lhs.iter().map(|v| (*v).into()).collect(), rhs.iter().map(|v| (*v).into()).collect());
        // SAFETY: the matrices have the stated sizes. The destination is column-major.
        unsafe {
            gemm(
                70,
                66,
                700,
                out.as_mut_ptr(),
                70,
                1,
                true,
                lhs.as_ptr(),
                1,
                700,
                rhs.as_ptr(),
                1,
                66,
                0.5,
                2.0,
                false,
                false,
                false,
                Parallelism::None,
            );
        }
        for (i, found) in out.iter().enumerate() {
            let expected = 0.5 * 2.0 + 2.0 * f64::from(plain[(i % 70) * 66 + i / 70]);
            assert!((found - expected).abs() < 1e-3, "{i}: {found}, expected {expected}");
        }
    }
}
