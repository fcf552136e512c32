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
//! are computed with AVX2 everywhere. All but small products are laid out for these kernels in `tiles.rs`.

#![allow(unsafe_code, reason = "products are computed on pointers, as Burn gives them")]

use core::any::TypeId;
pub use gemm_common::Parallelism;

#[cfg(target_arch = "x86_64")]
mod single;
#[cfg(target_arch = "x86_64")]
mod tiles;

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
#[derive(Clone, Copy)]
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

/// Pointers to elements.
trait Pointer: Copy {
    /// Returns the pointer to the element at a distance, in elements.
    fn offset(self, distance: isize) -> Self;
}

impl<T> Pointer for *const T {
    fn offset(self, distance: isize) -> Self {
        self.wrapping_offset(distance)
    }
}

impl<T> Pointer for *mut T {
    fn offset(self, distance: isize) -> Self {
        self.wrapping_offset(distance)
    }
}

impl<P: Pointer> Matrix<P> {
    /// Returns the matrix below and to the right of an element.
    #[inline(always)]
    fn at(&self, row: usize, column: usize) -> Self {
        let distance = row as isize * self.to_next_row + column as isize * self.to_next_column;
        Self { first: self.first.offset(distance), ..*self }
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

/// The factors of a product: of the destination, none if it is not read, and of the product of the two other matrices.
type Factors<T> = (Option<T>, T);

/// Computes a product with a kernel of another crate. `zero` is any factor of a destination that is not read.
///
/// # Safety
/// As for [`gemm()`].
unsafe fn call<T: Copy>(
    kernel: Kernel<T>,
    product: &Product<T>,
    (alpha, beta): Factors<T>,
    zero: T,
    parallelism: Parallelism,
) {
    let Product { sides: [m, n, k], dst, lhs, rhs } = product;
    // SAFETY: as for this function.
    unsafe {
        kernel(
            *m,
            *n,
            *k,
            dst.first,
            dst.to_next_column,
            dst.to_next_row,
            alpha.is_some(),
            lhs.first,
            lhs.to_next_column,
            lhs.to_next_row,
            rhs.first,
            rhs.to_next_column,
            rhs.to_next_row,
            alpha.unwrap_or(zero),
            beta,
            false,
            false,
            false,
            parallelism,
        );
    }
}

/// Single precision on other processors.
#[cfg(not(target_arch = "x86_64"))]
mod single {
    use crate::{Factors, Parallelism, Product, call};

    /// Computes a product.
    ///
    /// # Safety
    /// As for [`gemm()`](crate::gemm()).
    pub unsafe fn multiply(product: &Product<f32>, factors: Factors<f32>, parallelism: Parallelism) {
        // SAFETY: as for this function.
        unsafe { call(gemm_f32::gemm::f32::get_gemm_fn(), product, factors, 0.0, parallelism) };
    }
}

/// Computes a product block by block. `multiply` computes a block, of which it vouches that all elements are valid; `one` is 1.
fn in_blocks<T: Copy>(
    multiply: impl Fn(&Product<T>, Factors<T>),
    product: Product<T>,
    (mut alpha, beta): Factors<T>,
    one: T,
) {
    let product = product.oriented();
    let block = product.block();
    let Product { sides: [m, n, k], dst, lhs, rhs } = product;
    let mut done = 0;
    loop {
        let length = block.min(k - done);
        let block = Product { sides: [m, n, length], dst, lhs: lhs.at(0, done), rhs: rhs.at(done, 0) };
        multiply(&block, (alpha, beta));
        done += length;
        // The destination holds the sum of the blocks so far.
        alpha = Some(one);
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
    let factors = (read_dst.then_some(alpha), beta);
    let factors = &raw const factors;
    // SAFETY: `T` is the type that is compared; otherwise as for this function.
    unsafe {
        if TypeId::of::<T>() == TypeId::of::<f32>() {
            let multiply = |product: &_, factors| single::multiply(product, factors, parallelism);
            in_blocks(multiply, product.cast(), factors.cast::<Factors<f32>>().read(), 1.0);
        } else if TypeId::of::<T>() == TypeId::of::<f64>() {
            let kernel = gemm_f64::gemm::f64::get_gemm_fn();
            let multiply = |product: &_, factors| call(kernel, product, factors, 0.0, parallelism);
            in_blocks(multiply, product.cast(), factors.cast::<Factors<f64>>().read(), 1.0);
        } else {
            assert!(TypeId::of::<T>() == TypeId::of::<gemm_f16::f16>(), "products of this type are not computed here");
            let (kernel, zero) = (gemm_f16::gemm::f16::get_gemm_fn(), gemm_f16::f16::ZERO);
            let multiply = |product: &_, factors| call(kernel, product, factors, zero, parallelism);
            let factors = factors.cast::<Factors<gemm_f16::f16>>().read();
            in_blocks(multiply, product.cast(), factors, gemm_f16::f16::ONE);
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

    #[cfg(target_arch = "x86_64")]
    fn has_fma() -> bool {
        std::arch::is_x86_feature_detected!("fma") && std::arch::is_x86_feature_detected!("avx2")
    }

    #[cfg(not(target_arch = "x86_64"))]
    fn has_fma() -> bool {
        false
    }

    /// The distances between neighbours of a matrix, how many elements they span, and the index of the first.
    #[cfg(target_arch = "x86_64")]
    struct Layout {
        to_next_column: isize,
        to_next_row: isize,
        length: usize,
        first: usize,
    }

    #[cfg(target_arch = "x86_64")]
    impl Layout {
        fn new(rows: usize, columns: usize, [to_next_column, to_next_row]: [isize; 2]) -> Self {
            let spans = [(columns, to_next_column), (rows, to_next_row)].map(|(n, step)| (n as isize - 1) * step);
            let before: isize = spans.iter().map(|span| span.min(&0)).sum();
            let after: isize = spans.iter().map(|span| span.max(&0)).sum();
            Self { to_next_column, to_next_row, length: (after - before + 1) as usize, first: (-before) as usize }
        }
    }

    /// All ways to compute a product whose matrices have these layouts give the bits of a kernel without tiles, and write no other
    /// element.
    #[cfg(target_arch = "x86_64")]
    fn check_ways(sides: [usize; 3], [dst, lhs, rhs]: [&Layout; 3], alpha: Option<f32>) {
        type Way<'a> = (&'a str, &'a dyn Fn(&Product<f32>, Factors<f32>));
        // The elements before and behind the destination.
        const EDGE: usize = 32;
        let (left, right) = (values(lhs.length, 1), values(rhs.length, 5));
        // SAFETY: the layouts are those of the memory, and the processor has the instructions.
        let ways: [Way<'_>; 5] = unsafe {
            [
                ("kernel", &|product, factors| call(single::fma::kernel, product, factors, 0.0, Parallelism::None)),
                ("AVX2", &|product, factors| single::fma::multiply(product, factors, Parallelism::None)),
                ("widest", &|product, factors| single::multiply(product, factors, Parallelism::None)),
                #[cfg(feature = "rayon")]
                ("three threads", &|product, factors| single::multiply(product, factors, Parallelism::Rayon(3))),
                #[cfg(feature = "rayon")]
                ("many threads", &|product, factors| single::multiply(product, factors, Parallelism::Rayon(40))),
            ]
        };
        let outs = ways.map(|(name, way)| {
            let mut out = values(dst.length + 2 * EDGE, 3);
            let product = Product {
                sides,
                dst: Matrix::new(out[EDGE + dst.first..].as_mut_ptr(), dst.to_next_column, dst.to_next_row),
                lhs: Matrix::new(left[lhs.first..].as_ptr(), lhs.to_next_column, lhs.to_next_row),
                rhs: Matrix::new(right[rhs.first..].as_ptr(), rhs.to_next_column, rhs.to_next_row),
            };
            in_blocks(way, product, (alpha, 2.0), 1.0);
            (name, out.into_iter().map(f32::to_bits).collect::<Vec<_>>())
        });
        for (name, out) in &outs[1..] {
            let steps = [dst, lhs, rhs].map(|layout| [layout.to_next_column, layout.to_next_row]);
            assert!(*out == outs[0].1, "{sides:?}, {steps:?}, {alpha:?}: {name}");
        }
    }

    /// Products of every orientation, with small and large sides and with long sums.
    #[cfg(target_arch = "x86_64")]
    #[test]
    fn vectors_of_both_widths_tiles_and_threads_give_the_bits_of_the_kernels() {
        if !has_fma() {
            return;
        }
        let small =
            [1, 7, 16, 33, 64, 130].map(|m| [1, 5, 6, 17, 65].map(|n| [1, 2, 3, 24, 129, 700].map(|k| [m, n, k])));
        // More panels than are laid out at once, and rows of the right matrix that lie a multiple of 4 KiB apart.
        for sides in small.into_iter().flatten().flatten().chain([[330, 1024, 500]]) {
            let [m, n, k] = sides;
            for layouts in 0..8 {
                let layout = |bit: usize, rows: usize, columns: usize| {
                    let row_major = layouts >> bit & 1 == 0;
                    Layout::new(rows, columns, if row_major { [1, columns as isize] } else { [rows as isize, 1] })
                };
                let [dst, lhs, rhs] = [layout(0, m, n), layout(1, m, k), layout(2, k, n)];
                let alphas = if m > 200 { &[None][..] } else { &[None, Some(1.0), Some(0.5)] };
                alphas.iter().for_each(|alpha| check_ways(sides, [&dst, &lhs, &rhs], *alpha));
            }
        }
    }

    /// Products of parts of matrices, and of rows and columns that repeat or run backwards.
    #[cfg(target_arch = "x86_64")]
    #[test]
    fn matrices_may_have_any_layout() {
        if !has_fma() {
            return;
        }
        let mut state = 1_u64;
        let mut draw = |below: usize| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) as usize % below
        };
        for case in 0..600 {
            let [m, n, k] = [2 + draw(200), 2 + draw(200), 1 + draw(560)];
            let mut layout = |rows: usize, columns: usize, is_read: bool| {
                let padding = [0, 1, 7][draw(3)];
                let [to_next_column, to_next_row] = match draw(if is_read { 6 } else { 4 }) {
                    0 => [1, columns + padding],
                    1 => [rows + padding, 1],
                    2 => [1, 1024.max(columns)],
                    3 => [2, 2 * columns + padding],
                    4 => [1, 0],
                    _ => [0, 1],
                }
                .map(|step| step as isize);
                let backwards = draw(6);
                let sign = |of: usize| if backwards == of { -1 } else { 1 };
                Layout::new(rows, columns, [sign(0) * to_next_column, sign(1) * to_next_row])
            };
            let [dst, lhs, rhs] = [layout(m, n, false), layout(m, k, true), layout(k, n, true)];
            check_ways([m, n, k], [&dst, &lhs, &rhs], [None, Some(1.0), Some(0.5), Some(0.0)][case % 4]);
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
